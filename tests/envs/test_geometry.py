"""Rigid motions: torch and NumPy agree, inverses invert, wrist cameras follow hands."""

from __future__ import annotations

import numpy as np
import torch

from envs import geometry
from envs.physics import arms


def test_torch_and_numpy_rotations_agree() -> None:
    angles = np.random.default_rng(0).uniform(-3, 3, (50, 3))
    assert np.allclose(geometry.rpy_to_matrix(torch.from_numpy(angles)).numpy(), arms.rpy_to_matrix(angles))


def test_angles_come_back_near_where_they_were() -> None:
    for rpy in np.random.default_rng(1).uniform(-1.5, 1.5, (50, 3)) + np.array([np.pi, 0, 0]):
        assert np.allclose(arms.matrix_to_rpy(arms.rpy_to_matrix(rpy), rpy), rpy, atol=1e-9)


def test_follow_hands_moves_only_wrist_cameras() -> None:
    start = torch.zeros(14)
    commands = torch.zeros(2, 14)
    commands[1, 0], commands[1, 12] = 0.3, 0.5  # the left hand moves along x, the right one turns
    c2w = torch.eye(4).repeat(3, 1, 1)
    c2w[1:, 0, 3] = 0.1
    out = geometry.follow_hands(c2w, start, commands, geometry.hands_of(("head", "hand_left", "hand_right")))
    assert torch.allclose(out[0], c2w)
    assert torch.allclose(out[1, 0], c2w[0])
    assert torch.allclose(out[1, 1, :3, 3], torch.tensor([0.4, 0.0, 0.0]))
    assert torch.allclose(out[1, 2, :3, 3], torch.tensor([0.1 * np.cos(0.5), 0.1 * np.sin(0.5), 0.0]).float())


def test_projection_is_the_inverse_of_on_plane() -> None:
    from envs.geometry.cameras import on_plane

    intrinsic = torch.tensor([[50.0, 0, 32], [0, 50, 32], [0, 0, 1]])
    c2w = torch.eye(4)
    c2w[:3, :3] = torch.tensor([[0.0, -1, 0], [-1, 0, 0], [0, 0, -1]])
    c2w[:3, 3] = torch.tensor([0.2, 0.0, 1.0])
    points = torch.tensor([[0.1, 0.2, 0.03], [0.3, -0.1, 0.03]])
    pixels, depth = geometry.project(points, intrinsic, c2w)
    assert bool((depth > 0).all())
    assert torch.allclose(on_plane(pixels, 0.03, intrinsic, c2w), points, atol=1e-5)
