"""Stage: make a student of few steps of a simulator that denoises in many."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import torch

from envs.simulators.base import Simulator
from envs.simulators.stepwise import Stepwise
from envs.targets import build
from learners.stages.distill.method import Method, Turn
from learners.stages.simulator import ClipBatches
from learners.training.fit import fit
from learners.training.lora import low_rank

# Where engines hold what decides of their conditioning, by the keys that say it; each has some of it.
_OPTIONS = {
    "simulator.actions": "actions",
    "simulator.context": "context",
    "simulator.horizon": "horizon",
    "simulator.parity": "parity",
    "simulator.prediction": "prediction",
    "simulator.denoising.prediction": "diffusion.prediction",
    "simulator.denoising.schedule": "schedule",
    "simulator.denoising.stabilisation": "denoising.stabilisation",
}
_PLAIN = (bool, int, float, str)


def train_student(
    teacher: Simulator,
    method: dict[str, Any],
    clips: ClipBatches,
    folder: Path,
    look: Callable[[int], None] | None = None,
) -> dict[str, float]:
    """Train the student, `clips.simulator`, in place, from the teacher's weights or an earlier student's.

    Args:
        method: section distill.method.
        clips: what the student learns from, and its options.
        look: as in `fit`.

    Raises:
        ValueError: if the two do not belong together, naming the keys.
        ConfigError: if the method cannot be built.
    """
    student, options = clips.simulator, clips.options
    check_pair(teacher, student)
    made: Method = build(method, "distill.method", teacher=teacher, student=student, config=options)

    def batch(step: int, generator: torch.Generator) -> Turn:
        return Turn(clips(step, generator), step)

    with ExitStack() as adapted:
        for learner in made.learners:
            adapted.enter_context(low_rank(learner, clips.config.lora))
        return fit("distill", made, batch, made.loss, options, folder, optimise=made.optimise, look=look)


def check_pair(teacher: Simulator, student: Simulator) -> None:
    """See that a student can be made of a teacher.

    Raises:
        ValueError: naming the keys in which they differ, or by which a simulator has no steps.
    """
    for role, world in (("teacher", teacher), ("student", student)):
        if not isinstance(world, Stepwise):
            raise ValueError(
                f"the {role}, {type(world).__name__}, does not denoise in steps; set distill.steps=0, or"
                " choose simulator=dit, forcing or gesim"
            )
    assert isinstance(teacher, Stepwise) and isinstance(student, Stepwise)
    pairs = {
        "task (its robot)": (teacher.spec.embodiment, student.spec.embodiment),
        "task.size": (teacher.spec.size, student.spec.size),
        "task.chunk": (teacher.spec.chunk, student.spec.chunk),
        "simulator.pose_map": (teacher.spec.pose_map, student.spec.pose_map),
        "simulator.ray_map": (teacher.spec.ray_map, student.spec.ray_map),
        "simulator.memory_frames": (teacher.memory_frames, student.memory_frames),
        "simulator._target_": (type(teacher).__name__, type(student).__name__),
        **{key: (_about(teacher, path), _about(student, path)) for key, path in _OPTIONS.items()},
    }
    odd = [f"{key}: {a!r} and {b!r}" for key, (a, b) in pairs.items() if a != b]
    if odd:
        raise ValueError(
            f"teacher and student are conditioned differently: {'; '.join(odd)}; make them alike"
        )
    one, other = _sizes(teacher), _sizes(student)
    odd = [name for name in {**one, **other} if one.get(name) != other.get(name)]
    if odd:
        raise ValueError(
            f"teacher and student are networks of different sizes: {odd[0]} is {one.get(odd[0])} and"
            f" {other.get(odd[0])}; give both the same simulator.net and simulator.codec (gesim:"
            " simulator.scratch)"
        )
    if not student.sampler.jumps:
        raise ValueError(
            "a student samples in distilled steps; set simulator.denoising.sampler=distilled (dit, forcing)"
            " or simulator.sampling.kind=student (gesim)"
        )
    many, few = teacher.sampler.evaluations, student.sampler.evaluations
    if few > many:
        raise ValueError(
            f"distill.steps={few} are more than the teacher's {many}; lower distill.steps, or raise"
            " simulator.denoising.steps (dit, forcing) or simulator.sampling.steps (gesim)"
        )


def _about(world: Simulator, path: str) -> Any:
    """What an engine holds at a dotted path: a number, or a part's class and numbers; alike for all that hold
    nothing there.
    """
    part: Any = world
    for name in path.split("."):
        part = getattr(part, name, None)
    if type(part) in _PLAIN:
        return part
    held = {key: value for key, value in getattr(part, "__dict__", {}).items() if type(value) in _PLAIN}
    held.pop("training", None)  # of modules: not what they are
    return f"{type(part).__name__} {held}"


def _sizes(world: Simulator) -> dict[str, tuple[int, ...]]:
    """Shapes of its weights, those of its autoencoder among them, by name."""
    return {name: tuple(value.shape) for name, value in world.state_dict().items()}
