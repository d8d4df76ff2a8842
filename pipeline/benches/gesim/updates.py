"""What distilling a GE-Sim takes: seconds and memory of an update of its student and of its critic (DMD2)."""

from __future__ import annotations

from contextlib import ExitStack
from functools import partial
from typing import Any, cast

import torch
from torch import Tensor

from envs.precision import mixed_precision
from envs.rng import constant_generator
from envs.simulators.compiling import Compile, compile_parts
from envs.simulators.stepwise import Stepwise
from envs.specs import WorldSpec
from learners.stages.distill.dmd2 import DMD2
from learners.stages.distill.method import Turn
from learners.training.fit import FitConfig
from learners.training.lora import low_rank
from learners.training.parallel import Trainee
from pipeline.benches.gesim.world import build, clips
from pipeline.benches.timing import best

_RATE = 2e-6  # as configs/distiller/dmd2_gesim.yaml has it
_CRITIC: dict[str, Any] = {
    "critic_updates": 4,
    "shift": 3.0,
    "critic_shift": 5.0,
    "critic_lr": _RATE,
    "critic_betas": (0.0, 0.999),
    "critic_weight_decay": 0.01,
}
_RANK = 16


def updates(
    spec: WorldSpec, sizes: tuple[dict[str, Any], dict[str, Any]], device: torch.device, how: Compile | None
) -> None:
    """Print them at batch 1, for all weights and for adapters alone."""
    for rank in (0, _RANK):
        seconds, peak = _measure(spec, sizes, device, how, rank)
        student, critic = seconds[True], seconds[False]
        what = f"adapters of rank {rank}" if rank else "all weights"
        memory = f", {peak:.0f} GiB at most" if peak else ""
        print(
            f"  {what}: student {student:.2f} s, critic {critic:.2f} s, a turn of one and four"
            f" {student + 4 * critic:.1f} s{memory}"
        )


def _measure(
    spec: WorldSpec,
    sizes: tuple[dict[str, Any], dict[str, Any]],
    device: torch.device,
    how: Compile | None,
    rank: int,
) -> tuple[dict[bool, float], float]:
    """Least seconds of an update of the student (True) and the critic (False), and GiB at most."""
    if device.type == "cuda":
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats(device)
    with device:
        worlds = [build(spec, *sizes, kind=kind, learns=True) for kind in ("edm", "distilled")]
    teacher, student = (compile_parts(world, how) for world in worlds)
    student.load_state_dict(teacher.state_dict())
    config = FitConfig(5, 1, _RATE)
    method = DMD2(cast(Stepwise, teacher), cast(Stepwise, student), config, **_CRITIC)
    clip = clips(spec, 1).to(device)
    with ExitStack() as adapted:
        for learner in method.learners:
            adapted.enter_context(low_rank(learner, rank))
        trained = Trainee(method).trained
        optimisers = method.optimise(trained, config.lr, config.weight_decay)
        method.train()

        def update(step: int) -> None:
            for optimiser in optimisers:
                optimiser.zero_grad(set_to_none=True)
            with mixed_precision(device, True):
                value: Tensor = method.loss(Turn(clip, step), constant_generator(step))[0]
            value.backward()
            for optimiser in optimisers:
                optimiser.step()

        seconds = {step == 4: best(partial(update, step), 2, device) for step in (3, 4)}
    peak = torch.cuda.max_memory_allocated(device) / 2**30 if device.type == "cuda" else 0.0
    return seconds, peak
