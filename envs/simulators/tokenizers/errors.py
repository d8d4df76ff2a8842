"""How far a reconstructed picture is from the true one: what autoencoders are trained by."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from envs.simulators.foreground import foreground_weight

_FOREGROUND = 12.0  # loss weight of a pixel that stands out, above the 1 of the background
_SQUARE = 20.0  # weight of squared errors beside absolute ones
_SCALES = 3  # of gradients: the picture, and halved twice


def picture_error(made: Tensor, truth: Tensor) -> Tensor:
    """Absolute and squared error of pictures float [N, 3, H, W] in 0..1, most of all of what stands out."""
    error = made - truth
    weight = foreground_weight(truth, _FOREGROUND)
    return ((error.abs() + _SQUARE * error.square()) * weight).sum() / (3 * weight.sum())


def gradient_difference(made: Tensor, truth: Tensor) -> Tensor:
    """Mean absolute difference of image gradients at several scales (Mathieu et al. 2016), of pictures float
    [N, 3, H, W].

    It stands where MAGVIT-2 has a perceptual distance by a pretrained network, and needs no download: pixel
    errors alone are least where edges are blurred, and blurred edges cost most here. It is no LPIPS.
    """
    total = torch.zeros((), device=truth.device)
    for scale in range(_SCALES):
        if scale:
            made, truth = F.avg_pool2d(made, 2), F.avg_pool2d(truth, 2)
        for axis in (-1, -2):
            total = total + (made.diff(dim=axis) - truth.diff(dim=axis)).abs().mean()
    return total / (2 * _SCALES)


def psnr(made: Tensor, truth: Tensor) -> Tensor:
    """Peak signal-to-noise ratio in dB of pictures in 0..1; no gradient passes."""
    return -10 * (made.detach() - truth).square().mean().clamp(min=1e-10).log10()
