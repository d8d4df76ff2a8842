"""Pose and ray maps against the public implementation's exact outputs, and against their own definition."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from envs.conditioning import PoseMapStyle, render_pose_map, render_ray_map


@pytest.fixture(scope="module")
def golden(shared: Path) -> dict[str, np.ndarray]:
    return dict(np.load(shared / "golden/pose_map_gesim_v2_demo_000.npz"))


def test_pose_map_equals_the_public_one_in_every_pixel(golden: dict[str, np.ndarray]) -> None:
    drawn = render_pose_map(
        *(torch.from_numpy(golden[k]) for k in ("eef_poses", "c2w", "intrinsic")),
        tool_offset=float(golden["gripper_offset"]),
    )
    assert np.array_equal(drawn.numpy(), golden["pose_map_uint8"].transpose(1, 2, 0, 3, 4))


def test_ray_map_equals_the_public_one(golden: dict[str, np.ndarray]) -> None:
    rays = render_ray_map(
        torch.from_numpy(golden["intrinsic"]), torch.from_numpy(golden["c2w"][:, :2]), (384, 512), stride=16
    )
    assert np.abs(rays.numpy().transpose(2, 0, 1, 3, 4) - golden["ray_map_stride16"]).max() < 1e-5


def scene(steps: int = 3) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    poses = torch.tensor([[0.0, 0.1, 0.5, 0, 0, 0, 0.0, 0.0, -0.1, 0.5, 0, 0, 0, 1.0]]).repeat(steps, 1)
    intrinsic = torch.tensor([[[60.0, 0, 32], [0, 60, 32], [0, 0, 1]]])
    c2w = torch.eye(4).expand(1, steps, 4, 4).clone()
    return poses, c2w, intrinsic


def test_batch_dimensions_and_any_size() -> None:
    poses, c2w, intrinsic = scene()
    one = render_pose_map(poses, c2w, intrinsic, (64, 48))
    many = render_pose_map(
        poses.expand(2, 5, *poses.shape),
        c2w.expand(2, 5, *c2w.shape),
        intrinsic.expand(2, 5, *intrinsic.shape),
        (64, 48),
    )
    assert many.shape == (2, 5, 1, 3, 3, 64, 48)
    assert bool((many == one).all())
    assert bool((one != 50).any())


def test_options_change_what_they_say() -> None:
    poses, c2w, intrinsic = scene(1)
    base = render_pose_map(poses, c2w, intrinsic, (64, 64))
    assert not torch.equal(base, render_pose_map(poses, c2w, intrinsic, (64, 64), tool_offset=0.3))
    near = poses.clone()
    near[:, [2, 9]] = 0.25
    released = render_pose_map(near, c2w, intrinsic, (64, 64), style=PoseMapStyle(scale=0.3))
    paper = render_pose_map(near, c2w, intrinsic, (64, 64), style=PoseMapStyle(scale=0.3, radius_law="paper"))
    assert not torch.equal(released, paper)
    behind = poses.clone()
    behind[:, [2, 9]] = -0.5
    culled = render_pose_map(behind, c2w, intrinsic, (64, 64), style=PoseMapStyle(cull_behind=True))
    assert bool((culled == 50).all())
    assert bool((render_pose_map(behind, c2w, intrinsic, (64, 64)) != 50).any())


def test_bad_input_is_named() -> None:
    poses, c2w, intrinsic = scene()
    with pytest.raises(ValueError, match="eef_poses"):
        render_pose_map(poses[:, :13], c2w, intrinsic)
    with pytest.raises(ValueError, match="NaN"):
        render_pose_map(poses * float("nan"), c2w, intrinsic)
    with pytest.raises(ValueError, match="T=2"):
        render_pose_map(poses[:2], c2w, intrinsic)
    with pytest.raises(ValueError, match="radius_law"):
        PoseMapStyle(radius_law="round")
