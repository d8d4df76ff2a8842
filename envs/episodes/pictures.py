"""Bringing pictures, and the intrinsics of their cameras, to another size."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray


def resize_picture(picture: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.uint8]:
    """A picture uint8 [H, W, 3] at another (height, width): averaged if smaller, interpolated if larger."""
    if picture.shape[:2] == tuple(size):
        return picture
    shrinks = size[0] * size[1] < picture.shape[0] * picture.shape[1]
    way = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(picture, (size[1], size[0]), interpolation=way), np.uint8)


def resize_frames(
    frames: NDArray[np.uint8], size: tuple[int, int], present: NDArray[np.bool_] | None = None
) -> NDArray[np.uint8]:
    """Frames uint8 [T, V, 3, H, W] at another (height, width); those not `present` [T] stay black."""
    if frames.shape[-2:] == tuple(size):
        return frames
    out = np.zeros((*frames.shape[:3], *size), np.uint8)
    for t in range(len(frames)) if present is None else np.flatnonzero(present):
        for v in range(frames.shape[1]):
            out[t, v] = resize_picture(frames[t, v].transpose(1, 2, 0), size).transpose(2, 0, 1)
    return out


def resize_intrinsics(
    intrinsic: NDArray[np.float32], old: tuple[int, int], new: tuple[int, int]
) -> NDArray[np.float32]:
    """Intrinsics [..., 3, 3] of pictures brought from one (height, width) to another; centres at +0.5."""
    return intrinsic * np.array([[new[1] / old[1]], [new[0] / old[0]], [1.0]], np.float32)
