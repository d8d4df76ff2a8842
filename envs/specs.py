"""Names that every part of Worldloop shares: TensorDict keys, what a world shows, how chunks are meant,
rewards.

Keys are those of TorchRL's VLA stack (torchrl.data.vla) where one exists, so that its policies and losses
plug in. B is a batch of episodes, K the actions of a chunk, V cameras, A numbers of an action, S of a state
(embodiment.py).
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import Enum

import torch
from torch import Tensor
from torchrl.data.vla import ACTION_CHUNK_KEY, IMAGE_KEY, INSTRUCTION_KEY, STATE_KEY

from envs.embodiment import ActionKind, Embodiment
from envs.ranges import NonNegative

log = logging.getLogger(__name__)
_known_cut: set[str] = set()  # instructions that this process has warned of

CHUNK = ACTION_CHUNK_KEY  # ("vla_action", "chunk") float32 [B, K, A]
LOG_PROB = ("vla_action", "log_probs")  # float32 [B]
IMAGE = IMAGE_KEY  # ("observation", "image") uint8 [B, V, 3, H, W]: the last frame of each view
STATE = STATE_KEY  # ("observation", "state") float32 [B, S]
INSTRUCTION = (
    INSTRUCTION_KEY  # "language_instruction": text, made from INSTRUCTION_UTF8 for whoever reads text
)
# uint8 [B, TEXT_BYTES]: the same text, as rollouts carry it
INSTRUCTION_UTF8 = ("observation", "instruction_utf8")
# float32 [B, A]: the last action taken; of absolute actions the one in force
COMMAND = ("observation", "command")
# bool [B, 1]: the policy said NaN; nobody may learn from the episode
INVALID_ACTION = ("policy", "invalid_action")
INTRINSIC = ("camera", "intrinsic")  # float32 [B, V, 3, 3] pixels; zeros where a camera is not calibrated
C2W = ("camera", "c2w")  # float32 [B, V, 4, 4] camera to world, OpenCV convention; zeros alike
EPISODE = "episode_seed"  # int64 [B, 1]: episodes with equal seeds start from the same frame
SUCCESS = "success"  # bool [B, 1]
PROGRESS = "progress"  # float32 [B, 1] in 0..1
LOST = "lost"  # bool [B, 1], in physics only: it crashes in this episode, which nobody learns from or counts
JUDGE_STATUS = "judge_status"  # int64 [B, 1], see Status
COMMANDS = "commands"  # float32 [B, K, A], what a chunk comes to, on the inverse path only
POSE_MAP = "pose_map"  # uint8 [B, K, V, 3, H, W], on the inverse path only
CHUNK_C2W = "chunk_c2w"  # float32 [B, K, V, 4, 4], on the inverse path only
FRAMES = ("world", "frames")  # uint8 [B, K, V, 3, H, W], between simulator and transforms only
FEATURES = ("world", "features")  # float32 [B, F], between simulator and transforms only

TEXT_BYTES = 256  # of an instruction; longer ones are cut


class Status(Enum):
    """What a judgement is worth. ERROR is never a zero reward: the episode is dropped and counted."""

    OK = 0
    ABSTAIN = 1
    ERROR = 2


class ActionMode(str, Enum):
    """How the numbers of a policy's chunk are meant.

    RELATIVE: offsets from the command in force when the chunk begins, number by number; for absolute actions
    only. ABSOLUTE: commands as the robot takes them (for a robot whose actions are deltas: those deltas).
    """

    RELATIVE = "relative"
    ABSOLUTE = "absolute"


@dataclass(frozen=True)
class WorldSpec:
    """What a world shows of which robot, and how it is conditioned; simulators, judges and policies are built
    from it.

    Args:
        embodiment: the robot.
        size: (height, width) of every view in pixels, to which pictures are brought on reading.
        chunk: actions, and so frames, per step, K.
        pose_map: whether commanded grippers are drawn into each calibrated view, of which there must be one;
            needs known flange poses. The maps of other views stay bare.
        ray_map: whether networks are told where each pixel of calibrated views looks, of which there must be
            one; the maps of other views are zeros.

    Raises:
        ValueError: if the embodiment does not allow the conditioning.
    """

    embodiment: Embodiment
    size: tuple[int, int]
    chunk: int
    pose_map: bool = False
    ray_map: bool = False

    def __post_init__(self) -> None:
        robot = self.embodiment
        if (self.pose_map or self.ray_map) and not robot.calibrated:
            raise ValueError(
                f"simulator.pose_map and simulator.ray_map need a calibrated camera, and none of"
                f" {list(robot.views)} of {robot.robot} is; set both to false"
            )
        # Joint commands without kinematics pass: recordings and clients may bring the poses along.
        if self.pose_map and not robot.commands_poses and robot.action_kind is not ActionKind.JOINTS:
            raise ValueError(
                f"simulator.pose_map needs end-effector poses, which the actions of {robot.robot} do not"
                " say; set simulator.pose_map=false, or simulator.kinematics for joint commands"
            )

    @property
    def views(self) -> int:
        """Number of cameras, V."""
        return len(self.embodiment.cameras)

    @property
    def fps(self) -> float:
        """Frames per second."""
        return self.embodiment.fps

    @property
    def action_dim(self) -> int:
        """Numbers of an action, A."""
        return self.embodiment.action_dim

    @property
    def state_dim(self) -> int:
        """Numbers of a state, S."""
        return self.embodiment.state_dim


def to_commands(chunk: Tensor, command: Tensor, mode: ActionMode) -> Tensor:
    """Commands [..., K, A] of a policy's chunk [..., K, A], given the command in force [..., A]."""
    return chunk if mode is ActionMode.ABSOLUTE else chunk + command.unsqueeze(-2)


