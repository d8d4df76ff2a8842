"""What readers of foreign recordings share: how much to keep, numbers and pictures, bare episodes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from envs.embodiment import Embodiment
from envs.episodes.episode import Episode, EpisodeError


@dataclass(frozen=True)
class Cut:
    """How much of a recording to keep.

    Args:
        frames: the first so many, 0 for all.
        size: (height, width) to resize to, () for the source's own; intrinsics are scaled alike.

    Raises:
        ValueError: if that is no number of frames, or no size.
    """

    frames: int = 0
    size: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        if self.frames < 0:
            raise ValueError(f"frames={self.frames} is below 0")
        if self.size and (len(self.size) != 2 or min(self.size) < 1):
            raise ValueError(f"size={list(self.size)} should be [height,width]")

    def of(self, episode: Episode) -> Episode:
        """The episode so cut."""
        part = episode.take(slice(0, self.frames)) if self.frames else episode
        return part.resized((self.size[0], self.size[1])) if self.size else part


@dataclass(frozen=True)
class Format:
    """A format: its name, where recordings of it lie under a folder, and what reads one."""

    name: str
    find: Callable[[Path], list[Path]]
    read: Callable[[Path, int, Cut], Episode]


def read_numbers(path: Path, shape: tuple[int | None, ...]) -> NDArray[np.float32]:
    """A .npy array of a shape (None is any length), without pickles.

    Raises:
        EpisodeError: naming the file, if it is missing, of another shape or holds NaN.
    """
    try:
        values = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise EpisodeError(f"{path}: {error}") from error
    fits = values.ndim == len(shape) and all(
        want in (None, have) for have, want in zip(values.shape, shape, strict=True)
    )
    if not fits:
        wanted = tuple("T" if want is None else want for want in shape)
        raise EpisodeError(f"{path} has shape {values.shape}, expected {wanted}")
    if not np.isfinite(values).all():
        raise EpisodeError(f"{path} holds NaN or infinite values")
    return np.asarray(values, np.float32)


def read_picture(path: Path) -> NDArray[np.uint8]:
    """A picture uint8 [3, H, W] RGB.

    Raises:
        EpisodeError: if it is missing or damaged.
    """
    picture = cv2.imread(str(path), cv2.IMREAD_COLOR_RGB)
    if picture is None:
        raise EpisodeError(f"{path} is missing or no readable picture")
    return np.asarray(picture.transpose(2, 0, 1), np.uint8)


def assemble(
    robot: Embodiment, pictures: dict[int, list[NDArray[np.uint8]]], length: int, place: Path, **known: Any
) -> Episode:
    """An episode of `length` rows of which only some have pictures.

    Args:
        robot: whose it is; its cameras take the pictures' size.
        pictures: per row one uint8 [3, H, W] of each camera.
        length: T.
        place: where it comes from, for messages.
        **known: the other fields of Episode.

    Raises:
        EpisodeError: if pictures differ in size.
    """
    sizes = {picture.shape for views in pictures.values() for picture in views}
    if len(sizes) > 1:
        raise EpisodeError(f"{place}: pictures of different sizes {sorted(sizes)}")
    (shape,) = sizes
    frames = np.zeros((length, len(robot.cameras), *shape), np.uint8)
    present = np.zeros(length, bool)
    for row, views in pictures.items():
        frames[row], present[row] = np.stack(views), True
    return Episode(frames=frames, present=present, embodiment=robot.at((shape[1], shape[2])), **known)
