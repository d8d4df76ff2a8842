"""What a training clip holds, in frames."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ClipSpec:
    """Shape of a training clip.

    Args:
        memory: memory frames, M.
        chunk: frames a chunk adds, K.
        chunks: consecutive chunks per clip, L.
        stride: frames between two frames of the clip.
        history: consecutive commands and states up to now, H; 0 is as many as `memory`.
        newest: of the memory frames, those that are the newest; the others are evenly spread over the past
            (memory_indices).
    """

    memory: int = 4
    chunk: int = 8
    chunks: int = 1
    stride: int = 1
    history: int = 0
    newest: int = 1
