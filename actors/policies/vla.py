"""The small vision-language-action policy: all views, state and words in, a distribution over chunks out.

Perception, fusion and head are modules of their own: heads (heads.py) are a choice, and RL may leave
perception as it is.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict.nn import ProbabilisticTensorDictModule, ProbabilisticTensorDictSequential, TensorDictModule
from torch import Tensor, nn

from actors.policies.heads import Head
from envs.encoders import Gaze, PatchEncoder, WordEncoder, to_signed
from envs.specs import CHUNK, IMAGE, LOG_PROB, STATE, STATE_DIM, TOKENS

# float32 [B, S]: what perception makes of pictures and words, for heads and critics
VISUAL_FEATURES = ("policy", "visual_features")
POLICY_FEATURES = ("policy", "policy_features")  # float32 [B, width]: that joined with the state


class Perception(nn.Module):
    """Encodes pictures and words: the first view by key-points, the others in passing, words by a table.

    Args:
        views: number of cameras.
        points: soft key-points of the first view.
        channels: of its features.
        aims: key-points that are taught to lie on the objects of the data, in their order.
    """

    def __init__(self, views: int = 3, points: int = 32, channels: int = 32, aims: int = 0):
        super().__init__()
        self.main = Gaze(points, channels, aims)
        self.sides = nn.ModuleList(PatchEncoder(32) for _ in range(views - 1))
        self.words = WordEncoder(16)
        self.out_features = self.main.out_features + 32 * (views - 1) + 16

    def forward(self, image: Tensor, tokens: Tensor) -> Tensor:
        """uint8 or float (-1..1) [B, V, 3, H, W], int64 [B, WORDS] -> float32 [B, out_features]; leading
        dimensions may be more.
        """
        lead = image.shape[:-4]
        seen, _ = self.look(image.reshape(-1, *image.shape[-4:]), tokens.reshape(-1, tokens.shape[-1]))
        return seen.reshape(*lead, -1)

    def look(self, image: Tensor, tokens: Tensor) -> tuple[Tensor, Tensor]:
        """The same of one leading dimension, and where objects are seen in the first view, [B, 2, aims, 2];
        see Gaze.
        """
        pictures = to_signed(image)
        first, aimed = self.main(pictures[:, 0])
        return torch.cat(
            [first, *(side(pictures[:, k + 1]) for k, side in enumerate(self.sides)), self.words(tokens)], -1
        ), aimed


class Fusion(nn.Module):
    """Joins what is seen with the joint state.

    Args:
        seen: features of perception.
        width: size of the output.
        states: numbers of the joint state.
    """

    state_mean: Tensor
    state_std: Tensor

    def __init__(self, seen: int, width: int = 256, states: int = STATE_DIM):
        super().__init__()
        self.register_buffer("state_mean", torch.zeros(states))
        self.register_buffer("state_std", torch.ones(states))
        self.state = nn.Sequential(nn.Linear(states, 64), nn.SiLU(), nn.Linear(64, 64))
        self.mix = nn.Sequential(nn.Linear(seen + 64, width), nn.SiLU(), nn.Linear(width, width), nn.SiLU())

    def forward(self, seen: Tensor, state: Tensor) -> Tensor:
        """float [..., S], float [..., states] -> float32 [..., width]."""
        proprio = ((state - self.state_mean) / self.state_std).clamp(-5, 5)
        return self.mix(torch.cat((seen, self.state(proprio)), -1))


class ChunkPolicy(ProbabilisticTensorDictSequential):
    """Perception, fusion, head and its distribution as one TorchRL policy with get_dist and log_prob.

    Args:
        views: number of cameras.
        head: builds what says chunks, from the width of the hidden vector; see heads.py.
        width: of that vector.
        points: soft key-points of the first view.
        states: numbers of the joint state.
        channels: of the first view's features.
        aims: see Perception.

    Reads image, state and instruction tokens; writes ("vla_action", "chunk") and its log-probability.

    Examples:
        >>> policy = ChunkPolicy(views=3, head=partial(ChunkGaussianHead, chunk=4))
        >>> sorted(map(str, policy.out_keys))[-1]
        "('vla_action', 'log_probs')"
    """

    def __init__(
        self,
        views: int,
        head: Callable[[int], Head],
        width: int = 256,
        points: int = 32,
        states: int = STATE_DIM,
        channels: int = 32,
        aims: int = 0,
    ):
        eyes = Perception(views, points, channels, aims)
        perception = TensorDictModule(eyes, in_keys=[IMAGE, TOKENS], out_keys=[VISUAL_FEATURES])
        fusion = TensorDictModule(
            Fusion(eyes.out_features, width, states),
            in_keys=[VISUAL_FEATURES, STATE],
            out_keys=[POLICY_FEATURES],
        )
        speaker = head(width)
        said = TensorDictModule(
            speaker, in_keys=[POLICY_FEATURES], out_keys=[("policy", name) for name in speaker.names]
        )
        sampler = ProbabilisticTensorDictModule(
            in_keys={name: ("policy", name) for name in speaker.names},
            out_keys=[CHUNK],
            distribution_class=speaker.distribution,
            return_log_prob=True,
            log_prob_key=LOG_PROB,
        )
        super().__init__(perception, fusion, said, sampler)
        self.frozen = False

    @property
    def perception(self) -> Perception:
        """What encodes pictures and words."""
        return self[0].module

    @property
    def fusion(self) -> Fusion:
        """What joins them with the state."""
        return self[1].module

    @property
    def head(self) -> Head:
        """What says chunks."""
        return self[2].module

    def freeze_perception(self) -> None:
        """Leave perception as imitation made it: what was seen during a rollout then serves every update, and
        no picture is encoded twice.
        """
        self.perception.requires_grad_(False)
        self.frozen = True

    @property
    def trained(self) -> ProbabilisticTensorDictSequential:
        """The part that learners train, a policy in its own right: all of it, or what follows a frozen
        perception.
        """
        return ProbabilisticTensorDictSequential(self[1], self[2], self[3]) if self.frozen else self

    def normalise(self, chunks: Tensor, states: Tensor, floor: Tensor) -> None:
        """Set units from demonstrations: dimensions that hardly vary become constants.

        Args:
            chunks: [N, K, 14] actions as the policy will emit them; states: [N, 16].
            floor: [14] spread below which a dimension is a constant.
        """
        with torch.no_grad():
            self.head.normalise(chunks, floor)
            self.fusion.state_mean.copy_(states.mean(0))
            self.fusion.state_std.copy_(states.std(0).clamp(min=0.05))
