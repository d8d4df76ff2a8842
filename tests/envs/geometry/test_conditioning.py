"""Pose and ray maps against the public implementation's exact outputs, and against their own definition."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from envs.conditioning import (
    CANVAS,
    ActionVector,
    PoseMapStyle,
    end_effector_poses,
    pose_map_cells,
    pose_map_channels,
    render_pose_map,
    render_ray_map,
)
from envs.conditioning.pose_map import layout
from envs.embodiment import EmbodimentError
from envs.targets import options
from tests.embodiments import EMBODIMENTS


@pytest.fixture(scope="module")
def golden(shared: Path) -> dict[str, np.ndarray]:
    return dict(np.load(shared / "golden/pose_map_gesim_v2_demo_000.npz"))


def test_pose_map_equals_the_public_one_in_every_pixel(golden: dict[str, np.ndarray]) -> None:
    poses = torch.from_numpy(golden["eef_poses"]).unflatten(-1, (2, 7))
    c2w, intrinsic = torch.from_numpy(golden["c2w"]), torch.from_numpy(golden["intrinsic"])
    style = PoseMapStyle(tool_offset=float(golden["gripper_offset"]))
    drawn = render_pose_map(poses, c2w, intrinsic, (384, 512), style)
    assert np.array_equal(drawn.numpy(), golden["pose_map_uint8"].transpose(1, 2, 0, 3, 4))


def test_ray_map_equals_the_public_one(golden: dict[str, np.ndarray]) -> None:
    rays = render_ray_map(
        torch.from_numpy(golden["intrinsic"]), torch.from_numpy(golden["c2w"][:, :2]), (384, 512), stride=16
    )
    assert np.abs(rays.numpy().transpose(2, 0, 1, 3, 4) - golden["ray_map_stride16"]).max() < 1e-5


def scene(steps: int = 3) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    poses = (
        torch.tensor([[0.0, 0.1, 0.5, 0, 0, 0, 0.0, 0.0, -0.1, 0.5, 0, 0, 0, 1.0]])
        .repeat(steps, 1)
        .unflatten(-1, (2, 7))
    )
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


def test_maps_of_a_camera_that_is_not_calibrated_stay_bare_and_change_no_others() -> None:
    poses, c2w, intrinsic = scene()
    both = torch.cat((torch.zeros_like(c2w), c2w)), torch.cat((torch.zeros_like(intrinsic), intrinsic))
    drawn, rays = render_pose_map(poses, *both, (64, 64)), render_ray_map(both[1], both[0], (64, 64))
    assert (drawn[0] == CANVAS).all() and (drawn[1] != CANVAS).any() and not rays[0].any()
    assert torch.equal(drawn[1:], render_pose_map(poses, c2w, intrinsic, (64, 64)))
    assert torch.equal(rays[1:], render_ray_map(intrinsic, c2w, (64, 64)))


def test_options_change_what_they_say() -> None:
    poses, c2w, intrinsic = scene(1)
    base = render_pose_map(poses, c2w, intrinsic, (64, 64))
    assert not torch.equal(
        base, render_pose_map(poses, c2w, intrinsic, (64, 64), PoseMapStyle(tool_offset=0.3))
    )
    near = poses.clone()
    near[..., 2] = 0.25
    released = render_pose_map(near, c2w, intrinsic, (64, 64), style=PoseMapStyle(scale=0.3))
    paper = render_pose_map(near, c2w, intrinsic, (64, 64), style=PoseMapStyle(scale=0.3, radius_law="paper"))
    assert not torch.equal(released, paper)
    behind = poses.clone()
    behind[..., 2] = -0.5
    culled = render_pose_map(behind, c2w, intrinsic, (64, 64), style=PoseMapStyle(cull_behind=True))
    assert bool((culled == 50).all())
    assert bool((render_pose_map(behind, c2w, intrinsic, (64, 64)) != 50).any())


def test_soft_edges_say_where_a_gripper_is_to_a_fraction_of_a_pixel() -> None:
    poses, c2w, intrinsic = scene(1)
    soft, size = PoseMapStyle(antialias=True), (64, 64)

    def drawn(shift: float, style: PoseMapStyle) -> torch.Tensor:
        moved = poses.clone()
        moved[..., 0] += shift
        return render_pose_map(moved, c2w, intrinsic, size, style)

    step = 1e-3  # m, a tenth of a pixel or so
    assert len({drawn(k * step, PoseMapStyle()).numpy().tobytes() for k in range(4)}) < 4
    assert len({drawn(k * step, soft).numpy().tobytes() for k in range(4)}) == 4
    # Both draw the same thing, one of them cut off to whole pixels.
    middles = []
    for style in (PoseMapStyle(), soft):
        mark = (drawn(0.0, style)[0, 0].float() - 50).abs().sum(0)
        across = (mark.sum(0) * torch.arange(64)).sum() / mark.sum()
        down = (mark.sum(1) * torch.arange(64)).sum() / mark.sum()
        middles.append(torch.stack((across, down)))
    assert float((middles[0] - middles[1]).abs().max()) < 1.0


def test_bad_input_is_named() -> None:
    poses, c2w, intrinsic = scene()
    with pytest.raises(ValueError, match="arms, 7"):
        render_pose_map(poses[..., :6], c2w, intrinsic, (64, 64))
    with pytest.raises(ValueError, match="NaN"):
        render_pose_map(poses * float("nan"), c2w, intrinsic, (64, 64))
    with pytest.raises(ValueError, match="T=2"):
        render_pose_map(poses[:2], c2w, intrinsic, (64, 64))
    with pytest.raises(ValueError, match="radius_law='round' should be 'released' or 'paper'"):
        options(PoseMapStyle, {"radius_law": "round"}, "simulator.pose_map_style")


@pytest.mark.parametrize("arms", [1, 3])
def test_any_number_of_arms(arms: int) -> None:
    poses, c2w, intrinsic = scene(1)
    some = poses[:, :1].repeat(1, arms, 1)
    some[..., 0] = torch.linspace(-0.1, 0.1, arms)
    drawn = render_pose_map(some, c2w, intrinsic, (64, 64))
    alone = render_pose_map(some[:, :1], c2w, intrinsic, (64, 64))
    assert bool((drawn != 50).any()) and torch.equal(drawn, alone) == (arms == 1)


def test_grippers_beyond_their_range_take_the_ends_of_the_colour_map() -> None:
    poses, c2w, intrinsic = scene(1)
    shades = []
    for grip in (-1.0, -0.035, 0.0, 1.0, 1.5):
        poses[..., 6] = grip
        shades.append(layout(poses, c2w, intrinsic, (64, 64), PoseMapStyle())[2][0, 0, 0])
    assert shades == [0, 68, 74, 255, 255]


@pytest.mark.parametrize("grip", [-0.2, -0.035, 0.0, 0.5, 1.0, 1.03])
@pytest.mark.parametrize(("arm", "shades"), [(0, "Greens"), (1, "Reds")])
def test_stray_grippers_are_filled_as_the_released_code_fills_them(
    grip: float, arm: int, shades: str
) -> None:
    """With the colour map at (g * 85 + 35) / 120, whatever g; a reading of 0..1 is not enforced before."""
    import matplotlib

    def released(value: float) -> list[int]:
        rgba = matplotlib.colormaps[shades]((value * 85 + 35) / 120)
        return [int(255 * part) for part in rgba[:3]]

    poses, c2w, intrinsic = scene(1)
    poses[..., 6] = grip
    both = poses[:, :1].repeat(1, 2, 1)
    both[:, 1 - arm, 2] = -10.0  # behind the camera, where nothing is drawn
    drawn = render_pose_map(both, c2w, intrinsic, (64, 64), PoseMapStyle(cull_behind=True))[0, 0]
    colours = drawn.flatten(1).T.tolist()
    assert colours.count(released(grip)) > 20
    if not 0 <= grip <= 1:  # nobody clamped the reading
        limit = released(min(max(grip, 0.0), 1.0))
        assert limit not in colours or limit == released(grip)
    if grip < 0:
        assert released(grip) != released(0.0)


@pytest.mark.parametrize("name", sorted(EMBODIMENTS))
def test_action_vectors_of_any_robot(name: str) -> None:
    robot = EMBODIMENTS[name]
    commands = torch.randn(5, 4, robot.action_dim) * 0.1 + 0.3
    commands[..., 0] = 0.2  # never varies
    vector = ActionVector(robot)
    now = commands[:, 0]
    vector.normalise(commands.flatten(0, 1), (commands - now[:, None]).flatten(0, 1))
    told = vector(commands, now)
    assert told.shape == (5, 4, vector.size) and torch.isfinite(told).all()
    assert bool((told[..., 0].abs() < 1e-6).all()) and float(
        told[..., robot.action_dim - 1].std()
    ) == pytest.approx(1.0, abs=0.25)


def test_end_effector_poses_are_the_robots_own_affair() -> None:
    for robot in EMBODIMENTS.values():
        commands = torch.rand(3, robot.action_dim)
        if robot.commands_poses and robot.kinematics is None:
            poses = end_effector_poses(robot, commands)
            assert poses.shape == (3, len(robot.arms), 7)
            arm = robot.arms[-1]
            assert torch.equal(poses[:, -1, :6], commands[:, list(arm.numbers)])
        elif robot.kinematics is None:
            with pytest.raises(EmbodimentError, match=r"simulator\.pose_map=false"):
                end_effector_poses(robot, commands)


def test_cells_of_pose_maps_say_where_in_them_a_gripper_is() -> None:
    maps = torch.full((1, 2, 1, 3, 16, 16), CANVAS, dtype=torch.uint8)
    maps[:, 0, :, :, 0:2, 0:2] = 255
    maps[:, 1, :, :, 4:6, 6:8] = 255
    cells = pose_map_cells(maps, 8)
    assert cells.shape == (1, 2, 1, pose_map_channels(8), 2, 2)
    assert not torch.equal(cells[:, 0], cells[:, 1])
    assert torch.allclose(cells[:, 0].mean(2), cells[:, 1].mean(2))  # as means over cells they are the same
