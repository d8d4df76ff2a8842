"""The image encoder that policies, critics and judges share: any number of views of any size, all treated
alike.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from envs.specs import WorldSpec

_NATIVE = 64  # pixels of a view's shorter side that the encoder is laid out for; larger ones are halved first
_LOOK = 4  # features said of each key-point


class ResidualBlock(nn.Module):
    """x + conv(silu(norm(x))) of [B, channels, H, W]."""

    def __init__(self, channels: int):
        super().__init__()
        self.norm = nn.GroupNorm(8, channels)
        self.conv = nn.Conv2d(channels, channels, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.conv(F.silu(self.norm(x)))


class MultiViewEncoder(nn.Module):
    """One convolutional trunk for all views; each view has its own embedding and its own key-points.

    It says three things of every view: where soft key-points are (spatial soft-argmax, Finn et al. 2016),
    what the features look like there, and a coarse grid of features. What some key-points look for may hang
    on the words: where many things lie about, they find the one that is spoken of.

    Args:
        spec: what the world shows.
        points: key-points per view.
        width: channels at half resolution, a multiple of 8; twice as many from a quarter on.
        pictures: of each view that are looked at as one, channel on channel.
        blocks: residual blocks at the lowest resolution.
        grid: rows and columns of the coarse grid.
        cameras: which are looked through (Embodiment.views_of); the others cost nothing.
        asked: key-points per view that look for what the words say, beside `points`.
        words: numbers that an instruction is encoded as, of `asked` key-points.

    Forward takes uint8, or float in -1..1, [B, V, 3 * pictures, H, W] of all cameras, and with `asked`
    key-points float32 [B, words]; it returns float32 [B, out_features].
    """

    def __init__(
        self,
        spec: WorldSpec,
        points: int,
        width: int,
        pictures: int = 1,
        blocks: int = 1,
        grid: int = 4,
        cameras: str | Sequence[str] = "all",
        asked: int = 0,
        words: int = 0,
    ):
        super().__init__()
        self.chosen = list(spec.embodiment.views_of(cameras))
        views, deep = len(self.chosen), 2 * width
        self.stem = nn.Conv2d(3 * pictures, width, 5, stride=2, padding=2)
        self.halve = nn.Sequential()
        for _ in range(max(0, round(math.log2(min(spec.size) / _NATIVE)))):
            down = nn.Conv2d(width, width, 3, stride=2, padding=1)
            self.halve.extend([nn.GroupNorm(8, width), nn.SiLU(), down])
        self.view = nn.Parameter(0.02 * torch.randn(views, width))
        self.norm = nn.GroupNorm(8, width)
        self.down = nn.Conv2d(width, deep, 3, stride=2, padding=1)
        self.blocks = nn.Sequential(*(ResidualBlock(deep) for _ in range(blocks)))
        self.norm_out = nn.GroupNorm(8, deep)
        self.fine = nn.Conv2d(width, width, 1)
        self.lift = nn.Conv2d(deep, width, 1)
        self.heat = nn.Parameter(torch.randn(views, points, width) / width**0.5)
        # Sharp from the start: over a near-uniform softmax, key-points sit in the middle and hardly learn.
        self.temperature = nn.Parameter(torch.full((views, points + asked, 1), 2.3))
        self.look = nn.Parameter(torch.randn(views, points + asked, width, _LOOK) / width**0.5)
        if asked:
            self.ask = nn.Sequential(
                nn.Linear(words, words), nn.SiLU(), nn.Linear(words, views * asked * width)
            )
        # Pooled before it is convolved, which is the same and sixteen times cheaper.
        self.grid = nn.Sequential(
            nn.AdaptiveAvgPool2d(grid), nn.Conv2d(deep, width, 1), nn.SiLU(), nn.Flatten()
        )
        self.out_features = views * ((points + asked) * (2 + _LOOK) + width * grid * grid)

    def forward(self, pictures: Tensor, words: Tensor | None = None) -> Tensor:
        pictures = pictures[:, self.chosen]
        batch, views = pictures.shape[:2]
        flat = to_signed(pictures).flatten(0, 1).contiguous(memory_format=torch.channels_last)
        x = self.halve(self.stem(flat))
        x = F.silu(self.norm(x + self.view.repeat(batch, 1)[:, :, None, None]))
        y = F.silu(self.norm_out(self.blocks(self.down(x))))
        # Coarse features say what it is, fine ones where exactly.
        x = F.silu(self.fine(x) + F.interpolate(self.lift(y), size=x.shape[-2:], mode="nearest"))
        height, width = x.shape[-2:]
        places = x.flatten(2).unflatten(0, (batch, views)).float()  # [B, V, C, H * W]
        share = ((self._sought(words) @ places) * self.temperature.exp()).softmax(-1)  # [B, V, P, H * W]
        looks = torch.einsum("bvpc,vpcl->bvpl", share @ places.transpose(-1, -2), self.look)
        said = (
            centres(share.unflatten(-1, (height, width))).flatten(1),
            looks.flatten(1),
            self.grid(y).float().unflatten(0, (batch, views)).flatten(1),
        )
        return torch.cat(said, -1)

    def _sought(self, words: Tensor | None) -> Tensor:
        """What key-points look for, [V, P, C] or, with words [B, words], [B, V, P, C]."""
        if words is None:
            return self.heat
        views, _, width = self.heat.shape
        spoken = self.ask(words).reshape(len(words), views, -1, width)
        return torch.cat((self.heat.expand(len(words), -1, -1, -1), spoken), 2)


def pixel_centres(count: int, device: torch.device) -> Tensor:
    """Centres of `count` pixels in a row, in half-pictures from the middle, [count]."""
    return torch.linspace(-1, 1, count, device=device) * (1 - 1 / count)


def centres(share: Tensor) -> Tensor:
    """Centres of mass (u, v) [..., 2], in half-pictures from the middle, of maps [..., H, W] of sum 1."""
    v, u = pixel_centres(share.shape[-2], share.device), pixel_centres(share.shape[-1], share.device)
    return torch.stack(((share.sum(-2) * u).sum(-1), (share.sum(-1) * v).sum(-1)), -1)


def to_signed(frames: Tensor) -> Tensor:
    """uint8 pictures as float32 in -1..1; floats are taken to be so already."""
    return frames if frames.is_floating_point() else frames.float().mul_(1 / 127.5).sub_(1.0)
