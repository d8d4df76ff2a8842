"""Pictures and intrinsics change size together."""

from __future__ import annotations

import numpy as np

from envs.episodes.pictures import resize_frames, resize_intrinsics


def test_resized_pictures_show_the_same_point_at_the_same_share() -> None:
    intrinsic = np.array([[50, 0, 32], [0, 40, 24], [0, 0, 1]], np.float32)
    point = np.array([0.2, -0.1, 1.5], np.float32)
    other = resize_intrinsics(intrinsic, (48, 64), (96, 96))
    before, after = intrinsic @ point, other @ point
    assert np.allclose(before[:2] / before[2] / [64, 48], after[:2] / after[2] / 96)


def test_smaller_pictures_are_averages_and_absent_ones_stay_black() -> None:
    frames = np.zeros((2, 1, 3, 4, 4), np.uint8)
    frames[..., ::2] = 200
    small = resize_frames(frames, (2, 2), np.array([True, False]))
    assert (small[0] == 100).all() and (small[1] == 0).all()
    assert (resize_frames(frames, (2, 2)) == 100).all() and resize_frames(frames, (4, 4)) is frames
