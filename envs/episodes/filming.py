"""Videos and pictures for people: all views side by side, enlarged, with a line of words above."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from envs.episodes.video import write_video
from envs.files import atomic

HEIGHT = 192  # pixels of an enlarged view, about
BAR = 22  # pixels of a line of words
Picture = NDArray[np.uint8]  # RGB [H, W, 3]


def zoom_to(pixels: int, height: int = HEIGHT) -> int:
    """The whole number by which pictures of so many pixels come closest to that height."""
    return max(1, round(height / pixels))


def side_by_side(frames: NDArray[np.uint8], height: int = HEIGHT) -> list[Picture]:
    """Frames uint8 [T, V, 3, H, W] as T pictures, each with its V views side by side, enlarged to about that
    height.
    """
    zoom = zoom_to(frames.shape[-2], height)
    rows = frames.transpose(0, 3, 1, 4, 2).reshape(len(frames), frames.shape[-2], -1, 3)
    return [row.repeat(zoom, 0).repeat(zoom, 1) for row in rows]


def bar(text: str, width: int) -> Picture:
    """A dark line [BAR, width, 3] with words."""
    out = np.full((BAR, width, 3), 24, np.uint8)
    cv2.putText(out, text, (6, 15), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (230, 230, 230), 1, cv2.LINE_AA)
    return out


def titled(pictures: Sequence[Picture], words: str | Sequence[str]) -> list[Picture]:
    """Pictures with a line of words above each: the same over all, or one for each."""
    lines = [words] * len(pictures) if isinstance(words, str) else words
    return [np.concatenate((bar(line, row.shape[1]), row)) for row, line in zip(pictures, lines, strict=True)]


def tiled(videos: Sequence[Sequence[Picture]], columns: int = 1) -> list[Picture]:
    """Videos of equal size below each other, or in so many columns; shorter ones rest at their end."""
    blank, out = np.zeros_like(videos[0][0]), []
    for t in range(max(map(len, videos))):
        tiles = [video[min(t, len(video) - 1)] for video in videos]
        tiles += [blank] * (-len(tiles) % columns)
        lines = [np.concatenate(tiles[k : k + columns], 1) for k in range(0, len(tiles), columns)]
        out.append(np.concatenate(lines))
    return out


def write_film(path: Path, pictures: Sequence[Picture], fps: float, rest: int = 0) -> None:
    """Write pictures as an mp4 that browsers play, which shows the last one for `rest` frames more."""
    shown = (_even(np.asarray(picture)) for picture in (*pictures, *[pictures[-1]] * rest))
    with atomic(path) as part:  # trackers send whatever mp4 they find
        write_video(part, shown, fps, crf=20, browser=True)


def write_gif(path: Path, pictures: Sequence[Picture], fps: float) -> None:
    """Write pictures as an endless GIF, which is what a README can show."""
    from PIL import Image

    first, *others = [Image.fromarray(picture).quantize(128) for picture in pictures]
    with atomic(path) as part:
        first.save(
            part,
            format="GIF",
            save_all=True,
            append_images=others,
            duration=round(1000 / fps),
            loop=0,
            optimize=True,
        )


def _even(picture: Picture) -> Picture:
    """A picture less a row or column, so that both sides are even, as H.264 asks."""
    return np.ascontiguousarray(picture[: picture.shape[0] // 2 * 2, : picture.shape[1] // 2 * 2])
