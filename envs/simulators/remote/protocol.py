"""The wire format of GE-Sim's world-model server: length-prefixed blocks, tiled JPEGs, float32 arrays, JSON
beside them.

Everything that comes from outside is checked here before it is believed: sizes against what was announced,
pictures against their own headers before they are decoded, numbers for NaN.
"""

from __future__ import annotations

import io
import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

QUALITY = 95  # of JPEGs, as released
TOKEN = "WORLDLOOP_TOKEN"  # environment variable; a config would carry the secret into logs and manifests
_MOST_PIXELS = 2**26  # of one tiled picture; a header may announce any size
_MOST_NUMBERS = 2**26


class ProtocolError(ValueError):
    """A body is truncated, malformed, or not what it announces."""


def pack(blocks: Sequence[bytes]) -> bytes:
    """Blocks in a row, each after its length as four big-endian bytes."""
    return b"".join(len(block).to_bytes(4, "big") + block for block in blocks)


def unpack(body: bytes, count: int | None = None) -> list[bytes]:
    """The blocks of a body: `count` of them, or all.

    Raises:
        ProtocolError: if the body ends early or goes on too long.
    """
    blocks: list[bytes] = []
    at = 0
    while at < len(body) if count is None else len(blocks) < count:
        if at + 4 > len(body):
            raise ProtocolError(f"block {len(blocks)}: the body ends at byte {len(body)}, within a length")
        size = int.from_bytes(body[at : at + 4], "big")
        at += 4
        if at + size > len(body):
            raise ProtocolError(f"block {len(blocks)} announces {size} bytes, {len(body) - at} are left")
        blocks.append(body[at : at + size])
        at += size
    if at != len(body):
        raise ProtocolError(f"{len(body) - at} bytes follow the last block")
    return blocks


def encode_frame(frame: NDArray[np.uint8]) -> bytes:
    """A frame uint8 [V, 3, H, W] as one JPEG, its views side by side."""
    buffer = io.BytesIO()
    tiled = np.concatenate(list(frame.transpose(0, 2, 3, 1)), axis=1)
    Image.fromarray(tiled).save(buffer, format="JPEG", quality=QUALITY)
    return buffer.getvalue()


def decode_frame(data: bytes, views: int, height: int, width: int) -> NDArray[np.uint8]:
    """A frame uint8 [V, 3, H, W] of one tiled JPEG.

    Raises:
        ProtocolError: if it is no JPEG, truncated, or of another size.
    """
    if views * height * width > _MOST_PIXELS:
        raise ProtocolError(
            f"a frame of {views} views of {height} x {width} is larger than this server takes"
        )
    try:
        with Image.open(io.BytesIO(data), formats=["JPEG"]) as picture:
            if picture.size != (views * width, height):  # known from the header, before anything is decoded
                raise ProtocolError(
                    f"a picture is {picture.size[1]} x {picture.size[0]} pixels, announced were {views}"
                    f" views of {height} x {width}"
                )
            tiled = np.asarray(picture.convert("RGB"))
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise (
            error if isinstance(error, ProtocolError) else ProtocolError(f"a picture cannot be read: {error}")
        ) from error
    return np.ascontiguousarray(tiled.reshape(height, views, width, 3).transpose(1, 3, 0, 2))


def parse(block: bytes) -> dict[str, Any]:
    """A JSON object.

    Raises:
        ProtocolError: if it is none.
    """
    try:
        value = json.loads(block.decode("utf-8")) if block else {}
    except (UnicodeDecodeError, ValueError, RecursionError) as error:
        raise ProtocolError(f"not a JSON object: {error}") from error
    if not isinstance(value, dict):
        raise ProtocolError(f"not a JSON object but {type(value).__name__}")
    return value


def shape_in(meta: Mapping[str, Any], key: str, form: str) -> tuple[int, ...]:
    """The shape `key` of a JSON object, whose `form`, such as "3,V,T,H,W", names unknown sizes and says known
    ones.

    Raises:
        ProtocolError: if it is missing or of another form.
    """
    value, names = meta.get(key), form.split(",")
    if isinstance(value, list) and len(value) == len(names):
        fits = (
            type(n) is int and 0 < n < 2**31 and (not name.isdigit() or int(name) == n)
            for name, n in zip(names, value, strict=True)
        )
        if all(fits):
            return tuple(value)
    raise ProtocolError(f"{key} must be [{form}], got {str(value)[:80]}")


def floats(block: bytes, shape: tuple[int, ...], name: str) -> NDArray[np.float32]:
    """Little-endian float32 numbers of a shape.

    Raises:
        ProtocolError: if there are more or fewer of them, or NaN or infinite ones.
    """
    count = math.prod(shape)
    if count > _MOST_NUMBERS or len(block) != 4 * count:
        raise ProtocolError(
            f"{name} announces {list(shape)}, that is {4 * count} bytes, and has {len(block)}"
        )
    values = np.frombuffer(block, "<f4").reshape(shape).copy()
    if not np.isfinite(values).all():
        raise ProtocolError(f"{name} holds NaN or infinite values")
    return values


def numbers(value: Any, form: tuple[int | None, ...], name: str) -> NDArray[np.float32]:
    """Finite float32 numbers of nested JSON lists of a form (None is any length).

    Raises:
        ProtocolError: if they are something else.
    """
    try:
        out = np.asarray(value, dtype=np.float32)
    except (ValueError, TypeError, OverflowError) as error:
        raise ProtocolError(f"{name} must be numbers of shape {form}: {error}") from error
    if (
        out.ndim != len(form)
        or any(want is not None and want != have for want, have in zip(form, out.shape, strict=True))
        or not np.isfinite(out).all()
    ):
        raise ProtocolError(f"{name} must be finite numbers of shape {form}, got shape {out.shape}")
    return out
