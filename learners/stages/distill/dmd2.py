"""Improved distribution matching distillation (DMD2: Yin et al. 2024), as GE-Sim 2.0 takes it: no adversary,
no regression, no flow loss beside it, and memory that stays clean.

The student makes a chunk, noise is mixed in, and the teacher and a critic say what they would make of it: the
one in a world like the data, the other in one like the student's. The student moves along their difference.
The critic is a copy of the teacher that learns to denoise what the student makes, several times as often. It
does not know at which of its steps the student made it: what is matched is their mixture in equal shares.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from copy import deepcopy
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim import AdamW, Optimizer

from envs.ranges import Count, Decay, NonNegative, Positive
from envs.simulators.compiling import compile_parts
from envs.simulators.stepwise import Stepwise
from learners.stages.distill.method import Generated, Method, Turn, spread
from learners.training.fit import FitConfig
from learners.training.optimisers import Parameters

_FASTER = 10  # times as fast as its critic a student may learn
_LOWEST, _HIGHEST = 0.02, 0.98  # noise levels drawn, as in DMD: nearer the ends scores say nothing


class DMD2(Method):
    """Distribution matching; see the module's docstring, and Method for the first three arguments.

    Args:
        critic_updates: of the critic for each of the student.
        shift, critic_shift: of the noise levels drawn for student and critic; above 1 favours noise.
        critic_lr: peak learning rate of the critic, which warms up and falls as the student's does.
        critic_betas: of the critic's AdamW.
        critic_weight_decay: of the critic's AdamW.
    """

    critic: Any

    def __init__(
        self,
        teacher: Stepwise,
        student: Stepwise,
        config: FitConfig,
        critic_updates: Count,
        shift: Positive,
        critic_shift: Positive,
        critic_lr: Positive,
        critic_betas: tuple[Decay, Decay],
        critic_weight_decay: NonNegative,
    ):
        critic: Any = compile_parts(deepcopy(teacher), teacher.compiled)
        super().__init__(teacher, student, config)
        critic.codec, self.critic = self.student.codec, critic
        self.critic_updates, self.shift, self.critic_shift = critic_updates, shift, critic_shift
        self._critic_lr, self._betas, self._decay = critic_lr, critic_betas, critic_weight_decay

    @classmethod
    def faults(cls, section: Mapping[str, Any], fit: Mapping[str, Any], key: str) -> Iterator[str]:
        """See Method: a student that would run away from its critic, or whose turn never comes."""
        # what is missing is told when it is built
        critic, turns = section.get("critic_lr", fit["lr"]), section.get("critic_updates", 0) + 1
        if critic < fit["lr"] / _FASTER:
            yield (
                f"{key}.lr={fit['lr']} is more than {_FASTER} times distill.method.critic_lr={critic}: the"
                f" critic could not follow what the student makes; say {key}.lr={critic}, or raise"
                " distill.method.critic_lr"
            )
        if fit["steps"] < turns:
            yield (
                f"{key}.steps={fit['steps']} end before the student's first turn, for one step in"
                f" distill.method.critic_updates + 1 = {turns} is its own; say {key}.steps={turns} or more,"
                " or lower distill.method.critic_updates"
            )

    @property
    def learners(self) -> Sequence[nn.Module]:
        """See Method."""
        return self.student, self.critic

    def optimise(self, trained: Parameters, lr: float, weight_decay: float) -> list[Optimizer]:
        """See Method; the critic's AdamW is its own."""
        critic = {name: p for name, p in trained.items() if name.startswith("critic.")}
        rest = {name: p for name, p in trained.items() if name not in critic}
        group = {"params": list(critic.values()), "lr_scale": self._critic_lr / lr}
        own = AdamW([group], lr, betas=self._betas, weight_decay=self._decay, fused=True)
        return [*super().optimise(rest, lr, weight_decay), own]

    def loss(self, turn: Turn, generator: torch.Generator) -> tuple[Tensor, dict[str, Any]]:
        """See Method; every (critic_updates + 1)-th step is the student's."""
        students = turn.step % (self.critic_updates + 1) == self.critic_updates
        with torch.set_grad_enabled(students):
            inputs, weight = self.student.chunk_of(turn.clip, generator)
            made = self.generated(inputs, turn.step)
        known = (weight > 0).to(made.latents.dtype)  # nothing is asked past an episode's end
        if students:
            value = self._matching(made, inputs, known, generator)
            return value, {"matching": value.detach()}
        value = self._denoising(made, inputs, known, generator)
        return value, {"critic": value.detach()}

    def _matching(self, made: Generated, inputs: Any, known: Tensor, generator: torch.Generator) -> Tensor:
        """A loss whose gradient is the difference of the scores, in units of the teacher's own correction."""
        with torch.no_grad():
            latents = made.latents
            z, level, _ = self._noised(latents, self.shift, generator)
            real, fake = (
                z - spread(level, z) * model.velocity(z, level, model.prepare(inputs))
                for model in (self.teacher, self.critic)
            )
            count = known.expand_as(latents).flatten(1).sum(1).clamp(min=1)
            unit = ((latents - real).abs() * known).flatten(1).sum(1) / count
            towards = latents - (fake - real) / spread(unit, latents).clamp(min=1e-4)
        error = (made.latents - towards).square() * known
        return 0.5 * error.sum() / known.expand_as(error).sum().clamp(min=1)

    def _denoising(self, made: Generated, inputs: Any, known: Tensor, generator: torch.Generator) -> Tensor:
        """The critic's error in clean latents over s^2, which is its error in velocities."""
        z, level, noise = self._noised(made.latents, self.critic_shift, generator)
        found = self.critic.velocity(z, level, self.critic.prepare(inputs))
        error = (found - (noise - made.latents)).square() * known
        return error.sum() / known.expand_as(error).sum().clamp(min=1)

    def _noised(
        self, latents: Tensor, shift: float, generator: torch.Generator
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Latents with noise mixed in, the levels [B], and the noise."""
        draw = torch.rand(len(latents), generator=generator).to(latents.device)
        level = (shift * draw / (1 + (shift - 1) * draw)).clamp(_LOWEST, _HIGHEST)
        noise = torch.randn(latents.shape, generator=generator).to(latents.device)
        share = spread(level, latents)
        return (1 - share) * latents + share * noise, level, noise
