"""The small vision-language-action policy: all views, state and words in, a distribution over chunks out.

Perception, fusion and head are modules of their own, so that a token head or a flow head can stand beside the
Gaussian, and RL may leave perception as it is.
"""

from __future__ import annotations

import torch
from tensordict.nn import ProbabilisticTensorDictModule, ProbabilisticTensorDictSequential, TensorDictModule
from torch import Tensor, nn

from actors.policies.chunk_gaussian import ChunkGaussian, knot_basis
from envs.encoders import PatchEncoder, SpatialEncoder, WordEncoder, to_signed
from envs.schema import ACTION_DIM, CHUNK, IMAGE, LOG_PROB, STATE, STATE_DIM, TOKENS

SEEN = ("policy", "seen")  # float32 [B, S]: what perception makes of pictures and words, for heads and critics
HIDDEN = ("policy", "hidden")  # float32 [B, width]: that joined with the state


class Perception(nn.Module):
    """Encodes pictures and words: the first view by key-points, the others in passing, words by a table.

    Args:
        views: number of cameras.
        points: soft key-points of the first view.
    """

    def __init__(self, views: int = 3, points: int = 32):
        super().__init__()
        self.main = SpatialEncoder(points, 32)
        self.sides = nn.ModuleList(PatchEncoder(32) for _ in range(views - 1))
        self.words = WordEncoder(16)
        self.out_features = self.main.out_features + 32 * (views - 1) + 16

    def forward(self, image: Tensor, tokens: Tensor) -> Tensor:
        """uint8 or float (-1..1) [B, V, 3, H, W], int64 [B, WORDS] -> float32 [B, out_features]; leading dimensions may be more."""
        lead = image.shape[:-4]
        pictures = to_signed(image.reshape(-1, *image.shape[-4:]))
        parts = [self.main(pictures[:, 0])]
        parts += [side(pictures[:, k + 1]) for k, side in enumerate(self.sides)]
        parts += [self.words(tokens.reshape(-1, tokens.shape[-1]))]
        return torch.cat(parts, -1).reshape(*lead, -1)


class Fusion(nn.Module):
    """Joins what is seen with the joint state.

    Args:
        seen: features of perception.
        width: size of the output.
    """

    state_mean: Tensor
    state_std: Tensor

    def __init__(self, seen: int, width: int = 256):
        super().__init__()
        self.register_buffer("state_mean", torch.zeros(STATE_DIM))
        self.register_buffer("state_std", torch.ones(STATE_DIM))
        self.state = nn.Sequential(nn.Linear(STATE_DIM, 64), nn.SiLU(), nn.Linear(64, 64))
        self.mix = nn.Sequential(nn.Linear(seen + 64, width), nn.SiLU(), nn.Linear(width, width), nn.SiLU())

    def forward(self, seen: Tensor, state: Tensor) -> Tensor:
        """float [..., S], float [..., 16] -> float32 [..., width]."""
        proprio = ((state - self.state_mean) / self.state_std).clamp(-5, 5)
        return self.mix(torch.cat((seen, self.state(proprio)), -1))


class ChunkGaussianHead(nn.Module):
    """Mean and spread of the knots of a chunk; spreads are learned and do not depend on the observation.

    Args:
        width: of the trunk's output.
        chunk: actions per chunk, K.
        knots: free points per dimension and chunk.
        std: initial spread, in units of the demonstrations' own spread.
    """

    basis: Tensor
    gain: Tensor
    offset: Tensor

    def __init__(self, width: int, chunk: int, knots: int, std: float):
        super().__init__()
        self.knots = knots
        self.mean = nn.Linear(width, knots * ACTION_DIM)
        nn.init.normal_(self.mean.weight, std=1e-2)
        nn.init.zeros_(self.mean.bias)
        self.log_std = nn.Parameter(torch.full((knots, ACTION_DIM), float(torch.tensor(std).log())))
        self.register_buffer("basis", knot_basis(chunk, knots))
        self.register_buffer("gain", torch.ones(ACTION_DIM))
        self.register_buffer("offset", torch.zeros(ACTION_DIM))

    def forward(self, hidden: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        loc = self.mean(hidden.float()).unflatten(-1, (self.knots, ACTION_DIM))
        scale = self.log_std.clamp(-4.0, 0.5).exp().expand_as(loc)
        lead = hidden.shape[:-1]
        return loc, scale, self.basis.expand(*lead, *self.basis.shape), self.gain.expand(*lead, -1), self.offset.expand(*lead, -1)


class ChunkPolicy(ProbabilisticTensorDictSequential):
    """Perception, fusion, head and ChunkGaussian as one TorchRL policy with get_dist and log_prob.

    Reads image, state and instruction tokens; writes ("vla_action", "chunk") and its log-probability.

    Examples:
        >>> policy = ChunkPolicy(views=3, chunk=4)
        >>> sorted(map(str, policy.out_keys))[-1]
        "('vla_action', 'log_probs')"
    """

    def __init__(self, views: int = 3, chunk: int = 4, knots: int = 2, width: int = 256, points: int = 32, std: float = 0.3):
        eyes = Perception(views, points)
        perception = TensorDictModule(eyes, in_keys=[IMAGE, TOKENS], out_keys=[SEEN])
        fusion = TensorDictModule(Fusion(eyes.out_features, width), in_keys=[SEEN, STATE], out_keys=[HIDDEN])
        parameters = [("policy", name) for name in ("loc", "scale", "basis", "gain", "offset")]
        head = TensorDictModule(ChunkGaussianHead(width, chunk, knots, std), in_keys=[HIDDEN], out_keys=parameters)
        sampler = ProbabilisticTensorDictModule(
            in_keys={name: ("policy", name) for name in ("loc", "scale", "basis", "gain", "offset")},
            out_keys=[CHUNK],
            distribution_class=ChunkGaussian,
            return_log_prob=True,
            log_prob_key=LOG_PROB,
        )
        super().__init__(perception, fusion, head, sampler)
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
    def head(self) -> ChunkGaussianHead:
        """The Gaussian head."""
        return self[2].module

    def freeze_perception(self) -> None:
        """Leave perception as imitation made it: what was seen during a rollout then serves every update, and no picture is encoded twice."""
        self.perception.requires_grad_(False)
        self.frozen = True

    @property
    def trained(self) -> ProbabilisticTensorDictSequential:
        """The part that learners train, a policy in its own right: all of it, or what follows a frozen perception."""
        return ProbabilisticTensorDictSequential(self[1], self[2], self[3]) if self.frozen else self

    def normalise(self, chunks: Tensor, states: Tensor, floor: Tensor) -> None:
        """Set units from demonstrations: dimensions that hardly vary become constants, the rest get unit knots.

        Args:
            chunks: [N, K, 14] actions as the policy will emit them; states: [N, 16].
            floor: [14] spread below which a dimension is a constant.
        """
        with torch.no_grad():
            head = self.head
            knots = torch.linalg.pinv(head.basis) @ chunks
            spread = knots.flatten(0, 1).std(0)
            centre = chunks.flatten(0, 1).mean(0)
            active = spread > floor
            head.gain.copy_(torch.where(active, spread, 0.0))
            head.offset.copy_(torch.where(active, 0.0, centre))
            self.fusion.state_mean.copy_(states.mean(0))
            self.fusion.state_std.copy_(states.std(0).clamp(min=0.05))
