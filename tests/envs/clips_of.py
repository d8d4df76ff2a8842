"""Random training clips and first frames of any world, to feed engines with."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torch import Tensor

from envs.specs import WorldSpec, memory_indices
from tests.embodiments import camera_poses, intrinsics


def frames_of(spec: WorldSpec, *shape: int, seed: int = 0) -> Tensor:
    """Smooth random pictures uint8 [*shape, V, 3, H, W]."""
    g = torch.Generator().manual_seed(seed)
    height, width = spec.size
    small = torch.rand(*shape, spec.views, 3, height // 8, width // 8, generator=g)
    return (small.repeat_interleave(8, -1).repeat_interleave(8, -2) * 255).to(torch.uint8)


def _maps(spec: WorldSpec, *shape: int, seed: int = 0) -> dict[str, Tensor]:
    maps = {"pose_map": frames_of(spec, *shape, seed=seed)} if spec.pose_map else {}
    return maps | ({"c2w": camera_poses(spec, *shape)} if spec.embodiment.calibrated else {})


def first_of(spec: WorldSpec, batch: int, seed: int = 0) -> TensorDict:
    """What Simulator.reset takes, [batch]."""
    g = torch.Generator().manual_seed(seed)
    first = TensorDict(
        {
            "frames": frames_of(spec, batch, seed=seed),
            "command": torch.randn(batch, spec.action_dim, generator=g),
            "state": torch.randn(batch, spec.state_dim, generator=g),
            **_maps(spec, batch, seed=seed + 1),
        },
        [batch],
    )
    if spec.embodiment.calibrated:
        first["intrinsic"] = intrinsics(spec, batch)
    return first


def future_of(spec: WorldSpec, batch: int, seed: int = 0) -> TensorDict:
    """What Simulator.step takes, [batch]."""
    g = torch.Generator().manual_seed(seed)
    commands = torch.randn(batch, spec.chunk, spec.action_dim, generator=g)
    return TensorDict({"commands": commands, **_maps(spec, batch, spec.chunk, seed=seed + 1)}, [batch])


def clip_of(spec: WorldSpec, batch: int, memory: int, chunks: int = 1, seed: int = 0) -> TensorDict:
    """A clip [batch] as ClipStore.clips gives it, of episodes that begin with it."""
    g = torch.Generator().manual_seed(seed)
    count = chunks * spec.chunk
    lengths = 1 + spec.chunk * torch.arange(chunks)
    index = memory_indices(lengths, memory)
    clip = TensorDict(
        {
            "memory": TensorDict(
                {
                    "index": index.expand(batch, -1, -1).clone(),
                    "frames": frames_of(spec, batch, chunks, memory, seed=seed),
                    "commands": torch.randn(batch, chunks, memory, spec.action_dim, generator=g),
                    **_maps(spec, batch, chunks, memory, seed=seed + 1),
                },
                [batch],
            ),
            "future": TensorDict(
                {
                    "frames": frames_of(spec, batch, count, seed=seed + 2),
                    "commands": torch.randn(batch, count, spec.action_dim, generator=g),
                    "states": torch.randn(batch, count, spec.state_dim, generator=g),
                    "valid": torch.ones(batch, count, dtype=torch.bool),
                    **_maps(spec, batch, count, seed=seed + 3),
                },
                [batch, count],
            ),
            "now": TensorDict(
                {
                    "command": torch.randn(batch, spec.action_dim, generator=g),
                    "state": torch.randn(batch, spec.state_dim, generator=g),
                },
                [batch],
            ),
            "history": TensorDict(
                {
                    "commands": torch.randn(batch, memory, spec.action_dim, generator=g),
                    "states": torch.randn(batch, memory, spec.state_dim, generator=g),
                },
                [batch],
            ),
            "begin": torch.zeros(batch, dtype=torch.int64),
        },
        [batch],
    )
    if spec.embodiment.calibrated:
        clip["intrinsic"] = intrinsics(spec, batch)
    return clip
