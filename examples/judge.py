"""Your own judge: the task is done when a camera's picture looks like a goal picture.

worldloop run experiment=smoke 'hydra.searchpath=[file://examples/configs]' judge=goal_picture
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from envs.judges.base import Judge, Judgement, judgement_status
from envs.specs import WorldSpec
from envs.targets import ConfigError


class GoalPicture(Judge):
    """Likeness of the main camera's picture to a goal, relative to the episode's first frame.

    Args:
        spec: what frames show.
        hold: frames in a row that make an episode a success.
        picture: path of the goal as a picture file, of any size.
        sharpness: how steeply likeness becomes success.

    Raises:
        ConfigError: if the picture cannot be read.
    """

    reads_instruction = False
    goal: Tensor

    def __init__(self, spec: WorldSpec, hold: int, picture: str, sharpness: float):
        super().__init__(hold)
        height, width = spec.size
        small = cv2.resize(_read(picture), (width, height), interpolation=cv2.INTER_AREA)
        self.view, self.sharpness = spec.embodiment.main_view, sharpness
        self.register_buffer(
            "goal", torch.from_numpy(np.ascontiguousarray(small.transpose(2, 0, 1))).float() / 255
        )

    @classmethod
    def check(cls, options: Mapping[str, Any]) -> None:
        """See Judge.check: what is missing is said before anything is learned."""
        _read(options["picture"])

    def score(self, frames: Tensor, first: Tensor, instruction: list[str]) -> Judgement:
        """See Judge.score."""
        now = self._away(frames[:, :, self.view])
        begin = self._away(first[:, self.view])[:, None].clamp(min=1e-3)
        progress = (1 - now / begin).clamp(0, 1)
        success = (self.sharpness * (progress - 0.9)).sigmoid()
        return Judgement(success, progress, judgement_status(success))

    def _away(self, pictures: Tensor) -> Tensor:
        """Mean absolute difference [...] of pictures uint8 [..., 3, H, W] from the goal, 0..1."""
        return (pictures.float() / 255 - self.goal).abs().mean((-3, -2, -1))


def _read(picture: str) -> NDArray[np.uint8]:
    """A picture file as RGB uint8 [H, W, 3]."""
    found = cv2.imread(picture)
    if found is None:
        raise ConfigError(f"judge.picture={picture} is no picture that OpenCV reads")
    return np.asarray(cv2.cvtColor(found, cv2.COLOR_BGR2RGB), np.uint8)
