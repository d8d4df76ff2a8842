"""Rigid motions: torch and NumPy agree, inverses invert, wrist cameras follow hands."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from envs.geometry.cameras import follow_wrists
from envs.geometry.rotations import invert, pose_transforms, rpy_to_matrix


def test_rotations_are_scipys() -> None:
    angles = np.random.default_rng(0).uniform(-3, 3, (50, 3))
    wanted = Rotation.from_euler("xyz", angles).as_matrix()
    assert np.allclose(rpy_to_matrix(torch.from_numpy(angles)).numpy(), wanted)


def test_inverses_invert() -> None:
    poses = torch.randn(20, 6, dtype=torch.float64)
    moves = pose_transforms(poses)
    assert torch.allclose(
        moves @ invert(moves), torch.eye(4, dtype=torch.float64).expand(20, 4, 4), atol=1e-12
    )


def test_wrist_cameras_follow_their_flange_and_others_stay() -> None:
    start = torch.zeros(2, 7)
    poses = torch.zeros(2, 2, 7)
    poses[1, 0, 0], poses[1, 1, 5] = 0.3, 0.5  # the first arm moves along x, the second one turns
    c2w = torch.eye(4).repeat(3, 1, 1)
    c2w[1:, 0, 3] = 0.1
    out = follow_wrists(c2w, start, poses, (None, 0, 1))
    assert torch.allclose(out[0], c2w)
    assert torch.allclose(out[1, 0], c2w[0])
    assert torch.allclose(out[1, 1, :3, 3], torch.tensor([0.4, 0.0, 0.0]))
    assert torch.allclose(out[1, 2, :3, 3], torch.tensor([0.1 * np.cos(0.5), 0.1 * np.sin(0.5), 0.0]).float())
