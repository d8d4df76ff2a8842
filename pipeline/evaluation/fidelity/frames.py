"""Errors of generated frames against the true ones: MSE, PSNR, SSIM, a perceptual distance, and MSE within
parts of the picture.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor
from torchmetrics.functional.image import structural_similarity_index_measure as ssim

from envs.judges.perceptual import PerceptualDistance
from envs.physics.render import PARTS

_AT_ONCE = 256  # pictures
MEASURED = tuple(name for name in PARTS if name != "background")


def check_pair(made: Tensor, true: Tensor) -> None:
    """Refuse videos that do not show the same frames, views and sizes.

    Raises:
        ValueError: saying what differs.
    """
    if made.shape == true.shape:
        return
    names = ("episodes", "frames", "views", "colours", "height", "width")
    if made.ndim != len(names) or true.ndim != len(names):
        raise ValueError(f"videos are [N, T, V, 3, H, W], here {tuple(made.shape)} and {tuple(true.shape)}")
    differ = [f"{a} {n} and {b}" for n, a, b in zip(names, made.shape, true.shape, strict=True) if a != b]
    raise ValueError(
        f"generated and true video differ ({', '.join(differ)}); cut both to the same frames and views"
    )


@torch.no_grad()
def frame_errors(
    made: Tensor, true: Tensor, distance: PerceptualDistance, labels: Tensor | None = None
) -> dict[str, Tensor]:
    """Errors of every frame of every view.

    Args:
        made, true: uint8 [N, T, V, 3, H, W].
        distance: perceptual.
        labels: uint8 [N, T, V, H, W] of envs.physics.render.PARTS, what each pixel truly shows.

    Returns:
        mse (pictures in 0..1), ssim, perceptual, float32 [N, T, V] each; with labels also arm_mse and
        object_mse over the pixels that truly show either, NaN where none does.

    Raises:
        ValueError: if the videos, or the labels, are of other shapes.
    """
    check_pair(made, true)
    lead = made.shape[:3]
    if labels is not None and labels.shape != (*lead, *made.shape[-2:]):
        raise ValueError(f"labels are {tuple(labels.shape)}, the video's are {(*lead, *made.shape[-2:])}")
    pairs = made.flatten(0, 2), true.flatten(0, 2)
    parts: dict[str, list[Tensor]] = {}
    marks = None if labels is None else labels.flatten(0, 2)
    for begin in range(0, len(pairs[0]), _AT_ONCE):
        some = slice(begin, begin + _AT_ONCE)
        one, other = (side[some].float() / 255 for side in pairs)
        off = (one - other).square().mean(1)  # [n, H, W]
        found = {
            "mse": off.mean((1, 2)),
            "ssim": ssim(one, other, data_range=1.0, reduction="none"),
            "perceptual": distance(one, other),
        }
        if marks is not None:
            for name in MEASURED:
                there = marks[some] == PARTS[name]
                found[f"{name}_mse"] = (off * there).sum((1, 2)) / there.sum((1, 2))  # 0/0 is NaN
        for name, values in found.items():
            parts.setdefault(name, []).append(values)
    return {name: torch.cat(values).reshape(lead) for name, values in parts.items()}


def psnr(mse: Tensor) -> Tensor:
    """Peak signal-to-noise ratio in dB of mean squared errors of pictures in 0..1; 80 at most."""
    return -10 * mse.clamp(min=1e-8).log10()


def summary(errors: Mapping[str, Tensor], valid: Tensor) -> dict[str, Any]:
    """Means over the frames that exist, valid bool [N, T], of errors [N, T, V]; psnr is the mean over frames
    and views of theirs. None of what was nowhere to be seen.
    """
    whole = {**errors, "psnr": psnr(errors["mse"])}
    return {name: _mean(values[valid]) for name, values in whole.items()}


def by_frame(errors: Mapping[str, Tensor], valid: Tensor) -> dict[str, list[float | None]]:
    """The same for each frame number, [T]."""
    whole = {**errors, "psnr": psnr(errors["mse"])}
    return {
        name: [_mean(values[valid[:, t], t]) for t in range(valid.shape[1])] for name, values in whole.items()
    }


def _mean(values: Tensor) -> float | None:
    known = values[torch.isfinite(values)]
    return float(known.mean()) if len(known) else None
