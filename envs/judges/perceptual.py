"""A perceptual distance between pictures that needs no learned weights.

The normalised Laplacian pyramid (Laparra et al. 2016, "Perceptual image quality assessment using a normalized
Laplacian pyramid"): pictures are compared by what differs from its surroundings, relative to the contrast
there, at several scales; a blurred edge weighs more than a change of light. Here with square neighbourhoods,
one constant and opponent colours instead of luminance alone. It is no LPIPS, and its numbers are not
comparable to any.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

_BINOMIAL = (1.0, 4.0, 6.0, 4.0, 1.0)
_SMALLEST = 8  # pixels of a side, below which no further level is made
_OPPONENT = ((0.299, 0.587, 0.114), (0.5, -0.5, 0.0), (0.25, 0.25, -0.5))  # light, red-green, yellow-blue


class PerceptualDistance(nn.Module):
    """Distance of pictures, differentiable; 0 of equal ones, symmetric, without an upper bound.

    Args:
        levels: bands at most; small pictures have fewer.
        contrast: what is added to the local contrast by which bands are divided, in units of the pictures'
            range of 1: fainter structure than that counts little.

    Attributes:
        name: to be told beside every figure.
    """

    name = "NLPD (normalised Laplacian pyramid)"

    def __init__(self, levels: int = 4, contrast: float = 0.1):
        super().__init__()
        self.levels, self.contrast = levels, contrast
        taps = torch.tensor(_BINOMIAL) / sum(_BINOMIAL)
        self.register_buffer("kernel", (taps[:, None] * taps)[None, None], persistent=False)
        self.register_buffer("opponent", torch.tensor(_OPPONENT)[..., None, None], persistent=False)
        self.kernel: Tensor
        self.opponent: Tensor

    def forward(self, one: Tensor, other: Tensor) -> Tensor:
        """Distances float32 [*] of pictures [*, 3, H, W], uint8 or float in 0..1.

        Raises:
            ValueError: if the two are of different shapes.
        """
        if one.shape != other.shape:
            raise ValueError(f"pictures {tuple(one.shape)} and {tuple(other.shape)} cannot be compared")
        lead = one.shape[:-3]
        sides = [self.bands(side.reshape(-1, *side.shape[-3:])) for side in (one, other)]
        levels = [(a - b).square().mean((1, 2, 3)) for a, b in zip(*sides, strict=True)]
        # the root bends where pictures are equal; a tiny floor keeps its gradient finite there
        return torch.stack([(level + 1e-12).sqrt() - 1e-6 for level in levels]).mean(0).reshape(lead)

    def bands(self, pictures: Tensor) -> list[Tensor]:
        """Normalised bands [N, 3, h, w] of pictures [N, 3, H, W] from fine to coarse; last comes what is left
        below them, as it is.
        """
        here = pictures.float() / 255 if pictures.dtype == torch.uint8 else pictures.float()
        here = functional.conv2d(here, self.opponent.to(here.device))
        out = []
        for _ in range(self.levels):
            if min(here.shape[-2:]) < 2 * _SMALLEST:
                break
            low = _halved(self._blurred(here))
            band = here - _doubled(low, here.shape[-2:])
            out.append(band / (self.contrast + self._blurred(band.abs())))
            here = low
        return [*out, here]

    def _blurred(self, pictures: Tensor) -> Tensor:
        padded = functional.pad(pictures, (2, 2, 2, 2), mode="reflect")
        kernel = self.kernel.to(pictures.device).expand(pictures.shape[1], 1, -1, -1)
        return functional.conv2d(padded, kernel, groups=pictures.shape[1])


def _halved(pictures: Tensor) -> Tensor:
    """Means of 2 x 2 pixels [N, 3, ceil(h / 2), ceil(w / 2)] of pictures [N, 3, h, w]. They lie between
    those, where `_doubled` takes them to be; samples of every other pixel would lie half a pixel off.
    """
    height, width = pictures.shape[-2:]
    even = functional.pad(pictures, (0, width % 2, 0, height % 2), mode="replicate")
    return functional.avg_pool2d(even, 2)


def _doubled(pictures: Tensor, size: Sequence[int]) -> Tensor:
    """Pictures twice as large, bilinear, cut to `size` where that is odd."""
    wide = functional.interpolate(pictures, scale_factor=2, mode="bilinear", align_corners=False)
    return wide[..., : size[0], : size[1]]
