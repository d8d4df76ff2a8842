"""Videos and pictures for people: imagined above true."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from envs.episodes.clips import ClipStore
from envs.episodes.filming import Picture, side_by_side, tiled, titled
from envs.simulators.replay import Replay

REST = 5  # frames for which a paired video shows its last one


def paired_frames(store: ClipStore, episodes: Tensor, made: Replay, number: int) -> list[Picture]:
    """Frames RGB of one episode: what was imagined above, what was recorded below, all views side by side.

    Args:
        episodes: int64 [N], those that `made` replays.
        number: which of them.
    """
    valid = made.valid[number]
    first = store.frames(store.start[episodes[number : number + 1]])
    videos = (made.frames[number][valid], store.frames(made.rows[number][valid]))
    return tiled(
        [
            titled(side_by_side(torch.cat((first, video)).numpy()), words)
            for video, words in zip(videos, ("imagined", "recorded"), strict=True)
        ]
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
