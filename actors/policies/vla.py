"""The small vision-language-action policy: all views, the robot's state and the instruction in, a
distribution over chunks out.

Perception, fusion and head are modules of their own: heads (heads.py) are a choice, and RL may leave
perception as it is.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictModule, ProbabilisticTensorDictSequential, TensorDictModule
from torch import Tensor, nn

from actors.policies.contract import POLICY_FEATURES, VISUAL_FEATURES
from actors.policies.heads import RESOLUTION, Head, varying
from envs.embodiment import Embodiment
from envs.encoders import MultiViewEncoder
from envs.language import TextEncoder
from envs.ranges import Count, Natural
from envs.specs import CHUNK, COMMAND, IMAGE, INSTRUCTION_UTF8, LOG_PROB, STATE, WorldSpec
from envs.targets import build

_TEXT_FEATURES = 32
_BODY_FEATURES = 64
_WORDS = 64  # numbers of the instruction that say what key-points shall look for
_BLOCKS = 2  # residual blocks of an encoder whose features hang on what it is told


def body_keys(robot: Embodiment, command: bool) -> tuple[NestedKey, ...]:
    """What a policy reads of the robot itself: its state and, if asked to, the command in force.

    Chunks may be meant relative to that, and it is exact where states are measured or imagined. Of commands
    that are changes, the one in force says only what was done last, which imitation would copy: it is not
    read.
    """
    return (STATE, COMMAND) if command and not robot.delta else (STATE,)


class Body(nn.Module):
    """What the robot knows of itself, in units of its own spread.

    Args:
        robot: whose.
        command: see body_keys.

    Forward takes the values of `body_keys`, float [..., S] and [..., A], and returns float32 [..., size]
    within -5..5.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, robot: Embodiment, command: bool):
        super().__init__()
        self.keys = body_keys(robot, command)
        self.size = len(robot.state_names) + (robot.action_dim if COMMAND in self.keys else 0)
        self.register_buffer("mean", torch.zeros(self.size))
        self.register_buffer("std", torch.ones(self.size))

    @torch.no_grad()
    def normalise(self, *values: Tensor) -> None:
        """Take units from values [N, S] and [N, A]; what hardly varies keeps its own."""
        joined = torch.cat(values, -1)
        spread = joined.std(0, unbiased=False)
        self.mean.copy_(joined.mean(0))
        self.std.copy_(torch.where(spread > RESOLUTION, spread, 1.0))

    def forward(self, *values: Tensor) -> Tensor:
        return ((torch.cat(values, -1) - self.mean) / self.std).clamp(-5, 5)


class Perception(nn.Module):
    """Encodes pictures and the instruction; key-points that are asked for look where the instruction and the
    robot's own body say.

    Args:
        spec: what the world shows.
        points, width, cameras, asked: of MultiViewEncoder.
        command: see body_keys; nothing of the body is read without `asked` key-points.
    """

    def __init__(
        self,
        spec: WorldSpec,
        points: int,
        width: int,
        cameras: str | Sequence[str],
        asked: int,
        command: bool,
    ):
        super().__init__()
        told, blocks = (_WORDS + _BODY_FEATURES, _BLOCKS) if asked else (0, 1)
        self.views = MultiViewEncoder(
            spec, points, width, blocks=blocks, cameras=cameras, asked=asked, told=told
        )
        self.text = TextEncoder(_TEXT_FEATURES)
        self.words = TextEncoder(_WORDS) if asked else None
        self.body = Body(spec.embodiment, command) if asked else None
        self.posture = _of_body(self.body.size) if self.body is not None else None
        self.out_features = self.views.out_features + _TEXT_FEATURES
        self.in_keys = [IMAGE, INSTRUCTION_UTF8, *(self.body.keys if self.body is not None else ())]

    def forward(self, image: Tensor, text: Tensor, *body: Tensor) -> Tensor:
        """Pictures uint8, or float in -1..1, [..., V, 3, H, W], bytes uint8 [..., TEXT_BYTES] and the further
        `in_keys` -> float32 [..., out_features].
        """
        lead, flat = image.shape[:-4], (value.flatten(0, -2) for value in (text, *body))
        return self.gaze(image.reshape(-1, *image.shape[-4:]), *flat)[0].reshape(*lead, -1)

    def gaze(self, image: Tensor, text: Tensor, *body: Tensor) -> tuple[Tensor, Tensor]:
        """Features of observations [B], and what each key-point looks for, as MultiViewEncoder.gaze."""
        told = None
        if self.words is not None and self.body is not None and self.posture is not None:
            told = torch.cat((self.words(text), self.posture(self.body(*body))), -1)
        seen, found = self.views.gaze(image, told)
        return torch.cat((seen, self.text(text)), -1), found


