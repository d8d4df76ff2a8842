"""The small vision-language-action policy: all views, the robot's state and the instruction in, a
distribution over chunks out.

Perception, fusion and head are modules of their own: heads (heads.py) are a choice, and RL may leave
perception as it is.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictModule, ProbabilisticTensorDictSequential, TensorDictModule
from torch import Tensor, nn

from actors.policies.contract import POLICY_FEATURES, VISUAL_FEATURES
from actors.policies.heads import RESOLUTION, Head, varying
from envs.encoders import MultiViewEncoder
from envs.language import TextEncoder
from envs.ranges import Count, Natural
from envs.specs import CHUNK, IMAGE, INSTRUCTION_UTF8, LOG_PROB, STATE, WorldSpec
from envs.targets import build

_TEXT_FEATURES = 32
_STATE_FEATURES = 64
_WORDS = 64  # numbers that say what key-points shall look for


class Perception(nn.Module):
    """Encodes pictures and the instruction.

    Args:
        spec: what the world shows.
        points, width, cameras, asked: of MultiViewEncoder.
    """

    def __init__(self, spec: WorldSpec, points: int, width: int, cameras: str | Sequence[str], asked: int):
        super().__init__()
        self.views = MultiViewEncoder(spec, points, width, cameras=cameras, asked=asked, words=_WORDS)
        self.text = TextEncoder(_TEXT_FEATURES)
        self.words = TextEncoder(_WORDS) if asked else None
        self.out_features = self.views.out_features + _TEXT_FEATURES

    def forward(self, image: Tensor, text: Tensor) -> Tensor:
        """uint8, or float in -1..1, [..., V, 3, H, W] and bytes uint8 [..., TEXT_BYTES] -> float32 [...,
        out_features].
        """
        lead = image.shape[:-4]
        flat = text.reshape(-1, text.shape[-1])
        words = self.words(flat) if self.words is not None else None
        seen = self.views(image.reshape(-1, *image.shape[-4:]), words)
        said = self.text(flat)
        return torch.cat((seen, said), -1).reshape(*lead, -1)


class Fusion(nn.Module):
    """Joins visual features with the robot's state.

    Args:
        visual: number of visual features.
        states: numbers of the robot's state, S.
        width: size of the output.
    """

    state_mean: Tensor
    state_std: Tensor

    def __init__(self, visual: int, states: int, width: int):
        super().__init__()
        self.register_buffer("state_mean", torch.zeros(states))
        self.register_buffer("state_std", torch.ones(states))
        self.norm = nn.LayerNorm(visual)
        self.state = nn.Sequential(
            nn.Linear(states, _STATE_FEATURES), nn.SiLU(), nn.Linear(_STATE_FEATURES, _STATE_FEATURES)
        )
        self.mix = nn.Sequential(
            nn.Linear(visual + _STATE_FEATURES, width), nn.SiLU(), nn.Linear(width, width), nn.SiLU()
        )

    def forward(self, visual: Tensor, state: Tensor) -> Tensor:
        """float [..., visual], float [..., S] -> float32 [..., width]."""
        proprio = ((state - self.state_mean) / self.state_std).clamp(-5, 5)
        return self.mix(torch.cat((self.norm(visual), self.state(proprio)), -1))


class ChunkPolicy(ProbabilisticTensorDictSequential):
    """Perception, fusion, head and its distribution as one policy with get_dist (see contract.py).

    Args:
        spec: what the world shows of which robot.
        head: config section of the action head (heads.py): `_target_` and its options.
        width: of the hidden vector.
        points, channels: key-points per view and width of the encoder.
        cameras: which it looks through: "all", "main", or names.
        asked: key-points per view that look for what the instruction says.

    Reads image, state and the instruction's bytes; writes ("vla_action", "chunk") and its log-probability.

    Raises:
        ConfigError: if the head cannot be built.
        ValueError: if it says chunks of another size than the robot takes.
    """

    def __init__(
        self,
        spec: WorldSpec,
        head: Mapping[str, Any],
        width: Count,
        points: Count,
        channels: Count,
        cameras: str | Sequence[str],
        asked: Natural,
    ):
        eyes = Perception(spec, points, channels, cameras, asked)
        perception = TensorDictModule(eyes, in_keys=[IMAGE, INSTRUCTION_UTF8], out_keys=[VISUAL_FEATURES])
        fusion = TensorDictModule(
            Fusion(eyes.out_features, spec.state_dim, width),
            in_keys=[VISUAL_FEATURES, STATE],
            out_keys=[POLICY_FEATURES],
        )
        action_head: Head = build(head, "policy.head", width=width, chunk=spec.chunk, actions=spec.action_dim)
        says = (action_head.chunk, action_head.actions)
        if says != (spec.chunk, spec.action_dim):
            raise ValueError(
                f"policy.head says chunks of {says[0]} x {says[1]} numbers, but {spec.embodiment.robot} takes"
                f" {spec.chunk} x {spec.action_dim}; a head must use the chunk and actions that it is given"
            )
        parameters = TensorDictModule(
            action_head,
            in_keys=[POLICY_FEATURES],
            out_keys=[("policy", name) for name in action_head.names],
        )
        sampler = ProbabilisticTensorDictModule(
            in_keys={name: ("policy", name) for name in action_head.names},
            out_keys=[CHUNK],
            distribution_class=action_head.distribution,
            return_log_prob=True,
            log_prob_key=LOG_PROB,
        )
        super().__init__(perception, fusion, parameters, sampler)
        self.spec, self.width, self.frozen = spec, width, False

    @property
    def perception(self) -> Perception:
        """What encodes pictures and instruction."""
        return self[0].module

    @property
    def encoder(self) -> TensorDictModule:
        """Perception as a module that writes ("policy", "visual_features")."""
        return self[0]

    @property
    def fusion(self) -> Fusion:
        """What joins them with the robot's state."""
        return self[1].module

    @property
    def head(self) -> Head:
        """What says chunks."""
        return self[2].module

    @property
    def visual_dim(self) -> int:
        """Numbers of ("policy", "visual_features")."""
        return self.perception.out_features

    def policy_features(self, observed: TensorDictBase) -> Tensor:
        """What perception and fusion make of observations [B], or of their visual features if those are
        given: float32 [B, width].
        """
        seen = observed.get(VISUAL_FEATURES, None)
        if seen is None:
            seen = self.perception(observed[IMAGE], observed[INSTRUCTION_UTF8])
        return self.fusion(seen, observed[STATE])

    @property
    def trained(self) -> ProbabilisticTensorDictSequential:
        """The part that learners train, a policy in its own right: all of it, or what follows a frozen
        perception.
        """
        return ProbabilisticTensorDictSequential(self[1], self[2], self[3]) if self.frozen else self

    def freeze_perception(self) -> None:
        """Leave perception as imitation made it: what it made of a rollout then serves every update, and no
        picture is encoded twice.
        """
        self.perception.requires_grad_(False)
        self.frozen = True

    @torch.no_grad()
    def normalise(self, chunks: Tensor, states: Tensor) -> None:
        """Take units from demonstrations; numbers that hardly vary become constants (heads.varying).

        Args:
            chunks: [N, K, A] as the policy will emit them; states: [N, S].
        """
        self.head.normalise(chunks, varying(chunks, self.spec.embodiment))
        spread = states.std(0, unbiased=False)
        self.fusion.state_mean.copy_(states.mean(0))
        self.fusion.state_std.copy_(torch.where(spread > RESOLUTION, spread, 1.0))

    def disagreement(self, one: TensorDictBase, other: TensorDictBase) -> Tensor:
        """By how much the head says something else of observations [B] than of others."""
        return self.head.apart(self.policy_features(one), self.policy_features(other))

    def imitation_loss(self, observed: TensorDictBase, chunks: Tensor) -> Tensor:
        """The head's loss of imitating chunks [B, K, A] from observations [B]."""
        return self.head.error(self.policy_features(observed), self.head.target(chunks))
