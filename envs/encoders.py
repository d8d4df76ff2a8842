"""Small image and word encoders that judges and policies share; positions survive them as soft key-points."""

from __future__ import annotations

import cv2
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from envs.language import VOCABULARY


class SpatialEncoder(nn.Module):
    """Pictures to key-point coordinates and a coarse grid of features (Finn et al. 2016, spatial
    soft-argmax).

    Args:
        points: number of soft key-points.
        width: channels at half resolution; twice as many at a quarter.
        pictures: how many are looked at as one, pixel on pixel.

    Forward takes float [B, 3 * pictures, H, W] in -1..1 and returns float32: the key-points [B, points, 2] as
    (u, v) in half-pictures from the middle, and a coarse grid of features [B, 16 * width].
    """

    def __init__(self, points: int = 32, width: int = 32, pictures: int = 1):
        super().__init__()
        self.stem = nn.Conv2d(3 * pictures, width, 5, stride=2, padding=2)
        self.mid = nn.Conv2d(width, 2 * width, 3, stride=2, padding=1)
        self.deep = nn.Conv2d(2 * width, 2 * width, 3, padding=1)
        self.norm1, self.norm2, self.norm3 = (
            nn.GroupNorm(4, width),
            nn.GroupNorm(8, 2 * width),
            nn.GroupNorm(8, 2 * width),
        )
        self.fine = nn.Conv2d(width, width, 1)
        self.heat = nn.Conv2d(2 * width, points, 1)
        self.lift = nn.Conv2d(2 * width, width, 1)
        self.heat_fine = nn.Conv2d(width, points, 3, padding=1)
        # Sharp from the start: over a near-uniform softmax, key-points sit in the middle and hardly learn.
        self.temperature = nn.Parameter(torch.full((points,), 2.3))
        self.grid = nn.Sequential(
            nn.Conv2d(2 * width, width, 4, stride=4), nn.SiLU(), nn.AdaptiveAvgPool2d(4), nn.Flatten()
        )

    def forward(self, pictures: Tensor) -> tuple[Tensor, Tensor]:
        x = F.silu(self.norm1(self.stem(pictures.contiguous(memory_format=torch.channels_last))))
        y = F.silu(self.norm2(self.mid(x)))
        y = y + F.silu(self.norm3(self.deep(y)))
        # Coarse features say what it is, fine ones where exactly.
        up = F.interpolate(self.lift(y), size=x.shape[-2:], mode="nearest")
        heat = self.heat_fine(F.silu(self.fine(x) + up)).float()
        height, width = heat.shape[-2:]
        share = (heat.flatten(2) * self.temperature.exp()[None, :, None]).softmax(-1)
        return centres(share.unflatten(-1, (height, width))), self.grid(y).float()


