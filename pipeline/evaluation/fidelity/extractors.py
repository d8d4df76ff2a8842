"""Features for Frechet distances between sets of pictures (as in FID) or clips (as in FVD).

A distance means nothing without the name of what its features come from, so every extractor has one, and
distances of different extractors are never compared (frechet.py). The standard networks are read from the
TorchScript files in which they are usually passed on; the default needs no file.
"""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor
from torch.nn import functional

from envs.judges.perceptual import PerceptualDistance
from envs.targets import ConfigError


class Extractor(ABC):
    """Features of pictures or clips.

    Attributes:
        name: of the network and its weights; distances of different names are not comparable.
        clips: whether it takes clips uint8 [N, T, 3, H, W] instead of pictures uint8 [N, 3, H, W].
        shortest: frames that a clip must have.
    """

    name: str
    clips: bool
    shortest: int = 1

    def compute_on(self, device: torch.device) -> None:
        """Compute there from now on, instead of on the CPU; what has no network stays where it is."""

    @abstractmethod
    def __call__(self, pictures: Tensor) -> Tensor:
        """Features float32 [N, D], on the CPU as the pictures are."""


class PyramidFrames(Extractor):
    """Contrast of every band of a normalised Laplacian pyramid (judges/perceptual.py) and colours, in each
    quarter of a picture. It tells sharp from blurred and one scene from another, and knows no things.
    """

    name = "pyramid contrast of frames, no learned weights"
    clips = False

    def __init__(self) -> None:
        self._pyramid = PerceptualDistance(levels=3)

    def __call__(self, pictures: Tensor) -> Tensor:
        """Features float32 [N, 12 * bands]."""
        *bands, rest = self._pyramid.bands(pictures)
        pooled = [functional.adaptive_avg_pool2d(band, 2) for band in (*(b.abs() for b in bands), rest)]
        return torch.cat([part.flatten(1) for part in pooled], 1)


class PyramidClips(Extractor):
    """Mean, spread and change from frame to frame of PyramidFrames over a clip."""

    name = "pyramid contrast of clips, no learned weights"
    clips, shortest = True, 2

    def __init__(self) -> None:
        self._frames = PyramidFrames()

    def __call__(self, pictures: Tensor) -> Tensor:
        """Features float32 [N, 36 * bands] of clips of two frames or more."""
        each = self._frames(pictures.flatten(0, 1)).unflatten(0, pictures.shape[:2])
        moved = each.diff(dim=1).abs().mean(1)
        return torch.cat((each.mean(1), each.std(1), moved), 1)


class _TorchScript(Extractor):
    """A network in TorchScript; such files hold operations of torch and numbers, no Python.

    Args:
        weights: the file.
    """

    title: str
    width: int  # of the features by which the network is known
    options: ClassVar[dict[str, bool]]
    probe: tuple[int, ...]  # shape of an input, as the network takes it

    def __init__(self, weights: str):
        path = Path(weights)
        if not path.is_file():
            raise ConfigError(f"weights={weights} of the extractor {self.title} is not there")
        try:
            self._network: Any = torch.jit.load(str(path), map_location="cpu").eval()
            with torch.no_grad():
                found = self._network(torch.zeros(self.probe), **self.options)
            shape = tuple(found.shape)
        except (RuntimeError, TypeError, AttributeError, torch.jit.Error) as error:
            first = str(error).strip().splitlines()[0]
            raise ConfigError(
                f"weights={weights} are no {self.title} in TorchScript ({first}); give the file in which this"
                " network is passed on, or another extractor"
            ) from error
        if shape != (self.probe[0], self.width):
            raise ConfigError(
                f"weights={weights} are of another architecture: features {shape}, and those of"
                f" {self.title} are {(self.probe[0], self.width)}"
            )
        self.name = f"{self.title} ({hashlib.sha256(path.read_bytes()).hexdigest()[:8]})"
        self._device = torch.device("cpu")

    def compute_on(self, device: torch.device) -> None:
        """See Extractor.compute_on."""
        self._network, self._device = self._network.to(device), device

    def _features(self, some: Tensor) -> Tensor:
        """What the network says of pictures as it takes them, float32 [N, width] on the CPU."""
        return self._network(some.to(self._device).float(), **self.options).float().cpu()  # type: ignore[no-any-return]


class Inception(_TorchScript):
    """Pool3 of Inception v3 as of 2015-12-05, by which FID is defined; the usual TorchScript file."""

    title, width, clips = "Inception v3 pool3", 2048, False
    options: ClassVar[dict[str, bool]] = {"return_features": True}
    probe = (2, 3, 64, 64)

    @torch.no_grad()
    def __call__(self, pictures: Tensor) -> Tensor:
        """Features float32 [N, 2048]; the network resizes by itself."""
        return torch.cat([self._features(some) for some in pictures.split(32)])


class I3D(_TorchScript):
    """I3D logits as of Kinetics-400, by which FVD is defined; the usual TorchScript file."""

    title, width, clips, shortest = "I3D Kinetics-400", 400, True, 10
    options: ClassVar[dict[str, bool]] = {"rescale": True, "resize": True, "return_features": True}
    probe = (1, 3, 16, 64, 64)

    @torch.no_grad()
    def __call__(self, pictures: Tensor) -> Tensor:
        """Features float32 [N, 400] of clips of 10 frames or more."""
        return torch.cat([self._features(some.transpose(1, 2)) for some in pictures.split(4)])
