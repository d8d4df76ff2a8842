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
from pipeline.evaluation.objects.locator import follow
from pipeline.evaluation.objects.rays import on_plane
from pipeline.evaluation.statistics import quantiles

POSES = "object_poses"  # privileged: [O, n], for every object x, y, z in metres and what else a suite knows
_NAMES = (("pixels", "cm"), ("locator_px", "locator_cm"))  # of errors in generated and in true video
_BAR = 1 / 16  # of the picture's shorter side: an error of more in true video is a failure of the locator
_FAILS = 0.1  # share of failures above which it measures nothing


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
        pixels and cm in generated, locator_px and locator_cm in true video, float32; lost, not found in
        generated video, failed, found too far off in true video, and at_end, the episode's last frame, bool.
        Centimetres are those in the plane of the object's true height. {} where this cannot be measured:
        without calibration, without the column, or where it has no row of positions per object.
    """
    view = store.spec.embodiment.main_view
    camera = store.spec.embodiment.cameras[view]
    if not camera.calibrated or camera.wrist is not None:
        return {}
    poses = read_privileged(store, POSES)
    if poses is None or poses.ndim != 3 or poses.shape[-1] < 3:
        return {}
    start = store.start[episodes]
    places = poses[torch.cat((start[:, None], made.rows), 1), 0, :3]  # [N, 1 + T, 3]
    first = store.frames(start)[:, view]
    intrinsic, c2w = store.intrinsic[episodes][:, view], store.arrays["c2w"][start][:, view]
    true, _ = project(places, intrinsic, c2w)
    every: dict[str, Tensor] = {}
    hidden = {}
    for (pixels, metric), video in zip(_NAMES, (made.frames, truth), strict=True):
        found, hidden[pixels] = follow(video[:, :, view], first, true)
        places_found = on_plane(found, places[:, 1:, 2:], intrinsic, c2w)
        every[pixels] = (found - true[:, 1:]).norm(dim=-1)
        every[metric] = 100 * (places_found - places[:, 1:])[..., :2].norm(dim=-1)
    every["lost"] = hidden["pixels"]
    every["failed"] = every["locator_px"] > _BAR * min(store.spec.size)
    every["at_end"] = torch.zeros_like(made.valid)
    every["at_end"][torch.arange(len(start)), made.valid.long().cumsum(1).argmax(1)] = True
    # where the locator finds nothing in true video it says nothing of generated video
    use = made.valid & ~hidden["locator_px"]
    return {name: values[use] for name, values in every.items()}


def object_summary(parts: Sequence[Mapping[str, Tensor]]) -> dict[str, Any]:
    """What the `object_offsets` of some episodes come to, those of all parts in one.

    Returns:
        object_px and object_cm (median, 90th percentile over the frames in which it was found, None if it
        was in none), their object_cm_at_end, object_lost (share of the frames that truly show it), and
        locator_px and locator_cm, the locator's own error on true video. Where the locator fails there:
        object_unknown, saying so, in place of all that it says of generated video. {} where nothing can be
        measured.
    """
    known = [part for part in parts if part]
    if not known:
        return {}
    whole = {name: torch.cat([part[name] for part in known]) for name in known[0]}
    if not len(whole["lost"]):
        return {"object_unknown": "the locator, which goes by its colour, finds it in no recorded frame"}
    own = {name: quantiles(whole[name]) for name in _NAMES[1]}
    failed = float(whole["failed"].float().mean())
    if failed > _FAILS:
        pixels = own["locator_px"]
        assert pixels is not None  # some err by so much
        why = (
            f"the locator, which goes by its colour, errs by {pixels['median']:.1f} pixels (90%"
            f" within {pixels['p90']:.1f}) in recorded video, and in {100 * failed:.0f}% of its"
            f" frames by more than {100 * _BAR:.2g}% of the picture's side"
        )
        return {"object_unknown": why, **own}
    there = ~whole["lost"]
    return {
        "object_px": quantiles(whole["pixels"][there]),
        "object_cm": quantiles(whole["cm"][there]),
        "object_cm_at_end": quantiles(whole["cm"][there & whole["at_end"]]),
        "object_lost": float(whole["lost"].float().mean()),
        **own,
    }
