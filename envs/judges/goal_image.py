"""A given picture of the goal: the task is done when what the main camera sees is near enough to it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from envs.judges.goal import GoalJudge, Goals
from envs.ranges import Count, Share
from envs.specs import WorldSpec
from envs.targets import ConfigError


class GoalImageJudge(GoalJudge):
    """The same goal for all episodes.

    Args:
        spec, hold, threshold, metric: see GoalJudge.
        picture: path of the goal as the main camera sees it, as a picture file of any size.

    Raises:
        ConfigError: if the picture cannot be read.
    """

    reads_instruction = False
    goal: Tensor

    def __init__(
        self,
        spec: WorldSpec,
        hold: Count,
        threshold: Share,
        metric: Mapping[str, Any],
        picture: str | None,
    ):
        super().__init__(spec, hold, threshold, metric, "main")
        height, width = spec.size
        small = cv2.resize(_read(picture), (width, height), interpolation=cv2.INTER_AREA)
        self.views = spec.views
        self.register_buffer("goal", torch.from_numpy(np.ascontiguousarray(small.transpose(2, 0, 1))))

    @classmethod
    def check(cls, options: Mapping[str, Any]) -> None:
        """See Judge.check: the picture is there."""
        super().check(options)
        _read(options["picture"])

    def goals(self, first: Tensor, instruction: list[str]) -> Goals:
        """See GoalJudge.goals."""
        shape = (len(first), self.views, *self.goal.shape)
        known = torch.ones(len(first), dtype=torch.bool, device=first.device)
        return Goals(self.goal.to(first.device).expand(shape), known)


def _read(picture: str | None) -> NDArray[np.uint8]:
    """A picture file as RGB uint8 [H, W, 3].

    Raises:
        ConfigError: if there is none.
    """
    found = cv2.imread(picture) if picture else None
    if found is None:
        raise ConfigError(
            f"judge.picture={picture} is no picture that OpenCV reads; name a file that shows the goal as the"
            " main camera sees it, as in judge.picture=goal.png"
        )
    return np.asarray(cv2.cvtColor(found, cv2.COLOR_BGR2RGB), np.uint8)
