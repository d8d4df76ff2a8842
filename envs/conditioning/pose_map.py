"""Pose maps: the commanded grippers drawn into each camera, as in GE-Sim 2.0.

A filled circle marks each fingertip (size: how near, shade: how closed) and three thick lines its axes.
Drawing goes plane by plane into the [3, H, W] result, which saves the transposition an RGB canvas would need.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from envs.geometry.rotations import pose_transforms
from envs.ranges import Positive

CANVAS = 50  # of 255, where nothing is drawn
_AXIS = 0.1  # m
# RGB of the x, y and z axis lines, and colour map of the circle, of the first arm (GE-Sim's left), the second
# (its right); further arms, of which GE-Sim has none, begin anew.
AXIS_RGB = (((0, 0, 255), (255, 255, 0), (0, 255, 255)), ((255, 0, 255), (255, 0, 0), (0, 255, 0)))
_COLOUR_MAPS = ("Greens", "Reds")
_FRACTION = 4  # bits of a pixel's fraction that are drawn
_REFERENCE_HEIGHT = 384  # the picture height for which radii and thickness are given


@dataclass(frozen=True)
class PoseMapStyle:
    """How a pose map is drawn. The defaults are constants of a format: they reproduce the released GE-Sim 2.0
    code at 384 x 512, which is what a pose map is where nobody says otherwise.

    Args:
        tool_offset: metres from wrist to fingertip along the wrist's z (GE-Sim 1: 0.23).
        radius_law: "released" draws 100 * clip(1 - d - 0.07/0.73, 0, 1) pixels, "paper" 100 * clip(1 - (d -
            0.07)/0.73, 0, 1).
        cull_behind: leave out what lies behind the camera; the released code does not ask.
        scale: factor on radii and thickness; None scales them with the picture's height.
        antialias: draw to a fraction of a pixel, with soft edges, instead of cutting positions and radii off
            to whole pixels. In small pictures a whole pixel is more than what an action changes.
    """

    tool_offset: float = 0.15
    radius_law: Literal["released", "paper"] = "released"
    cull_behind: bool = False
    scale: Positive | None = None
    antialias: bool = False


@lru_cache(maxsize=1)
def arm_shades() -> np.ndarray:
    """Fill colours [2, 256, 3] RGB of the first and the second arm's circle, by colour-map index."""
    import matplotlib

    maps = [matplotlib.colormaps[name] for name in _COLOUR_MAPS]
    return np.stack([(shades(np.arange(256))[:, :3] * 255).astype(np.uint8) for shades in maps])


def render_pose_map(
    poses: Tensor, c2w: Tensor, intrinsic: Tensor, size: tuple[int, int], style: PoseMapStyle | None = None
) -> Tensor:
    """Draw the grippers of every time step into every camera.

    Args:
        poses: [..., T, arms, 7] flange poses [x, y, z, roll, pitch, yaw, gripper], metres and radians, world
            frame; gripper 0 open .. 1 closed, values beyond take the colour map's ends.
        c2w: [..., V, T, 4, 4] camera to world, OpenCV convention; zeros of a camera that is not calibrated,
            into which nothing is drawn.
        intrinsic: [..., V, 3, 3] in pixels of `size`.
        size: (height, width) in pixels.
        style: how to draw.

    Returns:
        uint8 [..., V, T, 3, H, W] RGB.

    Raises:
        ValueError: if shapes do not fit or poses are not finite.
    """
    style = style or PoseMapStyle()
    if poses.shape[-1] != 7 or c2w.shape[-2:] != (4, 4) or intrinsic.shape[-2:] != (3, 3):
        raise ValueError(
            "pose map wants poses [..., T, arms, 7], c2w [..., V, T, 4, 4], intrinsic [..., V, 3, 3]; "
            f"got {tuple(poses.shape)}, {tuple(c2w.shape)}, {tuple(intrinsic.shape)}"
        )
    if poses.shape[-3] != c2w.shape[-3] or c2w.shape[-4] != intrinsic.shape[-3]:
        raise ValueError(
            f"poses have T={poses.shape[-3]}, c2w V, T={tuple(c2w.shape[-4:-2])},"
            f" intrinsic V={intrinsic.shape[-3]}"
        )
    if not torch.isfinite(poses).all() or not torch.isfinite(c2w).all():
        raise ValueError("pose map: poses or c2w hold NaN or infinite values")
    lead, views, steps, count = c2w.shape[:-4], c2w.shape[-4], c2w.shape[-3], poses.shape[-2]
    pixels, radii, shades, visible = layout(poses, c2w, intrinsic, size, style)
    scale = size[0] / _REFERENCE_HEIGHT if style.scale is None else style.scale
    thickness = max(1, round(8 * scale))
    # OpenCV takes fractions as fixed point numbers, from the middle of the first pixel on.
    edges, bits, middle = (cv2.LINE_AA, _FRACTION, 0.5) if style.antialias else (cv2.LINE_8, 0, 0.0)
    pixels, radii = fixed_point(pixels - middle, bits), fixed_point(radii, bits)
    total = int(np.prod(lead)) * views * steps
    canvas = np.full((total, 3, *size), CANVAS, np.uint8)
    lut = arm_shades().tolist()
    flat_pixels = pixels.reshape(total, count, 4, 2).tolist()
    flat_radii, flat_shades = radii.reshape(total, count).tolist(), shades.reshape(total, count).tolist()
    flat_visible = visible.reshape(total, count).tolist()
    circle, line = cv2.circle, cv2.line
    for n in range(total):
        planes, points = canvas[n], flat_pixels[n]
        arms = [arm for arm in range(count) if flat_visible[n][arm]]
        if not arms:
            continue
        for channel in range(3):
            plane = planes[channel]
            for arm in arms:
                shade = lut[arm % 2][flat_shades[n][arm]][channel]
                circle(plane, points[arm][0], flat_radii[n][arm], shade, -1, edges, bits)
            for arm in arms:
                origin = points[arm][0]
                for axis in range(3):
                    colour = AXIS_RGB[arm % 2][axis][channel]
                    line(plane, origin, points[arm][axis + 1], colour, thickness, edges, bits)
    return torch.from_numpy(canvas).reshape(*lead, views, steps, 3, *size)