class Fusion(nn.Module):
    """Joins visual features with what the robot knows of itself.

    Args:
        visual: number of visual features.
        robot: whose.
        command: see body_keys.
        width: size of the output.
    """

    def __init__(self, visual: int, robot: Embodiment, command: bool, width: int):
        super().__init__()
        self.body = Body(robot, command)
        self.norm = nn.LayerNorm(visual)
        self.state = _of_body(self.body.size)
        self.mix = nn.Sequential(
            nn.Linear(visual + _BODY_FEATURES, width), nn.SiLU(), nn.Linear(width, width), nn.SiLU()
        )

    def forward(self, visual: Tensor, *body: Tensor) -> Tensor:
        """float [..., visual] and the values of `body_keys` -> float32 [..., width]."""
        return self.mix(torch.cat((self.norm(visual), self.state(self.body(*body))), -1))


def _of_body(size: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Linear(size, _BODY_FEATURES), nn.SiLU(), nn.Linear(_BODY_FEATURES, _BODY_FEATURES)
    )


class ChunkPolicy(ProbabilisticTensorDictSequential):
    """Perception, fusion, head and its distribution as one policy with get_dist (see contract.py).

    Args:
        spec: what the world shows of which robot.
        head: config section of the action head (heads.py): `_target_` and its options.
        width: of the hidden vector.
        points, channels: key-points per view and width of the encoder.
        cameras: which it looks through: "all", "main", or names.
        asked: key-points per view that look for what the instruction says, with an encoder that is told it.
        command: whether the command in force is read, of robots whose commands say places.

    Reads image, the instruction's bytes, state and, if asked to, the command in force; writes
    ("vla_action", "chunk") and its log-probability.

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
        command: bool,
    ):
        eyes = Perception(spec, points, channels, cameras, asked, command)
        perception = TensorDictModule(eyes, in_keys=eyes.in_keys, out_keys=[VISUAL_FEATURES])
        fusion = TensorDictModule(
            Fusion(eyes.out_features, spec.embodiment, command, width),
            in_keys=[VISUAL_FEATURES, *body_keys(spec.embodiment, command)],
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
            seen = self.perception(*(observed[key] for key in self.perception.in_keys))
        return self.fusion(seen, *(observed[key] for key in self.fusion.body.keys))

    @property
    def asked(self) -> int:
        """Key-points per view, the last ones, that look for what perception is told."""
        return self.perception.views.asked.points if self.perception.views.asked is not None else 0

    @property
    def views(self) -> list[int]:
        """Numbers of the cameras that it looks through."""
        return self.perception.views.chosen

    def gaze(self, observed: TensorDictBase) -> tuple[Tensor, Tensor]:
        """`policy_features` of observations [B], and what each key-point looks for: logits float32 [B, views,
        points, h, w].
        """
        eyes = self.perception
        seen, found = eyes.gaze(*(observed[key] for key in eyes.in_keys))
        return self.fusion(seen, *(observed[key] for key in self.fusion.body.keys)), found

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
    def normalise(self, chunks: Tensor, states: Tensor, commands: Tensor) -> None:
        """Take units from demonstrations; numbers that hardly vary become constants (heads.varying).

        Args:
            chunks: [N, K, A] as the policy will emit them; states: [N, S]; commands: [N, A] in force.
        """
        self.head.normalise(chunks, varying(chunks, self.spec.embodiment))
        for body in (self.fusion.body, self.perception.body):
            if body is not None:
                body.normalise(*(states, commands)[: len(body.keys)])

    def disagreement(self, one: TensorDictBase, other: TensorDictBase) -> Tensor:
        """By how much the head says something else of observations [B] than of others."""
        return self.head.apart(self.policy_features(one), self.policy_features(other))

    def imitation_loss(self, observed: TensorDictBase, chunks: Tensor) -> Tensor:
        """The head's loss of imitating chunks [B, K, A] from observations [B]."""
        return self.head.error(self.policy_features(observed), self.head.target(chunks))
