"""Videos and pictures for people: imagined above true, curves, pictures of the bench."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from envs.episodes.clips import ClipStore
from envs.episodes.video import write_video
from envs.simulators.replay import Replay

_HEIGHT = 192  # pixels of a view in videos, about


def paired_frames(
    store: ClipStore, episodes: Tensor, made: Replay, number: int, title: str
) -> list[NDArray[np.uint8]]:
    """Frames RGB of one episode: what was imagined above, what was recorded below, all views side by side.

    Args:
        episodes: int64 [N], those that `made` replays.
        number: which of them.
        title: stands beside "imagined".
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
        for bar, text in zip(bars, (f"imagined   {title}", "recorded"), strict=True):
            cv2.putText(bar, text, (6, 15), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (230, 230, 230), 1, cv2.LINE_AA)
        out.append(np.concatenate([bars[0], big[0], bars[1], big[1]]))
    return [
        np.ascontiguousarray(frame[: frame.shape[0] // 2 * 2, : frame.shape[1] // 2 * 2]) for frame in out
    ]


def paired_video(path: Path, frames: Sequence[NDArray[np.uint8]], fps: float) -> None:
    """Write `paired_frames` as an mp4 that browsers play."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_video(path, [*frames, *[frames[-1]] * 5], fps, crf=20, browser=True)


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


def plot(
    curves: Sequence[tuple[str, Sequence[float], Sequence[float]]],
    title: str,
    xlabel: str,
    ylabel: str,
    size: tuple[float, float] = (5.2, 2.8),
) -> str:
    """Line plot of (label, x, y) as a data URL of an SVG."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=size)
    for label, x, y in curves:
        axes.plot(x, y, label=label, linewidth=1.6)
    axes.set(title=title, xlabel=xlabel, ylabel=ylabel)
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
    if len(curves) > 1:
        axes.legend(frameon=False, fontsize=8)
    figure.tight_layout()
    buffer = io.BytesIO()
    figure.savefig(buffer, format="svg")
    plt.close(figure)
    return inline(buffer.getvalue(), "image/svg+xml")


def smooth(values: Sequence[float], width: int) -> list[float]:
    """Running mean over `width` values."""
    array: NDArray[Any] = np.asarray(values, float)
    if len(array) <= width:
        return array.tolist()
    return np.convolve(array, np.ones(width) / width, "valid").tolist()
