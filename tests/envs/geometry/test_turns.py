"""An orientation may be told in several ways: which numbers tell one, and the way that is nearest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from actors.policies.proprioception import Proprioception
from envs.conditioning.turns import Turns
from envs.conditioning.units import Units
from envs.episodes.angles import turned_steadily
from envs.orientations import orientations
from tests.embodiments import ARM_JOINTS, BIMANUAL_POSES

QUATERNION = ("x", "y", "z", "qx", "qy", "qz", "qw")


@pytest.mark.parametrize(
    ("names", "groups"),
    [
        ("x y z roll pitch yaw gripper", ((3,), (4,), (5,))),
        ("left_yaw right_yaw left_wrist_roll head_yaw", ((0,), (1,))),
        ("shoulder_pan.pos wrist_roll.pos gripper.pos", ()),
        ("ee.x ee.y ee.z ee.wx ee.wy ee.wz ee.gripper_pos", ((3, 4, 5),)),
        ("axis_angle_0 axis_angle_1 axis_angle_2 width", ((0, 1, 2),)),
        ("x y z qw qx qy qz", ((3, 4, 5, 6),)),
        ("kLeftWristRoll leftYaw rotVec0 rotVec1 rotVec2", ((1,), (2, 3, 4))),
        ("left_quat_0 left_quat_1 left_quat_2 left_quat_3 right_quaternion_x gripper", ((0, 1, 2, 3),)),
        ("qx qy qz wx wy", ()),
        ("0 1 2 3", ()),
    ],
)
def test_which_numbers_tell_orientations(names: str, groups: tuple[tuple[int, ...], ...]) -> None:
    assert orientations(names.split()) == groups


def down(count: int, spread: float) -> Rotation:
    """Grippers that point down, as far as they do."""
    lean = Rotation.from_rotvec(spread * np.random.default_rng(0).standard_normal((count, 3)))
    return lean * Rotation.from_rotvec([np.pi, 0, 0])


def told(turned: Rotation, kind: str) -> torch.Tensor:
    return torch.from_numpy(turned.as_quat() if kind == "quaternion" else turned.as_rotvec()).float()


def other_way(values: torch.Tensor) -> torch.Tensor:
    """The same orientations, every second one told another way."""
    out = values.clone()
    if values.shape[1] == 4:
        out[::2] *= -1
    else:
        norm = out[::2].norm(dim=-1, keepdim=True)
        out[::2] *= 1 - 2 * np.pi / norm
    return out


@pytest.mark.parametrize("kind", ["quaternion", "vector"])
def test_spread_and_units_do_not_depend_on_the_way_an_orientation_is_told(kind: str) -> None:
    values = told(down(300, 0.05), kind)
    size = values.shape[1]
    units = Units(size, [range(size)])
    seen = []
    for some in (values, other_way(values), other_way(values.flip(0)).flip(0)):
        units.normalise(some)
        assert units.std.max() < 0.15  # as numbers they lie at both ends, 1 or 3 apart
        seen.append((units.mean.clone(), units.std.clone(), units(values)))
        assert torch.allclose(units(some), seen[-1][2], atol=1e-3)
        assert torch.allclose(units.change(some, values), torch.zeros(()), atol=1e-3)
        same = Rotation.from_quat if size == 4 else Rotation.from_rotvec
        back = same(units.values(units(some)).numpy())
        assert (back * same(values.numpy()).inv()).magnitude().max() < 1e-3
    for one in seen[1:]:
        assert all(torch.allclose(a, b, atol=1e-3) for a, b in zip(one, seen[0], strict=True))


@pytest.mark.parametrize("kind", ["quaternion", "vector"])
def test_what_is_no_orientation_by_its_size_is_taken_as_it_is(kind: str) -> None:
    values = 5 * told(down(50, 0.05), kind)
    turns = Turns(values.shape[1], [range(values.shape[1])])
    assert torch.allclose(turns.fit(values), values.mean(0), atol=1e-5)
    assert torch.equal(turns.nearest(values, -values), values)


def test_two_numbers_are_no_orientation() -> None:
    with pytest.raises(ValueError, match="1, 3 or 4"):
        Turns(4, [(0, 1)])


@pytest.mark.parametrize("kind", ["quaternion", "vector"])
def test_commands_of_an_episode_do_not_jump(kind: str) -> None:
    names = QUATERNION if kind == "quaternion" else (*QUATERNION[:3], "wx", "wy", "wz")
    robot = replace(ARM_JOINTS, action_names=names, arms=(), cameras=ARM_JOINTS.cameras[1:])
    turned = Rotation.from_rotvec(np.linspace([2.9, 0.1, 0], [3.4, -0.1, 0.1], 40))
    values = told(turned, kind).numpy()
    commands = np.concatenate((np.zeros((40, 3), np.float32), values), 1)
    assert np.abs(np.diff(commands, axis=0)).max() > 1 or kind == "quaternion"
    commands[7:20, 3:] = other_way(torch.from_numpy(commands[7:20, 3:]).repeat_interleave(2, 0)).numpy()[::2]
    steady = turned_steadily(robot, commands)
    assert np.abs(np.diff(commands, axis=0)).max() > 1 and np.abs(np.diff(steady, axis=0)).max() < 0.1
    assert not steady[:, :3].any() and steady.dtype == np.float32


def test_policies_are_told_the_same_of_quaternions() -> None:
    robot = replace(BIMANUAL_POSES, state_names=(*QUATERNION, "gripper"))
    body = Proprioception(robot, False)
    values = told(down(60, 0.05), "quaternion")
    rest = torch.randn(60, 4, generator=torch.Generator().manual_seed(0))
    states, others = (torch.cat((rest[:, :3], some, rest[:, 3:]), 1) for some in (values, other_way(values)))
    body.normalise(states)
    assert torch.allclose(body(states), body(others), atol=1e-3)
    assert body(states)[:, 3:7].std(0).min() > 0.5
