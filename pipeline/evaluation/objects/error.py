"""How far the first object strays in generated video, where physics recorded its pose and the main camera is
calibrated and stands still.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from envs.episodes.clips import ClipStore
from envs.episodes.privileged import read_privileged
from envs.geometry.cameras import project
from envs.simulators.replay import Replay
from pipeline.evaluation.objects.locator import locate
from pipeline.evaluation.objects.rays import on_plane
from pipeline.evaluation.quantiles import quantiles

POSES = "object_poses"  # privileged: [O, n], for every object x, y, z in metres and what else a suite knows


def object_error(store: ClipStore, episodes: Tensor, made: Replay, truth: Tensor) -> dict[str, Any]:
    """Error of the object's place in generated against true video, as one colour locator sees both; see
    `object_offsets` and `object_summary`.
    """
    return object_summary([object_offsets(store, episodes, made, truth)])


def object_offsets(store: ClipStore, episodes: Tensor, made: Replay, truth: Tensor) -> dict[str, Tensor]:
    """How far off the object is in each frame in which the locator finds it in true video, [n] each.

    Args:
        truth: uint8 [N, T, V, 3, H, W], the true frames beside made.frames.

    Returns:
        pixels and cm in generated and locator_px in true video, float32; lost, not found in generated video,
        and at_end, the episode's last frame, bool; {} where this cannot be measured: without calibration,
        without the column, or where it has no row of positions per object.
    """
    view = store.spec.embodiment.main_view
    if not store.spec.embodiment.calibrated or store.spec.embodiment.cameras[view].wrist is not None:
        return {}
    poses = read_privileged(store, POSES)
    if poses is None or poses.ndim != 3 or poses.shape[-1] < 3:
        return {}
    places = poses[:, 0, :3]
    start = store.start[episodes]
    first = store.frames(start)[:, view]
    intrinsic, c2w = store.intrinsic[episodes][:, view], store.arrays["c2w"][start][:, view]
    found, lost = locate(made.frames[:, :, view], first, places[start], intrinsic, c2w)
    seen, hidden = locate(truth[:, :, view], first, places[start], intrinsic, c2w)
    true, _ = project(places[made.rows], intrinsic, c2w)
    height = places[start][:, None, None, 2].expand(-1, found.shape[1], 1)
    metres = (on_plane(found, height, intrinsic, c2w) - places[made.rows])[..., :2].norm(dim=-1)
    ends = torch.zeros_like(made.valid)
    ends[torch.arange(len(ends)), made.valid.long().cumsum(1).argmax(1)] = True
    use = made.valid & ~hidden  # where the locator fails on true video it says nothing of generated video
    every = {
        "pixels": (found - true).norm(dim=-1),
        "cm": metres * 100,
        "locator_px": (seen - true).norm(dim=-1),
        "lost": lost,
        "at_end": ends,
    }
    return {name: values[use] for name, values in every.items()}


def object_summary(parts: Sequence[Mapping[str, Tensor]]) -> dict[str, Any]:
    """What the `object_offsets` of some episodes come to, those of all parts in one.

    Returns:
        object_px and object_cm (median, 90th percentile over the frames in which it was found), their
        object_cm_at_end, object_lost (share of the frames that truly show it), and locator_px, the locator's
        own error on true video; {} where nothing was measured.
    """
    known = [part for part in parts if part and len(part["lost"])]
    if not known:
        return {}
    whole = {name: torch.cat([part[name] for part in known]) for name in known[0]}
    there = ~whole["lost"]
    return {
        "object_px": quantiles(whole["pixels"][there]),
        "object_cm": quantiles(whole["cm"][there]),
        "object_cm_at_end": quantiles(whole["cm"][there & whole["at_end"]]),
        "object_lost": float(whole["lost"].float().mean()),
        "locator_px": quantiles(whole["locator_px"]),
    }
