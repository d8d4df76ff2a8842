"""Which frames of a clip a question shows, and as what pictures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from envs.episodes.pictures import resize_picture
from envs.ranges import Count, Natural

_SEAM = 4  # black pixels between cameras


@dataclass(frozen=True)
class Pictures:
    """What a question shows.

    Args:
        span: frames that one question is about. "chunk": as many as reinforcement learning hands over at
            once, so that a recorded episode is judged as an imagined one is; "clip": all that are there.
        every: frames from one picture to the next, counted back from the last, which is always shown.
        side: pixels of a picture's shorter side at least; smaller ones are enlarged.
    """

    span: Literal["chunk", "clip"]
    every: Count
    side: Natural

    def spans(self, count: int, chunk: int) -> list[range]:
        """The frames 0..count-1 that each question is about, in order."""
        length = chunk if self.span == "chunk" else count
        return [range(begin, min(begin + length, count)) for begin in range(0, count, length)]

    def shown(self, span: range) -> list[int]:
        """Those of a span's frames that are shown, in order."""
        return list(span[::-1][:: self.every])[::-1]

    def draw(self, frame: NDArray[np.uint8], views: tuple[int, ...]) -> NDArray[np.uint8]:
        """Some views of a frame uint8 [V, 3, H, W] side by side, uint8 [H', W', 3]."""
        height, width = frame.shape[-2:]
        scale = max(1.0, self.side / min(height, width))
        size = (round(height * scale), round(width * scale))
        parts: list[NDArray[np.uint8]] = []
        for view in views:
            parts += [np.zeros((size[0], _SEAM, 3), np.uint8)] * bool(parts)
            parts.append(resize_picture(np.ascontiguousarray(frame[view].transpose(1, 2, 0)), size))
        return np.concatenate(parts, 1)


def new_frames(frames: NDArray[np.uint8]) -> int:
    """Length of a clip uint8 [T, ...] without the repeats of its last frame, by which episodes are brought to
    one length; at least 1.
    """
    count = len(frames)
    while count > 1 and np.array_equal(frames[count - 1], frames[count - 2]):
        count -= 1
    return count


def jpeg(picture: NDArray[np.uint8], quality: int) -> bytes:
    """A picture uint8 [H, W, 3], RGB, as a JPEG file."""
    ok, data = cv2.imencode(
        ".jpg", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality]
    )
    assert ok, "OpenCV writes JPEG"
    return data.tobytes()
