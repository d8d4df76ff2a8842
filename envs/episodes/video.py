"""Video files through PyAV: H.264 in mp4, whole or truncated with a clear word about which."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import av
import numpy as np
from av.video.reformatter import VideoReformatter
from numpy.typing import NDArray

from envs.episodes.episode import EpisodeError


def write_video(
    path: Path, frames: Iterable[NDArray[np.uint8]], fps: float, crf: int = 10, browser: bool = False
) -> None:
    """Write frames uint8 [H, W, 3] RGB as H.264; the same frames give the same bytes.

    Args:
        path: the mp4 file; parents must exist.
        frames: pictures of equal, even size.
        fps: frames per second.
        crf: x264 quality, 0 lossless .. 51 worst.
        browser: use 4:2:0 colour, which browsers need; data keep 4:4:4, for at 64 pixels halved colour
            smears.
    """
    with av.open(str(path), "w", format="mp4") as container:
        stream = None
        for frame in frames:
            if stream is None:
                stream = container.add_stream("libx264", rate=round(fps))
                stream.height, stream.width = frame.shape[:2]
                stream.pix_fmt = "yuv420p" if browser else "yuv444p"
                # x264's macroblock tree reads memory that nobody wrote (with AVX-512): the same frames gave
                # other bytes, and pictures, each time.
                stream.options = {
                    "crf": str(crf),
                    "preset": "veryfast",
                    "g": "20",
                    "threads": "1",
                    "mbtree": "0",
                }
            for packet in stream.encode(
                av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24")
            ):
                container.mux(packet)
        if stream is not None:
            for packet in stream.encode():
                container.mux(packet)


def read_video(path: Path, expected: int | None = None) -> NDArray[np.uint8]:
    """Decode a whole video as uint8 [T, 3, H, W] RGB.

    Raises:
        EpisodeError: if the file is missing, damaged or shorter than `expected` frames.
    """
    try:
        with av.open(str(path)) as container:
            container.streams.video[0].thread_type = "NONE"
            # One reformatter for all frames: a new one each time would cost more than decoding does.
            convert = VideoReformatter()
            decoded = (convert.reformat(frame, format="rgb24") for frame in container.decode(video=0))
            frames = [frame.to_ndarray().transpose(2, 0, 1) for frame in decoded]
    except (av.error.FFmpegError, OSError, IndexError) as error:
        raise EpisodeError(
            f"{path}: not a readable video ({error}); collect this shard again or restore the file"
        ) from error
    if not frames or (expected is not None and len(frames) < expected):
        raise EpisodeError(f"{path}: holds {len(frames)} frames, expected {expected}; the file is truncated")
    return np.stack(frames)