def to_chunk(commands: Tensor, command: Tensor, mode: ActionMode) -> Tensor:
    """The inverse of `to_commands`."""
    return commands if mode is ActionMode.ABSOLUTE else commands - command.unsqueeze(-2)


def at_rest(commands: Tensor, embodiment: Embodiment) -> Tensor:
    """Commands [..., A] by which a robot whose last ones these were stays as it is: absolute ones are held,
    changes and velocities are 0 (Embodiment.changes).
    """
    moves = torch.zeros(embodiment.action_dim, dtype=torch.bool, device=commands.device)
    moves[list(embodiment.changes)] = True
    return torch.where(moves, 0.0, commands)


def check_chunk(chunk: Tensor, embodiment: Embodiment) -> None:
    """Refuse chunks of the wrong width or with NaN.

    Raises:
        ValueError: naming what is wrong.
    """
    if chunk.shape[-1] != embodiment.action_dim:
        raise ValueError(
            f"an action chunk of {embodiment.robot} is [..., K, {embodiment.action_dim}]"
            f" = {list(embodiment.action_names)}, got {tuple(chunk.shape)}"
        )
    if not torch.isfinite(chunk).all():
        bad = int((~torch.isfinite(chunk)).sum())
        raise ValueError(
            f"an action chunk holds {bad} values that are NaN or infinite; the policy has diverged"
        )


def memory_indices(length: Tensor, count: int, newest: int = 1) -> Tensor:
    """Which of the first `length` [...] frames are remembered, [..., count]: the `newest` ones, 1 to count,
    and others that are evenly spread over those before, the first included. Where there are too few, some
    repeat.
    """
    # of the newest ones the oldest is the end of what is evenly spread
    share = torch.linspace(0, 1, count - newest + 1, dtype=torch.float64, device=length.device)
    spread = share if newest < count else torch.ones_like(share)
    last = length.unsqueeze(-1) - 1
    back = torch.arange(newest - 2, -1, -1, device=length.device)
    before = ((last - newest + 1).clamp(min=0) * spread).round().long()
    return torch.cat([before, (last - back).clamp(min=0)], -1)


def text_to_bytes(texts: Sequence[str]) -> Tensor:
    """Texts as uint8 [N, TEXT_BYTES], UTF-8 padded with zeros; longer ones are cut at a character."""
    out = torch.zeros(len(texts), TEXT_BYTES, dtype=torch.uint8)
    for row, text in zip(out, texts, strict=True):
        raw = text.encode()[:TEXT_BYTES].decode(errors="ignore").encode()
        row[: len(raw)] = torch.tensor(list(raw), dtype=torch.uint8)
    return out


def warn_of_cut(instructions: Iterable[str]) -> None:
    """Warn, once in a process, of instructions that text_to_bytes cuts."""
    cut = {text for text in instructions if len(text.encode()) > TEXT_BYTES} - _known_cut
    if cut:
        _known_cut.update(cut)
        log.warning(
            "%d instructions, the first of them %.60r..., have more than %d bytes; only so many are read"
            " by policies, judges and worlds, so texts that differ later are the same to them",
            *(len(cut), min(cut), TEXT_BYTES),
        )


def bytes_to_text(rows: Tensor) -> list[str]:
    """The inverse of `text_to_bytes` for uint8 [N, TEXT_BYTES]."""
    return [bytes(row).rstrip(b"\0").decode() for row in rows.cpu().numpy()]


@dataclass(frozen=True)
class Rewards:
    """One reward for both worlds: progress gained in the chunk, plus a bonus when the episode succeeds.

    Args:
        progress: weight of the change of progress; summed over an episode it telescopes, so it cannot be
            farmed.
        success: bonus at success.
    """

    progress: NonNegative
    success: NonNegative

    def __call__(self, before: Tensor, after: Tensor, success: Tensor) -> Tensor:
        """Reward float32 [..., 1] from progress before and after [..., 1] and success bool [..., 1]."""
        return self.progress * (after - before) + self.success * success.to(after.dtype)
