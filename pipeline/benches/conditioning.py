"""worldloop bench conditioning: pose and ray maps at 384 x 512 on one core, beside a plain OpenCV loop."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import torch

from envs.conditioning import PoseMapStyle, render_pose_map, render_ray_map
from envs.conditioning.pose_map import AXIS_RGB, CANVAS, arm_shades, fixed_point, layout
from pipeline.benches.timing import best

_SIZE, _STEPS, _VIEWS = (384, 512), 10, 3
_THICKNESS = 8  # of an axis at that size


def conditioning(cfg: dict[str, Any]) -> None:
    """Milliseconds per view-frame of two moving grippers seen by three cameras."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    poses, c2w, intrinsic = scene()
    count = _STEPS * _VIEWS
    ours = best(lambda: render_pose_map(poses, c2w, intrinsic, _SIZE)) / count * 1e3
    plain = best(lambda: plain_pose_map(poses, c2w, intrinsic)) / count * 1e3
    rays = best(lambda: render_ray_map(intrinsic, c2w, _SIZE)) / count * 1e3
    drawn = render_pose_map(poses, c2w, intrinsic, _SIZE).flatten(0, 1).numpy()
    same = np.array_equal(plain_pose_map(poses, c2w, intrinsic), drawn)
    print(
        f"pose map  {ours:.3f} ms per view-frame at 384x512 (goal 0.12), OpenCV loop {plain:.3f} ms:"
        f" {plain / ours:.1f}x; pictures equal: {same}"
    )
    print(f"ray map   {rays:.3f} ms per view-frame")


def scene() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Flange poses [T, 2, 7] half a metre before cameras c2w [V, T, 4, 4] with intrinsics [V, 3, 3]."""
    poses = torch.zeros(_STEPS, 2, 7)
    poses[:, 0, 0], poses[:, 1, 0], poses[..., 2] = -0.1, 0.1, 0.6
    poses[..., 0] += torch.linspace(0, 0.1, _STEPS)[:, None]
    c2w = torch.eye(4).repeat(_VIEWS, _STEPS, 1, 1)
    c2w[..., 1, 3] = torch.linspace(-0.1, 0.1, _VIEWS)[:, None]
    height, width = _SIZE
    intrinsic = torch.tensor([[width / 2, 0, width / 2], [0, width / 2, height / 2], [0, 0, 1.0]])
    return poses, c2w, intrinsic.expand(_VIEWS, 3, 3).contiguous()


def plain_pose_map(poses: torch.Tensor, c2w: torch.Tensor, intrinsic: torch.Tensor) -> np.ndarray:
    """The same pictures uint8 [V * T, 3, H, W], drawn on interleaved canvases one after the other."""
    pixels, radii, shades, visible = layout(poses, c2w, intrinsic, _SIZE, PoseMapStyle())
    pixels, radii = fixed_point(pixels, 0), fixed_point(radii, 0)
    lut, out = arm_shades(), []
    for v in range(len(intrinsic)):
        for t in range(len(poses)):
            canvas = np.full((*_SIZE, 3), CANVAS, np.uint8)
            arms = np.flatnonzero(visible[v, t])
            for arm in arms:
                centre = tuple(int(x) for x in pixels[v, t, arm, 0])
                cv2.circle(
                    canvas, centre, int(radii[v, t, arm]), lut[arm % 2][shades[v, t, arm]].tolist(), -1
                )
            for arm in arms:
                centre = tuple(int(x) for x in pixels[v, t, arm, 0])
                for axis in range(3):
                    tip = tuple(int(x) for x in pixels[v, t, arm, axis + 1])
                    cv2.line(canvas, centre, tip, AXIS_RGB[arm % 2][axis], _THICKNESS)
            out.append(np.ascontiguousarray(canvas.transpose(2, 0, 1)))
    return np.stack(out)
