"""Video files through PyAV: H.264 in mp4 written, any codec read, whole or from a point in time on."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from av.video.reformatter import VideoReformatter
from numpy.typing import NDArray

from envs.episodes.episode import EpisodeError
from envs.episodes.pictures import resize_picture


def frame_rate(fps: float) -> Fraction:
    """Frames per second as PyAV takes them: 12.5 is 25/2, 29.97 is 2997/100."""
    return Fraction(fps).limit_denominator(1001)


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
                stream = container.add_stream("libx264", rate=frame_rate(fps))
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
            picture = av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24")
            for packet in stream.encode(picture):
                container.mux(packet)
        if stream is not None:
            for packet in stream.encode():
                container.mux(packet)


def read_video(path: Path) -> NDArray[np.uint8]:
    """Decode a whole video as uint8 [T, 3, H, W] RGB.

    Raises:
        EpisodeError: if the file is missing or damaged.
    """
    frames = [picture.transpose(2, 0, 1) for _, picture in _decode(path, 0.0)]
    if not frames:
        raise EpisodeError(f"{path}: holds no frames; the file is truncated")
    return np.stack(frames)


def read_clip(
    path: Path, start: float, length: int, fps: float, size: tuple[int, int] | None = None
) -> NDArray[np.uint8]:
    """Decode `length` frames from a point in time on, without reading the video's other frames.

    Args:
        path: the video.
        start: time of the first frame in seconds.
        fps: of the recording; frame k is the one nearest to start + k / fps.
        size: (height, width) to bring pictures to, None for the video's own.

    Returns:
        uint8 [length, 3, H, W] RGB.

    Raises:
        EpisodeError: if the file is missing, damaged or lacks some of these frames.
    """
    out: NDArray[np.uint8] | None = None
    found = np.zeros(length, bool)
    for time, picture in _decode(path, start, 0.5 / fps):
        number = round((time - start) * fps)
        if number >= length:
            break
        if number < 0 or found[number]:
            continue
        shown = picture if size is None else resize_picture(picture, size)
        if out is None:
            out = np.empty((length, 3, *shown.shape[:2]), np.uint8)
        out[number], found[number] = shown.transpose(2, 0, 1), True
        if number == length - 1:
            break
    if out is None or not found.all():
        raise EpisodeError(
            f"{path}: holds {int(found.sum())} of the {length} frames from {start:.3f} s on at {fps:g} Hz;"
            " the file is truncated: restore it or collect its episodes again; or fps of meta/info.json is"
            " not that of the video"
        )
    return out


def _decode(path: Path, start: float, slack: float = 0.0) -> Iterator[tuple[float, NDArray[np.uint8]]]:
    """Times in seconds and pictures uint8 [H, W, 3] from the last key frame before `start` on."""
    try:
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            stream.thread_type = "NONE"
            # One reformatter for all frames: a new one each time would cost more than decoding does.
            convert = VideoReformatter()
            base = stream.time_base or Fraction(1, 1000)
            first = True
            if start > 0:
                container.seek(max(0, int((start - slack) / base)), stream=stream)
            for frame in container.decode(stream):
                time = float((frame.pts or 0) * base)
                if first and start > 0 and time > start + slack:  # the container has no good index
                    container.seek(0, stream=stream)
                    first, start = False, 0.0
                    continue
                first = False
                if time < start - slack:
                    continue
                picture = convert.reformat(frame, format="rgb24").to_ndarray()
                yield time, np.asarray(picture, np.uint8)
    except (av.error.FFmpegError, OSError, IndexError) as error:
        raise EpisodeError(
            f"{path}: not a readable video ({error}); restore the file or collect its episodes again"
        ) from error
