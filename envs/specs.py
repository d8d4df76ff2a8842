"""Names and layouts that every part of Worldloop shares: TensorDict keys, action and state layouts, rewards.

Keys are those of TorchRL's VLA stack (torchrl.data.vla) where one exists, so that its policies and losses
plug in.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import torch
import torch.nn.functional as F
from torch import Tensor
from torchrl.data.vla import ACTION_CHUNK_KEY, IMAGE_KEY, STATE_KEY

from envs.layouts import CommandLayout

# [x, y, z, roll, pitch, yaw, gripper] of the left, then the right arm; metres, radians, 0 open..1 closed
ACTION_DIM = 14
# [x, y, z, heading] of a thing; metres, and radians about the vertical; what is not known is NaN
OBJECT_DIM = 4
STATE_DIM = 16  # [left joints 7, left gripper, right joints 7, right gripper]; radians, 0 open..1 closed

CHUNK = ACTION_CHUNK_KEY  # ("vla_action", "chunk") float32 [B, K, 14]
LOG_PROB = ("vla_action", "log_probs")  # float32 [B]
# bool [B, 1]: the policy said NaN, and rested instead; nobody may learn from the episode
INVALID_ACTION = ("policy", "invalid_action")
IMAGE = IMAGE_KEY  # ("observation", "image") uint8 [B, V, 3, H, W]: the last frame of each view
STATE = STATE_KEY  # ("observation", "state") float32 [B, 16]
COMMAND = ("observation", "command")  # float32 [B, 14]: the absolute command now in force
TOKENS = ("observation", "tokens")  # int64 [B, WORDS]: the instruction as numbers (language.tokenize)
INTRINSIC = ("camera", "intrinsic")  # float32 [B, V, 3, 3] pixels
C2W = ("camera", "c2w")  # float32 [B, V, 4, 4] camera to world, OpenCV convention, at the last frame
EPISODE = "episode_seed"  # int64 [B, 1]: episodes with equal seeds start from the same frame
SUCCESS = "success"  # bool [B, 1]
PROGRESS = "progress"  # float32 [B, 1] in 0..1
JUDGE_STATUS = "judge_status"  # int64 [B, 1], see Status
COMMANDS = "commands"  # float32 [B, K, 14] absolute, on the inverse path only
POSE_MAP = "pose_map"  # uint8 [B, K, V, 3, H, W], on the inverse path only
CHUNK_C2W = "chunk_c2w"  # float32 [B, K, V, 4, 4], on the inverse path only
FRAMES = ("world", "frames")  # uint8 [B, K, V, 3, H, W], between simulator and transforms only
FEATURES = ("world", "features")  # float32 [B, F], between simulator and transforms only


class Status(Enum):
    """What a judge says of its own verdict; ERROR is never a zero reward, the episode is dropped and counted."""

    OK = 0
    ABSTAIN = 1
    ERROR = 2


class ActionMode(str, Enum):
    """How the numbers of a chunk are meant.

    RELATIVE: offsets from the command in force when the chunk starts, added number by number (Euler angles
    and grippers too).
    ABSOLUTE: end-effector poses in the world frame.
    """

    RELATIVE = "relative"
    ABSOLUTE = "absolute"


def to_absolute(chunk: Tensor, command: Tensor, mode: ActionMode) -> Tensor:
    """Absolute commands [..., K, 14] of a chunk [..., K, 14], given the command in force [..., 14]."""
    if mode is ActionMode.ABSOLUTE:
        return chunk
    return chunk + command.unsqueeze(-2)


def to_relative(commands: Tensor, command: Tensor) -> Tensor:
    """The inverse of `to_absolute` for ActionMode.RELATIVE."""
    return commands - command.unsqueeze(-2)


def check_chunk(chunk: Tensor, layout: CommandLayout = CommandLayout.EEF) -> None:
    """Refuse chunks of the wrong width or with NaN.

    Raises:
        ValueError: naming what is wrong.
    """
    if chunk.shape[-1] != layout.size:
        raise ValueError(
            f"an action chunk is [..., K, {layout.size}] = {'[x,y,z,roll,pitch,yaw,g]x2' if layout is CommandLayout.EEF else '[L7,Lg,R7,Rg]'}, got {tuple(chunk.shape)}"
        )
    if not torch.isfinite(chunk).all():
        bad = int((~torch.isfinite(chunk)).sum())
        raise ValueError(
            f"an action chunk holds {bad} values that are NaN or infinite; the policy has diverged"
        )


@dataclass(frozen=True)
class Rewards:
    """One reward for both worlds: progress gained in the chunk, plus a bonus when the episode succeeds.

    Args:
        progress: weight of the change of progress; summed over an episode it telescopes, so it cannot be
            farmed.
        success: bonus at success.
    """

    progress: float = 1.0
    success: float = 1.0

    def __call__(self, before: Tensor, after: Tensor, success: Tensor) -> Tensor:
        """Reward float32 [..., 1] from progress before and after [..., 1] and success bool [..., 1]."""
        return self.progress * (after - before) + self.success * success.to(after.dtype)


def first_objects(objects: Tensor, count: int) -> Tensor:
    """The first `count` of objects [..., N, OBJECT_DIM], NaN where there are fewer, [..., count, OBJECT_DIM]."""
    kept = objects[..., :count, :]
    return F.pad(kept, (0, 0, 0, count - kept.shape[-2]), value=torch.nan)
