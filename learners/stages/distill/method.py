"""What every way to make a few-step student shares: teacher and student side by side, and how the student is
asked.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torch.optim import Optimizer

from envs.rng import Shared, shared_generator
from envs.simulators.stepwise import Stepwise
from learners.training.fit import FitConfig
from learners.training.optimisers import OPTIMISERS, Parameters


@dataclass(frozen=True)
class Turn:
    """A microbatch, and whose turn it is.

    Args:
        clip: [B], see ClipBatches.
        step: of training.
    """

    clip: TensorDict
    step: int

    def to(self, device: torch.device | str) -> Turn:
        """The same on a device."""
        return Turn(self.clip.to(device), self.step)


class Method(nn.Module):
    """A teacher that stays as it is and a student that learns from it; a subclass says how.

    Args:
        teacher: denoises in many steps.
        student: of the same architecture and conditioning, with the teacher's weights to begin with.
        config: of the training loop.

    Raises:
        ValueError: if their autoencoders differ: latents of one would mean nothing to the other.
    """

    teacher: Any
    student: Any

    def __init__(self, teacher: Stepwise, student: Stepwise, config: FitConfig):
        super().__init__()
        theirs, own = teacher.codec.state_dict(), student.codec.state_dict()
        if theirs.keys() != own.keys() or any(not torch.equal(own[name], theirs[name]) for name in own):
            raise ValueError(
                "teacher and student have autoencoders of different weights, so that latents of one mean"
                " nothing to the other; begin the student with the teacher's weights, or an earlier student's"
            )
        teacher.codec = student.codec  # frozen in both
        self.teacher, self.student = teacher, student
        self.teacher.requires_grad_(False)
        self.steps, self.config = student.sampler.evaluations, config

    @classmethod
    def faults(cls, section: Mapping[str, Any], fit: Mapping[str, Any], key: str) -> Iterator[str]:
        """A sentence for each reason why nothing could come of options, before any work.

        Args:
            section: distill.method.
            fit: of the training loop, at `key` of the config.
        """
        return iter(())

    @property
    def learners(self) -> Sequence[nn.Module]:
        """Whose weights learn, all of them or their adapters."""
        return (self.student,)

    def loss(self, turn: Turn, generator: torch.Generator) -> tuple[Tensor, dict[str, Any]]:
        """What whoever's turn it is learns from, and figures to log."""
        raise NotImplementedError

    def optimise(self, trained: Parameters, lr: float, weight_decay: float) -> list[Optimizer]:
        """The optimisers of what learns, as `fit` takes them; hidden layers are the student's own."""
        return OPTIMISERS[self.config.optimiser](trained, lr, weight_decay, self.student.hidden)

    def generated(self, inputs: TensorDict, step: int) -> Generated:
        """What the student makes of a chunk at a step of training.

        It learns at one of its steps, each as likely: what this step sees comes from the student's own steps
        before, with the same noise each time, as when it samples (DMD2's backward simulation; GE-Sim 2.0 says
        that the number of steps is random). The step is that of all microbatches. Only the last of these
        calls keeps gradients.

        Args:
            inputs: of `predict`, [B].
        """
        student, generator = self.student, shared_generator(self.config.seed, step, Shared.STEPS)
        number = int(torch.randint(self.steps, (1,), generator=generator))
        sampler, given = student.sampler, student.prepare(inputs)
        noise = student.noise(inputs, given)

        def velocity(z: Tensor, level: float) -> Tensor:
            return student.velocity(z, torch.full((len(z),), level, device=z.device), given)

        with torch.no_grad():
            seen = sampler.before(number, velocity, noise)
        level = sampler.sigmas[number]
        return Generated(seen - level * velocity(seen, level), noise, given)


@dataclass(frozen=True)
class Generated:
    """Latents that the student made.

    Args:
        latents: of the chunk, float32 [B, ...].
        noise: that they were made from, like latents.
        given: what all steps shared.
    """

    latents: Tensor
    noise: Tensor
    given: Any


def spread(level: Tensor, like: Tensor) -> Tensor:
    """Levels [B] so that they broadcast over latents [B, ...]."""
    return level.reshape(-1, *[1] * (like.ndim - 1))
