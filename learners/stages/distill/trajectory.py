"""The simple way: where the teacher's many steps end, from the same noise, is where each of the student's few
steps should jump to (Luhman & Luhman 2021).
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from envs.simulators.stepwise import Stepwise
from learners.stages.distill.method import Method, Turn
from learners.training.fit import FitConfig


class TrajectoryRegression(Method):
    """Squared distance to the ends of the teacher's trajectories; see Method for the arguments.

    Raises:
        ValueError: if the teacher jumps itself, so that it has no trajectories.
    """

    def __init__(self, teacher: Stepwise, student: Stepwise, config: FitConfig):
        super().__init__(teacher, student, config)
        if teacher.sampler.jumps:
            raise ValueError(
                "the teacher samples in distilled steps, which are no trajectories; set"
                " simulator.sampling.kind=edm (gesim) or simulator.denoising.sampler=euler (dit)"
            )

    def loss(self, turn: Turn, generator: torch.Generator) -> tuple[Tensor, dict[str, Any]]:
        """See Method."""
        inputs, weight = self.student.chunk_of(turn.clip, generator)
        made, teacher = self.generated(inputs, turn.step), self.teacher
        with torch.no_grad():
            given = teacher.prepare(inputs)
            goal = teacher.sampler(
                lambda z, level: teacher.velocity(z, torch.full((len(z),), level, device=z.device), given),
                made.noise,
            )
        error = (made.latents - goal).square() * weight
        return error.sum() / weight.expand_as(error).sum().clamp(min=1), {}