def pose_map_cells(maps: Tensor, stride: int) -> Tensor:
    """Pose maps uint8 [B, T, V, 3, H, W] at the resolution of latents or tokens, float32 [B, T, V, C, H /
    stride, W / stride] in -1..1: pixels become channels at half their resolution. Means over whole cells
    would not say where in them a gripper is.
    """
    half = F.avg_pool2d(maps.flatten(0, 2).float() / 127.5 - 1, 2)
    return F.pixel_unshuffle(half, stride // 2).unflatten(0, maps.shape[:3])


def pose_map_channels(stride: int) -> int:
    """The channels C that `pose_map_cells` gives."""
    return 3 * (stride // 2) ** 2


def fixed_point(values: np.ndarray, bits: int) -> np.ndarray:
    """Pixels as OpenCV's drawing takes them: whole numbers of 2 ** -bits, cut off; int64 like values."""
    return np.trunc(values * 2**bits).astype(np.int64)


def layout(
    poses: Tensor, c2w: Tensor, intrinsic: Tensor, size: tuple[int, int], style: PoseMapStyle
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Where things are drawn; arguments as of `render_pose_map`.

    Returns:
        Pixels float64 [..., V, T, arms, 4, 2] of origin and axis tips, the first pixel from 0 to 1; radii
        float64, shade indices and visibility [..., V, T, arms].
    """
    height, width = size
    wrist = pose_transforms(poses.double())  # [..., T, arms, 4, 4]
    origin = wrist[..., :3, 3] + style.tool_offset * wrist[..., :3, 2]
    tips = origin.unsqueeze(-2) + _AXIS * wrist[..., :3, :3].transpose(-1, -2)  # rows are the axes
    points = torch.cat((origin.unsqueeze(-2), tips), -2).unsqueeze(-5)  # [..., 1, T, arms, 4, 3]
    known = c2w[..., 3, 3] != 0  # [..., V, T]
    regular = torch.where(known[..., None, None], c2w.double(), torch.eye(4, dtype=torch.float64))
    # NumPy's float64 inverse and matrix products set the last bit, and truncation to int makes it visible.
    w2c = torch.linalg.inv(regular).unsqueeze(-3)  # [..., V, T, 1, 4, 4]
    camera = points @ w2c[..., :3, :3].transpose(-1, -2) + w2c[..., None, :3, 3]
    image = camera @ intrinsic.double()[..., :, None, None, :, :].transpose(-1, -2)
    depth = camera[..., 2]
    pixels = (
        (image[..., :2] / image[..., 2:]).nan_to_num(nan=-1e6, posinf=-1e6, neginf=-1e6).clamp(-30000, 30000)
    )
    at = pixels[..., 0, :].trunc()
    inside = (at[..., 0] >= 0) & (at[..., 0] < width) & (at[..., 1] >= 0) & (at[..., 1] < height)
    visible = known[..., None] & inside
    if style.cull_behind:
        visible &= depth[..., 0] > 0
    distance = (c2w.double()[..., None, :3, 3] - wrist[..., :3, 3].unsqueeze(-4)).norm(dim=-1)
    law = 1 - distance - 0.07 / 0.73 if style.radius_law == "released" else 1 - (distance - 0.07) / 0.73
    scale = height / _REFERENCE_HEIGHT if style.scale is None else style.scale
    radii = 100 * scale * law.clamp(0, 1)
    shades = (((poses.double()[..., 6] * 85 + 35) / 120) * 256).long().clamp(0, 255)
    shades = shades.unsqueeze(-3).expand(radii.shape)
    return pixels.numpy(), radii.numpy(), shades.numpy(), visible.numpy()
