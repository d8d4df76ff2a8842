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
from actors.policies.heads import Head, varying
from actors.policies.proprioception import FEATURES, Proprioception, encoded, proprioception_keys
from envs.embodiment import Embodiment
from envs.encoders.images import MultiViewEncoder
from envs.encoders.language import TextEncoder
from envs.ranges import Count, Natural
from envs.specs import CHUNK, IMAGE, INSTRUCTION_UTF8, LOG_PROB, WorldSpec
from envs.targets import build

_TEXT_FEATURES = 32
_WORDS = 64  # of the conditioning vector, the part that encodes the instruction
_BLOCKS = 2  # residual blocks of a conditioned encoder


class Query(nn.Module):
    """The conditioning vector of the encoder, from instruction and proprioception.

    Args:
        robot: whose.
        command: see proprioception_keys.

    Forward takes bytes uint8 [B, TEXT_BYTES] and the values of `proprioception_keys`, and returns float32 [B,
    size].
    """

    size = _WORDS + FEATURES

    def __init__(self, robot: Embodiment, command: bool):
        super().__init__()
        self.words = TextEncoder(_WORDS)
        self.proprioception = Proprioception(robot, command)
        self.posture = encoded(self.proprioception.size)

    def forward(self, text: Tensor, *values: Tensor) -> Tensor:
        return torch.cat((self.words(text), self.posture(self.proprioception(*values))), -1)


class Perception(nn.Module):
    """Encodes pictures and the instruction; some key-points look where instruction and proprioception say.

    Args:
        spec: what the world shows.
        points, width, cameras, instruction_keypoints: of MultiViewEncoder.
        command: see proprioception_keys; without `instruction_keypoints` no proprioception is read.
    """

    def __init__(
        self,
        spec: WorldSpec,
        points: int,
        width: int,
        cameras: str | Sequence[str],
        instruction_keypoints: int,
        command: bool,
    ):
        super().__init__()
        cond_dim, blocks = (Query.size, _BLOCKS) if instruction_keypoints else (0, 1)
        self.views = MultiViewEncoder(
            spec,
            points,
            width,
            blocks=blocks,
            cameras=cameras,
            instruction_keypoints=instruction_keypoints,
            cond_dim=cond_dim,
        )
        self.text = TextEncoder(_TEXT_FEATURES)
        self.query = Query(spec.embodiment, command) if instruction_keypoints else None
        self.out_features = self.views.out_features + _TEXT_FEATURES
        further = self.query.proprioception.keys if self.query is not None else ()
        self.in_keys = [IMAGE, INSTRUCTION_UTF8, *further]

    def forward(self, image: Tensor, text: Tensor, *values: Tensor) -> Tensor:
        """Pictures uint8, or float in -1..1, [..., V, 3, H, W], bytes uint8 [..., TEXT_BYTES] and the further
        `in_keys` -> float32 [..., out_features].
        """
        lead, flat = image.shape[:-4], (value.flatten(0, -2) for value in (text, *values))
        return self.gaze(image.reshape(-1, *image.shape[-4:]), *flat)[0].reshape(*lead, -1)

    def gaze(self, image: Tensor, text: Tensor, *values: Tensor) -> tuple[Tensor, Tensor]:
        """Features of observations [B], and what each key-point looks for, as MultiViewEncoder.gaze."""
        cond = None if self.query is None else self.query(text, *values)
        seen, found = self.views.gaze(image, cond)
        return torch.cat((seen, self.text(text)), -1), found


class Fusion(nn.Module):
    """Joins visual features with what the robot knows of itself.

    Args:
        visual: number of visual features.
        robot: whose.
        command: see proprioception_keys.
        width: size of the output.
    """

    def __init__(self, visual: int, robot: Embodiment, command: bool, width: int):
        super().__init__()
        self.proprioception = Proprioception(robot, command)
        self.norm = nn.LayerNorm(visual)
        self.state = encoded(self.proprioception.size)
        self.mix = nn.Sequential(
            nn.Linear(visual + FEATURES, width), nn.SiLU(), nn.Linear(width, width), nn.SiLU()
        )

    def forward(self, visual: Tensor, *values: Tensor) -> Tensor:
        """float [..., visual] and the values of `proprioception_keys` -> float32 [..., width]."""
        return self.mix(torch.cat((self.norm(visual), self.state(self.proprioception(*values))), -1))


class ChunkPolicy(ProbabilisticTensorDictSequential):
    """Perception, fusion, head and its distribution as one policy with get_dist (see contract.py).

    Args:
        spec: what the world shows of which robot.
        head: config section of the action head (heads.py): `_target_` and its options.
        width: of the hidden vector.
        points, channels: key-points per view and width of the encoder.
        cameras: which it looks through: "all", "main", or names.
        instruction_keypoints: key-points per view that look for what the instruction names; the encoder is
            then conditioned on instruction and proprioception.
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
        instruction_keypoints: Natural,
        command: bool,
    ):
        eyes = Perception(spec, points, channels, cameras, instruction_keypoints, command)
        perception = TensorDictModule(eyes, in_keys=eyes.in_keys, out_keys=[VISUAL_FEATURES])
        fusion = TensorDictModule(
            Fusion(eyes.out_features, spec.embodiment, command, width),
            in_keys=[VISUAL_FEATURES, *proprioception_keys(spec.embodiment, command)],
            out_keys=[POLICY_FEATURES],
        )
        action_head: Head = build(head, "policy.head", width=width, chunk=spec.chunk, actions=spec.action_dim)
        size = (action_head.chunk, action_head.actions)
        if size != (spec.chunk, spec.action_dim):
            raise ValueError(
                f"policy.head says chunks of {size[0]} x {size[1]} numbers, but {spec.embodiment.robot} takes"
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
        return self.fusion(seen, *(observed[key] for key in self.fusion.proprioception.keys))

    @property
    def instruction_keypoints(self) -> int:
        """Key-points per view, the last ones, that look for what the instruction names."""
        queried = self.perception.views.queried
        return queried.points if queried is not None else 0

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
        return self.fusion(seen, *(observed[key] for key in self.fusion.proprioception.keys)), found

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
            chunks: [N, K, A] as the policy will emit them; states: [N, S]; commands: [N, A] in force; on any
                device.
        """
        device = next(self.head.parameters()).device
        chunks, states, commands = (values.to(device) for values in (chunks, states, commands))
        self.head.normalise(chunks, varying(chunks, self.spec.embodiment))
        parts, query = [self.fusion.proprioception], self.perception.query
        for part in parts if query is None else [*parts, query.proprioception]:
            part.normalise(*(states, commands)[: len(part.keys)])

    @property
    def constants(self) -> list[str]:
        """Names of the numbers of an action that it always says the same of."""
        pairs = zip(self.spec.embodiment.action_names, self.head.varies.tolist(), strict=True)
        return [name for name, varies in pairs if not varies]

    def scale_exploration(self, width: float, share: float) -> None:
        """Multiply how widely chunks are drawn around the mode, which stays, and draw that share of them."""
        self.head.scale_exploration(width, share)

    @property
    def exploration(self) -> float:
        """See Head.exploration."""
        return self.head.exploration

    def imitation_loss(self, observed: TensorDictBase, chunks: Tensor) -> Tensor:
        """The head's loss of imitating chunks [B, K, A] from observations [B]."""
        return self.head.error(self.policy_features(observed), self.head.target(chunks))
