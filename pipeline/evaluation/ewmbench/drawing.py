"""Videos for people: generated above recorded, with the grippers' trajectories drawn over both."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from envs.episodes.filming import tiled, titled, write_film, zoom_to
from pipeline.evaluation.media import REST

_COLOURS = (
    (250, 204, 21),
    (34, 211, 238),
    (244, 114, 182),
    (163, 230, 53),
)  # RGB of arms; further ones begin anew
_DIM = 0.45  # of the recorded trajectory's colour in the generated video


def film_tracks(
    path: Path,
    videos: tuple[Tensor, Tensor],
    tracks: tuple[Tensor | None, Tensor | None],
    fps: float,
) -> None:
    """Write an mp4 of a generated video above its recording, cut to the shorter of both.

    Args:
        videos: generated and recorded, uint8 [T, V, 3, H, W] each.
        tracks: float32 [T, V, arms, 2] pixels of either, NaN where nothing was found; None to draw nothing.
            In the generated video the recorded trajectory is drawn too, darker.
    """
    frames = min(len(video) for video in videos)
    made, true = (np.zeros((0,)) if part is None else part.numpy() for part in tracks)
    above = _rows(videos[0][:frames], [(true, _DIM), (made, 1.0)])
    below = _rows(videos[1][:frames], [(true, 1.0)])
    write_film(path, tiled([titled(above, "generated"), titled(below, "recorded")]), fps, rest=REST)


def _rows(video: Tensor, drawn: Sequence[tuple[NDArray[Any], float]]) -> list[NDArray[np.uint8]]:
    """Pictures uint8 [h, w, 3] of a video's views side by side, enlarged, with trajectories up to each
    frame.
    """
    scale = zoom_to(video.shape[-2])
    out = []
    for t, frame in enumerate(video.numpy()):
        parts = []
        for view, picture in enumerate(frame):
            big = np.ascontiguousarray(picture.transpose(1, 2, 0).repeat(scale, 0).repeat(scale, 1))
            for tracks, share in drawn:
                for arm in range(tracks.shape[2]) if tracks.ndim == 4 else ():
                    _line(big, tracks[: t + 1, view, arm] * scale, arm, share)
            parts.append(big)
        out.append(np.concatenate(parts, 1))
    return out


def _line(picture: NDArray[np.uint8], points: NDArray[Any], arm: int, share: float) -> None:
    """Draw a trajectory [t, 2], with a ring at its last point; gaps stay open."""
    colour = tuple(int(value * share) for value in _COLOURS[arm % len(_COLOURS)])
    seen = np.isfinite(points).all(-1)
    for begin in range(len(points) - 1):
        if seen[begin] and seen[begin + 1]:
            a, b = (tuple(int(v) for v in points[k]) for k in (begin, begin + 1))
            cv2.line(picture, a, b, colour, 1, cv2.LINE_AA)
    if seen[-1]:
        cv2.circle(picture, tuple(int(v) for v in points[-1]), 4, colour, 1, cv2.LINE_AA)
