"""The contract of a task suite: a physics bench and its tasks, whoever wrote them.

A suite says which robot it has (`Embodiment`), lays out an episode from a task's name and a seed, carries out
one action per frame period, renders, and says how the task stands. Suites live in worker processes, so
nothing here imports torch.
"""

from __future__ import annotations

import difflib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from envs.embodiment import Embodiment
from envs.rng import Stream, episode_rng
from envs.targets import ConfigError, build

Array = NDArray[Any]
Expert = Callable[[], Array]  # () -> the next action [A]


class SuiteError(ConfigError):
    """A task suite cannot be built from its config; the message names the key and the fix."""


class NoExpert(SuiteError):
    """Nobody has scripted a behaviour for a task; the message says what can be done without."""


@dataclass
class Observation:
    """What a bench says of its robot and task between two actions; pictures come from `TaskSuite.render`.

    Args:
        state: float [S], what the robot knows of itself.
        command: float [A], the command in force; for delta actions the last action, zeros at the start.
        instruction: the task in words.
        success: whether the task's condition has held for `hold` seconds; once true it stays true.
        progress: true progress in 0..1, the rule reward of physics; learned parts never see it.
        intrinsic: float [V, 3, 3] in pixels, NaN of a camera that is not calibrated; None if none is.
        c2w: float [V, 4, 4] camera to world, OpenCV convention; NaN and None alike.
        poses: float [arms, 7], commanded flange poses [x, y, z, roll, pitch, yaw, gripper] in metres and
            radians, where the suite knows them and the action does not say them.
    """

    state: Array
    command: Array
    instruction: str
    success: bool
    progress: float
    intrinsic: Array | None = None
    c2w: Array | None = None
    poses: Array | None = None


class TaskSuite(ABC):
    """A physics bench with tasks, scripted experts and one robot.

    Subclasses are built in worker processes from their config section: `_target_` names the class, all other
    keys are its constructor's arguments. An episode depends on task, seed and actions alone, bit for bit.

    Attributes:
        tasks: names that `reset` takes.
        embodiment: the robot; camera sizes are those that `render` returns.
        offers: what else its options choose from, such as scenes or cameras, by the option's name.
        scenes: names of the scenes that episodes are laid out in, with its options as they are; see scene_of.
            () where all are laid out in one. A suite that has them takes names of scenes as option `scenes`.
    """

    tasks: tuple[str, ...]
    scenes: tuple[str, ...] = ()
    offers: Mapping[str, Sequence[str]] = {}
    embodiment: Embodiment

    @abstractmethod
    def reset(self, task: str, seed: int) -> None:
        """Lay out the start of `task` that `seed` draws.

        Raises:
            SuiteError: if there is no such task; see `check_task`.
        """

    @abstractmethod
    def step(self, action: Array) -> None:
        """Carry out one action float [A] for one frame period, 1 / embodiment.fps seconds."""

    @abstractmethod
    def render(self) -> NDArray[np.uint8]:
        """Pictures uint8 [V, 3, H, W] of all cameras as things stand now."""

    @abstractmethod
    def observe(self) -> Observation:
        """State, command, calibration and how the task stands now."""

    @abstractmethod
    def privileged(self) -> dict[str, Array]:
        """What only physics knows, by name; recorded under `privileged.*`, and {} is fine.

        Evaluation measures the first of `object_poses` [O, n], a row per object that begins with its centre's
        x, y, z in metres, and takes `flange_poses` [arms, n], x, y, z, roll, pitch, yaw, for where end
        effectors truly are. Shapes are those of the suite, whatever the task and the frame.
        """

    @abstractmethod
    def expert(self, noise_level: float, rng: np.random.Generator) -> Expert:
        """A scripted behaviour for the episode that was just reset.

        Args:
            noise_level: 0 is the expert, 1 pays no heed to the task.
            rng: of the behaviour's own randomness.

        Raises:
            ValueError: if the noise level lies outside [0, 1].
            NotImplementedError: if the task has none; see expert_of. One that has random actions alone gives
                them at noise level 1.
        """

    def segment(self) -> NDArray[np.uint8] | None:
        """What each pixel of `render` shows, uint8 [V, H, W]: 0 what stands still, 1 the robot, 2 things that
        can move; None of suites that do not know. For evaluation alone.
        """
        return None

    def picture(self, size: tuple[int, int]) -> NDArray[np.uint8]:
        """Pictures for people to look at, uint8 [V, 3, H, W]; suites that can render `size` do."""
        return self.render()