class CloseUp(nn.Module):
    """Looks again, closely, at points of a picture: each is moved by what a crop around it shows, and more
    may be said of it.

    Args:
        points: how many, S; each has its own layers at the end.
        out: further numbers said of each.
        pictures: how many are looked at as one, pixel on pixel.
        reach: half-width of a crop, and how far a point is moved at most, in half-pictures.
        cells: rows and columns of a crop, which is sampled finer than the picture.
        width: channels.
        wander: standard deviation by which crops are misplaced in training, in half-pictures; the points come
            from nets that err less there than elsewhere.
    """

    def __init__(
        self,
        points: int,
        out: int = 0,
        pictures: int = 1,
        reach: float = 0.2,
        cells: int = 20,
        width: int = 16,
        wander: float = 0.04,
    ):
        super().__init__()
        self.reach, self.cells, self.wander = reach, cells, wander
        self.layers = nn.Sequential(
            nn.Conv2d(3 * pictures, width, 5, stride=2, padding=2),
            nn.SiLU(),
            nn.Conv2d(width, 2 * width, 3, stride=2, padding=1),
            nn.SiLU(),
            nn.Conv2d(2 * width, 2 * width, 3, padding=1),
            nn.SiLU(),
            nn.Flatten(),
        )
        inside = 2 * width * (-(-cells // 4)) ** 2
        self.first = nn.Parameter(torch.randn(points, inside, 64) / inside**0.5)
        self.last = nn.Parameter(torch.randn(points, 64, 2 + out) / 64)

    def forward(
        self, pictures: Tensor, points: Tensor, generator: torch.Generator | None = None
    ) -> tuple[Tensor, Tensor]:
        """Points moved [B, S, 2], and what else is said [B, S, out].

        Args:
            pictures: float [B, C, H, W] in -1..1.
            points: [B, S, 2] in half-pictures from the middle.
            generator: misplaces crops, in training.
        """
        begin = points.detach()
        if generator is not None:
            begin = begin + self.wander * torch.randn(begin.shape, generator=generator).to(begin.device)
        offset = self.reach * middles(self.cells, begin.device)
        v, u = torch.meshgrid(offset, offset, indexing="ij")
        grid = begin[:, :, None, None] + torch.stack((u, v), -1)
        # All crops of a picture as one tall one.
        crops = F.grid_sample(
            pictures.float(), grid.flatten(1, 2), padding_mode="border", align_corners=False
        ).unflatten(2, (begin.shape[1], self.cells))
        x = self.layers(crops.transpose(1, 2).flatten(0, 1)).unflatten(0, begin.shape[:2])
        said = torch.einsum(
            "bsk,sko->bso", F.silu(torch.einsum("bsi,sik->bsk", x, self.first)), self.last
        ).float()
        return begin + self.reach * said[..., :2].tanh(), said[..., 2:]


class Gaze(nn.Module):
    """What judges and policies see in a first view: key-points, some of them taught to lie on objects and
    looked at closely, and how far those lie apart.

    Args:
        points, width, pictures: of SpatialEncoder.
        aims: key-points, the first ones, that are taught to lie on the objects of the data, in their order.

    Attributes:
        out_features: numbers said of a picture; the last `gaps` are how far the objects of each pair lie
            apart.
        plane: per aim, the homography [aims, 3, 3] from half-pictures to the ground it moves over, in SPANs;
            see `survey`.
        surveyed: bool [aims], whether `plane` was found in data.
    """

    GAIN = 4.0  # on where objects are seen and how far apart: small differences that decide
    SPAN = 0.25  # m; what half a picture is taken to show before anything was surveyed

    plane: Tensor
    surveyed: Tensor

    def __init__(self, points: int, width: int, aims: int, pictures: int = 1):
        super().__init__()
        if aims > points:
            raise ValueError(f"aims={aims} cannot exceed points={points}")
        self.aims = aims
        self.encoder = SpatialEncoder(points, width, pictures)
        self.closer = CloseUp(aims, pictures=pictures) if aims else None
        self.register_buffer("plane", torch.eye(3).repeat(aims, 1, 1))
        self.register_buffer("surveyed", torch.zeros(aims, dtype=torch.bool))
        self.gaps = aims * (aims - 1) // 2
        self.out_features = 2 * points + 16 * width + 2 * aims + 3 * self.gaps

    def forward(self, pictures: Tensor, generator: torch.Generator | None = None) -> tuple[Tensor, Tensor]:
        """What is said of pictures float [B, C, H, W] in -1..1, float32 [B, out_features], and where objects
        are seen, [B, 2, aims, 2].

        The latter at a first look and closely, in half-pictures from the middle. `generator` see CloseUp.
        """
        points, grid = self.encoder(pictures)
        aimed = points[:, : self.aims]
        close = aimed if self.closer is None else self.closer(pictures, aimed, generator)[0]
        return torch.cat(
            (points.flatten(1), grid, self.GAIN * close.flatten(1), self.gaps_between(close)), -1
        ), torch.stack((aimed, close), 1)

    def gaps_between(self, where: Tensor) -> Tensor:
        """How far things seen at `where` [B, aims, 2] lie apart on the ground, GAIN times SPANs: x and y of
        every pair, then the lengths, [B, 3 * gaps].
        """
        ground = torch.einsum("sij,bsj->bsi", self.plane, F.pad(where, (0, 1), value=1.0))
        ground = ground[..., :2] / ground[..., 2:].clamp(min=0.1)
        one, other = torch.triu_indices(self.aims, self.aims, 1, device=where.device)
        apart = ground[:, one] - ground[:, other]
        return self.GAIN * torch.cat((apart.flatten(1), apart.norm(dim=-1)), -1)

    @torch.no_grad()
    def survey(self, where: Tensor, places: Tensor) -> None:
        """Learn where on the ground things are that are seen somewhere in the picture, as far as anybody
        knows.

        How far things lie apart decides, and a picture shows it foreshortened. A camera that stays where it
        is sees
        each thing's ground through one homography (Hartley & Zisserman, 4.1), found by OpenCV; of cameras
        that
        move this is the one that fits them best.

        Args:
            where: [N, aims, 2] in half-pictures from the middle; places: [N, aims, 2] on the ground in
                metres; NaN where unknown.
        """
        for number in range(self.aims):
            known = torch.isfinite(where[:, number]).all(-1) & torch.isfinite(places[:, number]).all(-1)
            if known.sum() < 16:
                continue
            found, _ = cv2.findHomography(
                where[known, number].double().numpy(), (places[known, number] / self.SPAN).double().numpy()
            )
            if found is not None:  # points in a row tell no plane
                self.plane[number] = torch.from_numpy(found)
                self.surveyed[number] = True

    def drill(self, pictures: Tensor, where: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Mean distance, in half-pictures, by which close looks alone miss what they are to find; arguments
        as those of `forward` and `missed`.

        A crop costs a tenth of a picture, and close looks are what precision hangs on.
        """
        if self.closer is None:
            return torch.zeros((), device=pictures.device)
        found, _ = self.closer(pictures, torch.nan_to_num(where), generator)
        return self.missed(found[:, None], where)[0]

    @staticmethod
    def missed(aimed: Tensor, where: Tensor) -> Tensor:
        """Mean distances [looks], in half-pictures, between where objects are seen [B, looks, aims, 2] and
        are [B, aims, 2]; NaN where nobody knows.
        """
        known = torch.isfinite(where).all(-1)
        off = (aimed - torch.nan_to_num(where)[:, None]).norm(dim=-1) * known[:, None]
        return off.sum((0, 2)) / known.sum().clamp(min=1)


class PatchEncoder(nn.Module):
    """A cheap encoder of a side view: float [B, 3, H, W] in -1..1 to float32 [B, out]."""

    def __init__(self, out: int = 32, width: int = 16):
        super().__init__()
        self.layers = nn.Sequential(
            nn.Conv2d(3, width, 8, stride=4, padding=2),
            nn.SiLU(),
            nn.Conv2d(width, 2 * width, 4, stride=4),
            nn.SiLU(),
            nn.AdaptiveAvgPool2d(4),
            nn.Flatten(),
            nn.Linear(32 * width, out),
        )

    def forward(self, pictures: Tensor) -> Tensor:
        return self.layers(pictures).float()


class WordEncoder(nn.Module):
    """Mean of word embeddings: tokens int64 [B, WORDS] to float32 [B, out]."""

    def __init__(self, out: int = 32):
        super().__init__()
        self.table = nn.EmbeddingBag(VOCABULARY, out, mode="mean", padding_idx=0)

    def forward(self, tokens: Tensor) -> Tensor:
        return self.table(tokens)


def middles(count: int, device: torch.device) -> Tensor:
    """Middles of `count` pixels in a row, in half-pictures from the middle, [count]."""
    return torch.linspace(-1, 1, count, device=device) * (1 - 1 / count)


def centres(share: Tensor) -> Tensor:
    """Centres of mass [..., 2] of maps [..., H, W] that add up to 1, as (u, v) in half-pictures from the
    middle.
    """
    v, u = middles(share.shape[-2], share.device), middles(share.shape[-1], share.device)
    return torch.stack(((share.sum(-2) * u).sum(-1), (share.sum(-1) * v).sum(-1)), -1)


def to_signed(frames: Tensor) -> Tensor:
    """uint8 pictures as float32 in -1..1; floats are taken to be so already."""
    return frames if frames.is_floating_point() else frames.float().mul_(1 / 127.5).sub_(1.0)
