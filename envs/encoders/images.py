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

_NATIVE = 64  # pixels of a view's shorter side that the trunk is laid out for; larger ones are halved first
_LOOK = 4  # features of each key-point
_QUERY = 128  # width of the network that turns the conditioning vector into queries
_WAVES = 4  # frequencies of the positional encoding that queried key-points see, along either side


class ResidualBlock(nn.Module):
    """x + conv(silu(norm(x))) of [B, channels, H, W]; with a conditioning vector `cond` [B, cond_dim] what is
    normalised is scaled and shifted by it (FiLM, Perez et al. 2018), at first not at all.
    """

    def __init__(self, channels: int, cond_dim: int = 0):
        super().__init__()
        self.norm = nn.GroupNorm(8, channels)
        self.conv = nn.Conv2d(channels, channels, 3, padding=1)
        self.film = nn.Linear(cond_dim, 2 * channels) if cond_dim else None
        if self.film is not None:
            nn.init.zeros_(self.film.weight)
            nn.init.zeros_(self.film.bias)

    def forward(self, x: Tensor, cond: Tensor | None = None) -> Tensor:
        y = self.norm(x)
        if self.film is not None:
            gain, shift = self.film(cond)[:, :, None, None].chunk(2, 1)
            y = y * (1 + gain) + shift
        return x + self.conv(F.silu(y))


