"""Memory augmentation: in training, remembered frames are spoilt a little, as a world's own frames will be
(GE-Sim 2.0, appendix).

Probabilities and strengths are the paper's. Where it leaves a law open, the simplest is taken: strengths are
uniform, and the blurred region is a rectangle.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

_NOISE, _NOISE_STRENGTH = 0.5, 0.2  # chance per frame, and largest share of noise mixed in
_FIRST, _FIRST_STRENGTH = 0.2, 0.5  # the same of the first frame of all, beside that
_BLUR, _BLUR_AREA, _BLUR_SIGMA = 0.5, 0.2, (0.1, 1.3)
_JITTER, _JITTER_STRENGTH = 0.3, 0.2


def _uniform(count: int, low: float, high: float, generator: torch.Generator) -> Tensor:
    return low + (high - low) * torch.rand(count, generator=generator)


def chosen_clips(count: int, chance: float, generator: torch.Generator) -> Tensor:
    """Which clips are spoilt at all, bool [count]."""
    return torch.rand(count, generator=generator) < chance


def augment_memory_frames(frames: Tensor, chosen: Tensor, generator: torch.Generator) -> Tensor:
    """Blur a part, and shift the colours of all views and frames alike.

    Args:
        frames: float [B, M, V, 3, H, W] in 0..1.
        chosen: bool [B], clips that may be spoilt.

    Returns:
        Frames of the same shape, in 0..1.
    """
    out = frames.clone()
    height, width = frames.shape[-2:]
    for row in chosen.nonzero().flatten().tolist():
        if torch.rand((), generator=generator) < _BLUR:
            sigma = float(_uniform(1, *_BLUR_SIGMA, generator))
            rows = max(1, round(height * _BLUR_AREA**0.5))
            columns = max(1, round(width * _BLUR_AREA**0.5))
            top = int(torch.randint(height - rows + 1, (1,), generator=generator))
            left = int(torch.randint(width - columns + 1, (1,), generator=generator))
            part = out[row, ..., top : top + rows, left : left + columns]
            out[row, ..., top : top + rows, left : left + columns] = _blur(part, sigma)
        if torch.rand((), generator=generator) < _JITTER:
            brightness, contrast, saturation = _uniform(
                3, 1 - _JITTER_STRENGTH, 1 + _JITTER_STRENGTH, generator
            ).tolist()
            clip = out[row] * brightness
            clip = (clip - clip.mean()) * contrast + clip.mean()
            grey = clip.mean(-3, keepdim=True)
            out[row] = (grey + (clip - grey) * saturation).clamp(0, 1)
    return out


def augment_memory_latents(memory: Tensor, chosen: Tensor, generator: torch.Generator) -> Tensor:
    """Mix noise into some remembered latents.

    Args:
        memory: float [B, V, C, M, h, w]; its first frame is the episode's.
        chosen: bool [B], clips that may be spoilt.
    """
    batch, count = memory.shape[0], memory.shape[3]
    share = torch.rand(batch, count, generator=generator) * _NOISE_STRENGTH
    share = share * (torch.rand(batch, count, generator=generator) < _NOISE)
    first = (
        torch.rand(batch, generator=generator)
        * _FIRST_STRENGTH
        * (torch.rand(batch, generator=generator) < _FIRST)
    )
    share[:, 0] = torch.maximum(share[:, 0], first)
    share = (share * chosen[:, None]).to(memory.device)[:, None, None, :, None, None]
    noise = torch.randn(memory.shape, generator=generator).to(memory.device)
    return (1 - share) * memory + share * noise


def _blur(pictures: Tensor, sigma: float) -> Tensor:
    """Gaussian blur with five taps of [..., H, W]."""
    taps = torch.exp(-0.5 * (torch.arange(-2, 3, device=pictures.device, dtype=pictures.dtype) / sigma) ** 2)
    taps = taps / taps.sum()
    flat = pictures.reshape(-1, 1, *pictures.shape[-2:])
    flat = F.conv2d(F.pad(flat, (2, 2, 0, 0), mode="replicate"), taps.view(1, 1, 1, 5))
    flat = F.conv2d(F.pad(flat, (0, 0, 2, 2), mode="replicate"), taps.view(1, 1, 5, 1))
    return flat.reshape(pictures.shape)
