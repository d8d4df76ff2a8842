"""Training clips of any robot, made up: a bright square that moves by the first number of the action."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torch import Tensor

from envs.specs import WorldSpec, memory_indices
from tests.embodiments import camera_poses, intrinsics


def moving_square(spec: WorldSpec, place: Tensor) -> Tensor:
    """Frames uint8 [*, V, 3, H, W] with a bright square whose middle column is `place` [*] (0..1) of the
    width.
    """
    height, width = spec.size
    column = torch.arange(width) / width
    inside = ((column - place[..., None]).abs() < 0.15)[..., None, :].expand(*place.shape, height, width)
    frame = 40 + 160 * inside.to(torch.uint8)
    return frame[..., None, None, :, :].expand(*place.shape, spec.views, 3, height, width).contiguous()


def blocks(shape: torch.Size, generator: torch.Generator) -> Tensor:
    """Random pictures uint8 [*, H, W] in blocks of 8 x 8 pixels, which JPEG keeps."""
    *lead, height, width = shape
    small = torch.randint(0, 255, (*lead, -(-height // 8), -(-width // 8)), generator=generator)
    return small.repeat_interleave(8, -2).repeat_interleave(8, -1)[..., :height, :width].to(torch.uint8)


def clip(spec: WorldSpec, batch: int, memory: int, chunks: int = 1, seed: int = 0) -> TensorDict:
    """A clip [batch] as ClipStore.clips gives it; the square moves by a twentieth of the action's first
    number, and the task is done in the right half. Nobody labelled every third episode. It is learned from in
    the middle.
    """
    generator = torch.Generator().manual_seed(seed)
    total, begin = chunks * spec.chunk, 2
    length = begin + 1 + total
    commands = torch.randn(batch, length, spec.action_dim, generator=generator)
    place = (0.5 + 0.05 * commands[..., 0].cumsum(1)).clamp(0.1, 0.9)
    frames, states = (
        moving_square(spec, place),
        torch.randn(batch, length, spec.state_dim, generator=generator),
    )
    arrays: dict[str, Tensor] = {"frames": frames, "commands": commands, "states": states}
    if spec.embodiment.calibrated:
        arrays["c2w"] = camera_poses(spec, batch, length)
    if spec.pose_map:
        arrays["pose_map"] = blocks(frames.shape, generator)
    index = memory_indices(begin + 1 + spec.chunk * torch.arange(chunks), memory).expand(batch, -1, -1)
    rows = torch.arange(batch)[:, None, None]
    maps = [name for name in ("pose_map", "c2w") if name in arrays]
    out = TensorDict(
        {
            "memory": TensorDict(
                {
                    "index": index,
                    "present": torch.ones(index.shape, dtype=torch.bool),
                    **{name: arrays[name][rows, index] for name in ("frames", "commands", *maps)},
                },
                [batch],
            ),
            "future": TensorDict({name: value[:, begin + 1 :] for name, value in arrays.items()}, [batch]),
            "now": TensorDict({"command": commands[:, begin], "state": states[:, begin]}, [batch]),
            "history": TensorDict(
                {"commands": commands[:, : begin + 1], "states": states[:, : begin + 1]}, [batch]
            ),
            "begin": torch.full((batch,), begin),
            "stride": torch.ones(batch, dtype=torch.int64),
            "depth": torch.full((batch,), 0.5),
        },
        [batch],
    )
    out["future", "valid"] = torch.ones(batch, total, dtype=torch.bool)
    success = torch.where(place[:, begin + 1 :] > 0.5, 1.0, 0.0)
    out["future", "success"] = torch.where(torch.arange(batch)[:, None] % 3 == 2, torch.nan, success)
    if spec.embodiment.calibrated:
        out["intrinsic"] = intrinsics(spec, batch)
    return out


def first_of(spec: WorldSpec, clips: TensorDict) -> TensorDict:
    """What Simulator.reset takes, from the clips' first remembered frames."""
    memory = clips["memory"][:, 0]
    names = {"frames": "frames", "commands": "command", "pose_map": "pose_map", "c2w": "c2w"}
    first = TensorDict(
        {new: memory[old][:, 0] for old, new in names.items() if old in memory.keys()}, clips.shape
    )
    first["state"] = clips["now", "state"]
    if "intrinsic" in clips.keys():
        first["intrinsic"] = clips["intrinsic"]
    return first


def future_of(spec: WorldSpec, clips: TensorDict, number: int = 0) -> TensorDict:
    """What Simulator.step takes, for chunk `number` of the clips."""
    part = slice(number * spec.chunk, (number + 1) * spec.chunk)
    names = [name for name in ("commands", "pose_map", "c2w") if name in clips["future"].keys()]
    return TensorDict({name: clips["future", name][:, part] for name in names}, clips.shape)


def history_of(clips: TensorDict, frames: int) -> TensorDict:
    """The newest frames [B, frames, n] of the clips' history, whose first is repeated if it has fewer."""
    missing = max(0, frames - clips["history", "commands"].shape[1])
    told = {
        name: torch.cat([value[:, :1].expand(-1, missing, -1), value[:, -frames:]], 1)
        for name, value in clips["history"].items()
    }
    return TensorDict(told, clips.shape)
