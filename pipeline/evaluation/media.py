"""Videos and pictures for people: imagined above true."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from envs.episodes.clips import ClipStore
from envs.episodes.video import write_video
from envs.files import atomic
from envs.simulators.replay import Replay

_HEIGHT = 192  # pixels of a view in videos, about


def paired_frames(store: ClipStore, episodes: Tensor, made: Replay, number: int) -> list[NDArray[np.uint8]]:
    """Frames RGB of one episode: what was imagined above, what was recorded below, all views side by side.

    Args:
        episodes: int64 [N], those that `made` replays.
        number: which of them.
    """
    valid = made.valid[number]
    imagined, true = made.frames[number][valid].numpy(), store.frames(made.rows[number][valid]).numpy()
    first = store.frames(store.start[episodes[number : number + 1]]).numpy()
    scale = max(1, round(_HEIGHT / store.spec.size[0]))
    out = []
    for above, below in zip(np.concatenate([first, imagined]), np.concatenate([first, true]), strict=True):
        rows = [np.concatenate(list(views.transpose(0, 2, 3, 1)), 1) for views in (above, below)]
        big = [cv2.resize(row, None, fx=scale, fy=scale, interpolation=cv2.INTER_NEAREST) for row in rows]
        bars = [np.full((22, big[0].shape[1], 3), 24, np.uint8) for _ in range(2)]
        for bar, text in zip(bars, ("imagined", "recorded"), strict=True):
            cv2.putText(bar, text, (6, 15), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (230, 230, 230), 1, cv2.LINE_AA)
        out.append(np.concatenate([bars[0], big[0], bars[1], big[1]]))
    return [_even(frame) for frame in out]


def film(path: Path, frames: NDArray[np.uint8], fps: float) -> None:
    """Write frames uint8 [T, V, 3, H, W] as an mp4 that browsers play, all views side by side."""
    scale = max(1, round(_HEIGHT / frames.shape[-2]))
    rows = frames.transpose(0, 3, 1, 4, 2).reshape(len(frames), frames.shape[-2], -1, 3)
    _video(path, [_even(row.repeat(scale, 0).repeat(scale, 1)) for row in rows], fps)


def paired_video(path: Path, frames: Sequence[NDArray[np.uint8]], fps: float) -> None:
    """Write `paired_frames` as an mp4 that browsers play; it ends with a moment's rest."""
    _video(path, [*frames, *[frames[-1]] * 5], fps)


def _video(path: Path, frames: Sequence[NDArray[np.uint8]], fps: float) -> None:
    with atomic(path) as part:  # trackers send whatever mp4 they find
        write_video(part, frames, fps, crf=20, browser=True)


def _even(frame: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A frame [H, W, 3] less a row or column, so that both sides are even, as H.264 asks."""
    return np.ascontiguousarray(frame[: frame.shape[0] // 2 * 2, : frame.shape[1] // 2 * 2])


def write_gif(path: Path, frames: Sequence[NDArray[np.uint8]], fps: float) -> None:
    """Write frames uint8 [H, W, 3] as an endless GIF, which is what a README can show."""
    from PIL import Image

    pictures = [Image.fromarray(frame).quantize(128) for frame in frames]
    path.parent.mkdir(parents=True, exist_ok=True)
    pictures[0].save(
        path, save_all=True, append_images=pictures[1:], duration=round(1000 / fps), loop=0, optimize=True
    )


def inline(data: bytes, kind: str) -> str:
    """A data URL, so that a report is one file."""
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"


def smooth(values: Sequence[float], width: int) -> list[float]:
    """Running mean over `width` values."""
    array: NDArray[Any] = np.asarray(values, float)
    if len(array) <= width:
        return array.tolist()
    return np.convolve(array, np.ones(width) / width, "valid").tolist()