class Halving(nn.Module):
    """Halves maps [B, channels, H, W] before the trunk, and brings what the trunk says back to their size
    (Lin et al. 2017, feature pyramids), so that key-points lie as finely in large pictures as in small ones.
    """

    def __init__(self, channels: int):
        super().__init__()
        self.norm = nn.GroupNorm(8, channels)
        self.down = nn.Conv2d(channels, channels, 3, stride=2, padding=1)
        self.fine = nn.Conv2d(channels, channels, 3, padding=1)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Half as large maps, and what `back` needs of these."""
        kept = F.silu(self.norm(x))
        return self.down(kept), kept

    def back(self, small: Tensor, kept: Tensor) -> Tensor:
        """Maps like x of maps of half its size."""
        return F.silu(self.fine(kept) + F.interpolate(small, size=kept.shape[-2:], mode="nearest"))


class MultiViewEncoder(nn.Module):
    """One convolutional trunk for all views; each view has its own embedding and its own key-points.

    It returns three things of every view: where soft key-points are (spatial soft-argmax, Finn et al. 2016),
    what the features look like there, and a coarse grid of features. What some key-points look for, and
    where, may depend on a conditioning vector, such as the encoded instruction: where many things lie about,
    they find the one that it names. The features themselves then depend on it, too.

    Args:
        spec: what the world shows.
        points: key-points per view.
        width: channels at half resolution, a multiple of 8; twice as many from a quarter on.
        pictures: of each view that are looked at as one, channel on channel.
        blocks: residual blocks at the lowest resolution.
        grid: rows and columns of the coarse grid.
        cameras: which are looked through (Embodiment.views_of); the others cost nothing.
        instruction_keypoints: key-points per view that look for what the conditioning vector names, beside
            `points`.
        cond_dim: size of the conditioning vector, of which `instruction_keypoints` key-points are made.

    Forward takes uint8, or float in -1..1, [B, V, 3 * pictures, H, W] of all cameras, and, with
    `instruction_keypoints`, the conditioning vector float32 [B, cond_dim]; it returns float32
    [B, out_features].
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
        instruction_keypoints: int = 0,
        cond_dim: int = 0,
    ):
        super().__init__()
        self.chosen = list(spec.embodiment.views_of(cameras))
        views, deep = len(self.chosen), 2 * width
        self.stem = nn.Conv2d(3 * pictures, width, 5, stride=2, padding=2)
        times = max(0, round(math.log2(min(spec.size) / _NATIVE)))
        self.halve = nn.ModuleList(Halving(width) for _ in range(times))
        self.view = nn.Parameter(0.02 * torch.randn(views, width))
        self.norm = nn.GroupNorm(8, width)
        self.down = nn.Conv2d(width, deep, 3, stride=2, padding=1)
        self.blocks = nn.ModuleList(
            ResidualBlock(deep, cond_dim if instruction_keypoints else 0) for _ in range(blocks)
        )
        self.norm_out = nn.GroupNorm(8, deep)
        self.fine = nn.Conv2d(width, width, 1)
        self.lift = nn.Conv2d(deep, width, 1)
        self.heat = nn.Parameter(torch.randn(views, points, width) / width**0.5)
        # Sharp from the start: over a near-uniform softmax, key-points sit in the middle and hardly learn.
        self.temperature = nn.Parameter(torch.full((views, points, 1), 2.3))
        self.look = nn.Parameter(
            torch.randn(views, points + instruction_keypoints, width, _LOOK) / width**0.5
        )
        self.queried = (
            QueriedKeypoints(views, instruction_keypoints, width, cond_dim) if instruction_keypoints else None
        )
        # Pooled before it is convolved, which is the same and sixteen times cheaper.
        self.grid = nn.Sequential(
            nn.AdaptiveAvgPool2d(grid), nn.Conv2d(deep, width, 1), nn.SiLU(), nn.Flatten()
        )
        self.out_features = views * ((points + instruction_keypoints) * (2 + _LOOK) + width * grid * grid)

    def forward(self, pictures: Tensor, cond: Tensor | None = None) -> Tensor:
        return self.gaze(pictures, cond)[0]

    def gaze(self, pictures: Tensor, cond: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """What `forward` returns, and how well every pixel fits what each key-point looks for: logits float32
        [B, views looked through, points + instruction_keypoints, h, w], h and w half of the pictures'.
        """
        pictures = pictures[:, self.chosen]
        batch, views = pictures.shape[:2]
        flat = to_signed(pictures).flatten(0, 1).contiguous(memory_format=torch.channels_last)
        x, larger = self.stem(flat), []
        for halving in self.halve:
            x, kept = halving(x)
            larger.append((halving, kept))
        x = F.silu(self.norm(x + self.view.repeat(batch, 1)[:, :, None, None]))
        y = self.down(x)
        of_views = None if cond is None else cond.repeat_interleave(views, 0)
        for block in self.blocks:
            y = block(y, of_views)
        y = F.silu(self.norm_out(y))
        # Coarse features say what it is, fine ones where exactly.
        x = F.silu(self.fine(x) + F.interpolate(self.lift(y), size=x.shape[-2:], mode="nearest"))
        for halving, kept in reversed(larger):
            x = halving.back(x, kept)
        height, width = x.shape[-2:]
        places = x.flatten(2).unflatten(0, (batch, views)).float()  # [B, V, C, H * W]
        found = (self.heat @ places) * self.temperature.exp()  # [B, V, P, H * W]
        if self.queried is not None:
            found = torch.cat((found, self.queried(places, cond, (height, width))), 2)
        share = found.softmax(-1)
        looks = torch.einsum("bvpc,vpcl->bvpl", share @ places.transpose(-1, -2), self.look)
        features = (
            centres(share.unflatten(-1, (height, width))).flatten(1),
            looks.flatten(1),
            self.grid(y).float().unflatten(0, (batch, views)).flatten(1),
        )
        return torch.cat(features, -1), found.unflatten(-1, (height, width))


class QueriedKeypoints(nn.Module):
    """Key-points whose queries, of features and of positions, are made of a conditioning vector.

    Args:
        views: cameras; each has queries of its own.
        points: key-points per view.
        width: channels of the features.
        cond_dim: size of the conditioning vector.

    Forward takes features float [B, V, width, H * W], `cond` [B, cond_dim] and (H, W), and returns how well
    every pixel fits, [B, V, points, H * W].
    """

    def __init__(self, views: int, points: int, width: int, cond_dim: int):
        super().__init__()
        self.views, self.points, keys = views, points, width + 4 * _WAVES
        self.query = nn.Sequential(
            nn.Linear(cond_dim, _QUERY), nn.SiLU(), nn.Linear(_QUERY, views * points * keys)
        )
        self.temperature = nn.Parameter(torch.full((points, 1), 1.0 - 0.5 * math.log(keys)))

    def forward(self, places: Tensor, cond: Tensor | None, size: tuple[int, int]) -> Tensor:
        assert cond is not None
        sought = self.query(cond).unflatten(-1, (self.views, self.points, -1))
        features, where = sought.split((places.shape[2], 4 * _WAVES), -1)
        return (features @ places + where @ waves(size, places.device)) * self.temperature.exp()


def waves(size: tuple[int, int], device: torch.device) -> Tensor:
    """Sines and cosines of the places of pixels, [4 * _WAVES, H * W]; the slowest turns by a half."""
    v, u = (pixel_centres(count, device) for count in size)
    along = torch.stack(torch.meshgrid(v, u, indexing="ij")).flatten(1)  # [2, H * W]
    turns = torch.arange(1, _WAVES + 1, device=device)[:, None, None] * along * (math.pi / 2)
    return torch.cat((turns.sin(), turns.cos())).flatten(0, 1)


def pixel_centres(count: int, device: torch.device) -> Tensor:
    """Centres of `count` pixels in a row, in half-pictures from the middle, [count]."""
    return torch.linspace(-1, 1, count, device=device) * (1 - 1 / count)


def centres(share: Tensor) -> Tensor:
    """Centres of mass (u, v) [..., 2], in half-pictures from the middle, of maps [..., H, W] of sum 1."""
    v, u = pixel_centres(share.shape[-2], share.device), pixel_centres(share.shape[-1], share.device)
    return torch.stack(((share.sum(-2) * u).sum(-1), (share.sum(-1) * v).sum(-1)), -1)


def bells(size: tuple[int, int], at: Tensor, spread: float) -> Tensor:
    """Gaussians around places, as maps [..., H, W] of sum 1.

    Args:
        at: (u, v) [..., 2], shares of width and height.
        spread: in cells.
    """
    height, width = size

    def along(cells: int, place: Tensor) -> Tensor:
        middle = torch.arange(cells, device=at.device) + 0.5
        return (-(((middle - place[..., None] * cells) / spread) ** 2) / 2).softmax(-1)

    return along(height, at[..., 1])[..., :, None] * along(width, at[..., 0])[..., None, :]


def to_signed(frames: Tensor) -> Tensor:
    """uint8 pictures as float32 in -1..1; floats are taken to be so already."""
    return frames if frames.is_floating_point() else frames.float().mul_(1 / 127.5).sub_(1.0)
