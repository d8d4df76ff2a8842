"""Judges that know a goal: progress towards it, and what the golden goal does where there is none."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from envs.judges.goal_image import GoalImageJudge
from tests.embodiments import ARM_DELTAS, world_spec
from tests.moving_square import SIZE, picture

METRIC = {"_target_": "envs.perceptual.PerceptualDistance"}
SPEC = world_spec(ARM_DELTAS.at(SIZE), SIZE)


def shown(*places: tuple[float, float]) -> torch.Tensor:
    """Frames uint8 [1, T, V, 3, H, W] of the moving square at some places in 0..1."""
    return torch.from_numpy(np.stack([picture(np.array(place), SPEC.views) for place in places]))[None]


def test_progress_rises_towards_a_given_picture(tmp_path: Path) -> None:
    goal = shown((0.9, 0.9))[0, 0, SPEC.embodiment.main_view]
    cv2.imwrite(str(tmp_path / "goal.png"), goal.permute(1, 2, 0).numpy()[..., ::-1])
    judge = GoalImageJudge(SPEC, 1, 0.9, METRIC, str(tmp_path / "goal.png"))
    frames = shown((0.1, 0.1), (0.8, 0.8), (0.9, 0.9))
    judged = judge.score(frames, frames[:, 0], ["to the corner"])
    start, near, there = judged.progress[0].tolist()
    assert start == 0.0 and 0.05 < near < there and there == pytest.approx(1.0, abs=1e-3)
    assert torch.equal(judged.success, judged.progress)
    assert judge.facts() == {"metric": "NLPD (normalised Laplacian pyramid)"}
    with pytest.raises(ValueError, match="no picture that OpenCV reads"):
        GoalImageJudge(SPEC, 1, 0.9, METRIC, None)