class HeldCondition:
    """Success as a condition that held for the last frames: being there for a moment, such as a thing that
    falls through its target, is no success.

    Args:
        hold: seconds the condition must hold.
        fps: frames per second.
    """

    def __init__(self, hold: float, fps: float):
        self.frames = max(1, round(hold * fps))
        self.count, self.success = 0, False

    def reset(self) -> None:
        """Forget what held."""
        self.count, self.success = 0, False

    def update(self, satisfied: bool) -> None:
        """Count one frame at which the condition was or was not satisfied."""
        self.count = self.count + 1 if satisfied else 0
        self.success = self.success or self.count >= self.frames


def task_names(name: str | Sequence[str]) -> tuple[str, ...]:
    """task.name of a config as a tuple: one name, or a list of them."""
    return (name,) if isinstance(name, str) else tuple(name)


def task_of(tasks: Sequence[str], seed: int) -> str:
    """The task of an episode, where several are played by turns: consecutive seeds take consecutive tasks."""
    return tasks[seed % len(tasks)]


def scene_of(scenes: Sequence[str], seed: int) -> str:
    """The scene of an episode, drawn by its seed whatever its task; "" if there are none to draw from."""
    draw = episode_rng(seed, Stream.SCENE)
    return scenes[int(draw.integers(len(scenes)))] if scenes else ""


def check_names(key: str, given: Iterable[str], known: Iterable[str]) -> None:
    """Refuse an option that holds no names, or unknown ones.

    Raises:
        SuiteError: naming the key and the nearest names that exist.
    """
    names, given = list(known), list(given)
    if not given:
        raise SuiteError(f"{key} is empty; there are {names[:5]} and {max(0, len(names) - 5)} more")
    for name in given:
        if name not in names:
            near = difflib.get_close_matches(name, names, 5, 0.3) or names[:5]
            raise SuiteError(
                f"{key} holds {name!r}, which is unknown; the nearest of {len(names)} are {near}"
            )


def check_task(task: str, tasks: Iterable[str]) -> None:
    """Refuse unknown task names.

    Raises:
        SuiteError: with the nearest names that exist.
    """
    known = sorted(tasks)
    if task not in known:
        near = difflib.get_close_matches(task, known, 5, 0.3) or known[:5]
        raise SuiteError(f"task.name={task!r} is unknown; the nearest of {len(known)} names are {near}")


def check_cameras(cameras: Iterable[str], known: Iterable[str]) -> None:
    """Refuse cameras that a bench has not.

    Raises:
        SuiteError: naming them and those that it has.
    """
    unknown = [camera for camera in cameras if camera not in known]
    if unknown:
        raise SuiteError(f"task.suite.cameras holds {unknown}; the cameras of this suite are {list(known)}")


def checked_action(action: Array, names: Sequence[str]) -> Array:
    """One action as float64 [A].

    Raises:
        ValueError: if it is not finite or has another shape, naming its numbers.
    """
    action = np.asarray(action, dtype=np.float64)
    if action.shape != (len(names),) or not np.isfinite(action).all():
        raise ValueError(f"an action here is {len(names)} finite numbers {list(names)}, got {action}")
    return action


def check_noise_level(noise_level: float) -> None:
    """Refuse noise levels outside [0, 1].

    Raises:
        ValueError: saying what they mean.
    """
    if not 0.0 <= noise_level <= 1.0:
        raise ValueError(f"noise_level={noise_level} must lie in [0, 1]: 0 is the expert, 1 is random")


def expert_of(suite: TaskSuite, task: str, noise_level: float, rng: np.random.Generator) -> Expert:
    """The suite's scripted behaviour for the episode of `task` that was just reset; see TaskSuite.expert.

    Raises:
        NoExpert: if there is none.
    """
    try:
        return suite.expert(noise_level, rng)
    except NotImplementedError as error:
        raise NoExpert(
            f"task.suite: {type(suite).__name__}.expert has no behaviour of noise level {noise_level:g} for"
            f" task {task!r} (NotImplementedError: {error}); write one, choose other tasks by task.name, or"
            " learn from recordings (task=lerobot task.data=[<folder>]); random actions, which suites give at"
            " noise level 1, can be had alone by collect.mix={expert: 0, noisy: 0, random: 1}"
        ) from error


def build_suite(section: Mapping[str, Any]) -> TaskSuite:
    """Build a task suite from its config section, `_target_: package.module.Class` and the class's options.

    Raises:
        ConfigError: if `_target_` does not import, is no TaskSuite or refuses the options.
    """
    suite = build(section, "task.suite")
    if not isinstance(suite, TaskSuite):
        raise SuiteError(
            f"task.suite._target_={section['_target_']} makes a {type(suite).__name__}, which is no"
            " envs.physics.suite.TaskSuite"
        )
    return suite
