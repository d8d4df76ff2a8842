"""One game: an episode that a person, a recording or the expert drives, in physics and beside it imagined."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from actors.playing.controls import Controls
from actors.playing.imagination import Imagined, ImaginedSide
from envs.embodiment import Embodiment
from envs.initial_states import InitialStates
from envs.physics.checked import observation, rendered
from envs.physics.suite import Array, NoExpert, Observation, TaskSuite, check_task, expert_of
from envs.rng import Stream, episode_rng

Starts = Callable[[Observation, NDArray[np.uint8]], InitialStates]
Driver = Callable[[], Array | None]  # () -> the next action [A], None when there is none


class Unplayable(ValueError):
    """What was asked for is not part of this game; the message says what is."""


@dataclass(frozen=True)
class Recorded:
    """Recorded actions to play.

    Args:
        title: for people.
        task, seed: of the episode; physics lays the same one out.
        actions: float [T, A], without the command in force at the start.
    """

    title: str
    task: str
    seed: int
    actions: NDArray[Any]


@dataclass
class Shown:
    """What happened since the last look: of each side the frames uint8 [L, V, 3, H, W], [] without it."""

    true: list[NDArray[np.uint8]] = field(default_factory=list)
    imagined: list[NDArray[np.uint8]] = field(default_factory=list)


class Game:
    """The state of a game. Not to be used from two threads at once: physics draws with OpenGL.

    Args:
        robot: who is moved.
        tasks: names of the suite's tasks that can be chosen; of recordings one name.
        suite: physics, None where there is none.
        imagination: None where no world was learned.
        starts: of imagination, from what physics shows; None takes those that imagination has.
        recorded: what can be played.
        travel: see Controls.

    Raises:
        ValueError: if there is neither physics nor imagination.
    """

    def __init__(
        self,
        robot: Embodiment,
        tasks: Sequence[str],
        suite: TaskSuite | None,
        imagination: ImaginedSide | None,
        starts: Starts | None = None,
        recorded: Sequence[Recorded] = (),
        travel: NDArray[Any] | None = None,
    ):
        if suite is None and imagination is None:
            raise ValueError("a game needs physics or imagination")
        self.robot, self.tasks, self.suite, self.imagination = robot, tuple(tasks), suite, imagination
        self.starts, self.recorded = starts, tuple(recorded)
        self.controls = Controls(robot, travel)
        self.task, self.seed, self.steps, self.driven_by = self.tasks[0], 0, 0, "keys"
        self.seen: Observation | None = None
        self.dreamt: Imagined | None = None
        self.command = np.zeros(robot.action_dim)
        self._driver: Driver | None = None

    @property
    def chunk(self) -> int:
        """Most actions of one step."""
        return self.imagination.chunk if self.imagination is not None else 1

    @property
    def instruction(self) -> str:
        """What the robot is told."""
        if self.seen is not None:
            return self.seen.instruction
        return self.imagination.instruction if self.imagination is not None else ""

    def reset(self, seed: int, task: str = "") -> Shown:
        """Lay out an episode for the keyboard.

        Args:
            seed: of the episode; where there is no physics, which recording it begins as.
            task: "" keeps the task.

        Raises:
            SuiteError: if there is no such task, or what the suite shows and says is not its embodiment's.
        """
        if task:
            check_task(task, self.tasks)
            self.task = task
        self.seed, self.steps, self.driven_by, self._driver = seed, 0, "keys", None
        shown, starts = Shown(), None
        if self.suite is not None:
            self.suite.reset(self.task, seed)
            self.seen = observation(self.suite)
            shown.true = [rendered(self.suite)]
            self.command = self.controls.start(self.seen.command)
            starts = self.starts(self.seen, shown.true[0]) if self.starts is not None else None
        if self.imagination is not None:
            self.dreamt = self.imagination.reset(starts, seed)
            shown.imagined = list(self.dreamt.frames)
            if self.suite is None:
                self.command = self.controls.start(self.imagination.command)
        return shown

    def hand_over(self, to: str, number: int = 0, noise_level: float = 0.0) -> Shown:
        """Lay out an episode for "expert" (of this task and seed) or "recorded" (recording `number`, whose
        seed and task are taken).

        Raises:
            Unplayable: if there is no such driver here.
        """
        if to == "expert":
            if self.suite is None:
                raise Unplayable("the expert needs physics, which this task has not")
            shown = self.reset(self.seed)
            rng = episode_rng(self.seed, Stream.BEHAVIOUR)
            try:
                self._driver = expert_of(self.suite, self.task, noise_level, rng)
            except NoExpert as error:
                raise Unplayable(str(error)) from error
        elif to == "recorded":
            if not 0 <= number < len(self.recorded):
                raise Unplayable(f"recording {number} is not one of {len(self.recorded)}")
            played = self.recorded[number]
            shown = self.reset(played.seed, played.task)
            left: Iterator[Array] = iter(played.actions)
            self._driver = lambda: next(left, None)
        else:
            raise Unplayable(f"driver {to[:40]!r} must be expert or recorded")
        self.driven_by = to
        return shown

    def press(self, held: dict[int, float], speed: float, count: int) -> Shown:
        """Hold keys for `count` actions; takes the game over from whoever drove it."""
        self.driven_by, self._driver = "keys", None
        return self._advance(lambda: self.controls.action(self.command, held, speed), count)

    def go_on(self, count: int) -> Shown:
        """Let the driver that the game was handed to take `count` actions, or as many as it has."""
        if self._driver is None:
            raise Unplayable("nobody but the keyboard drives; hand the game over first")
        return self._advance(self._driver, count)

    def _advance(self, driver: Driver, count: int) -> Shown:
        if not 1 <= count <= self.chunk:
            raise Unplayable(f"actions={count} must lie in 1..{self.chunk}")
        shown, taken = Shown(), []
        for _ in range(count):
            action = driver()
            if action is None:
                self.driven_by = "nobody"
                break
            if self.suite is not None:
                self.suite.step(action)
                self.seen = observation(self.suite, self.seen)
                shown.true.append(rendered(self.suite))
            taken.append(np.asarray(action if self.seen is None else self.seen.command))
            # Grippers of delta actions stay where the keys left them, whatever the suite made of the action.
            self.command = np.asarray(action, dtype=np.float64) if self.robot.delta else taken[-1].copy()
        if taken and self.imagination is not None:
            self.dreamt = self.imagination.step(np.stack(taken))
            shown.imagined = list(self.dreamt.frames)
        self.steps += len(taken)
        return shown
