"""What a training clip holds, in frames."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ClipSpec:
    """Shape of a training clip.

    Args:
        memory: sparse memory frames, evenly spread over the past and always with the first, M.
        chunk: frames a chunk adds, K.
        chunks: consecutive chunks per clip, L.
        stride: frames between two frames of the clip.
        history: consecutive commands and states up to now, H; 0 is as many as `memory`.
        recent: whether memory is the newest frames instead, the first repeated where there are fewer.
    """

    memory: int = 4
    chunk: int = 8
    chunks: int = 1
    stride: int = 1
    history: int = 0
    recent: bool = False
