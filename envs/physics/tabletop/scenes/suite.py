"""Five tasks in eighty scenes as a task suite, after RoboScape-R's bench: only the words say what to do."""

from __future__ import annotations

import itertools
from types import MappingProxyType

import numpy as np

from envs.physics.suite import Array, Expert, SuiteError, check_names, check_noise_level, check_task, scene_of
from envs.physics.tabletop.scenes.behaviour import (
    MANNERS,
    Follower,
    Wander,
    fingertips,
    flanges,
)
from envs.physics.tabletop.scenes.catalogue import THINGS
from envs.physics.tabletop.scenes.layout import draw_layout, lay_out
from envs.physics.tabletop.scenes.plans import plan
from envs.physics.tabletop.scenes.scene import SCENES, Scene
from envs.physics.tabletop.scenes.tasks import TASKS, Request, SceneTask
from envs.physics.tabletop.scenes.words import STYLES, instruction
from envs.physics.tabletop.suite import TwoArmSuite
from envs.ranges import NonNegative, Positive
from envs.rng import Stream, episode_rng

_NUMBERS = {name: number for number, name in enumerate(SCENES)}


class TabletopScenes(TwoArmSuite):
    """Push, pull, pick and place, move onto a mat, and carry with both hands, among two objects, two
    containers and two mats.

    Where things lie depends on scene and seed alone, so each task can be asked for at the same first frame.
    Beside a scene's own object lies one whose scene with the same container and table is in the first domain:
    what is out of it is seen there alone.

    Args:
        actions: see TwoArmSuite, as of `control_hz`, `hold`, `size` and `cameras`.
        domains: names of scenes by domain: first those to learn from, then those kept apart.
        scenes: name of a domain, or names of scenes; the seed draws one of them.
        phrasings: names of words.STYLES; the seed draws one of them.
        swapped: ask for the other object, and the other goal, at the same first frames.

    Raises:
        SuiteError: if an option does not fit; of unknown names it says the nearest ones.
    """

    tasks = tuple(TASKS)
    offers = MappingProxyType({**TwoArmSuite.offers, "scenes": tuple(SCENES), "phrasings": STYLES})

    def __init__(
        self,
        actions: str,
        control_hz: Positive,
        hold: NonNegative,
        size: tuple[int, int],
        cameras: tuple[str, ...],
        domains: dict[str, tuple[str, ...]],
        scenes: str | tuple[str, ...],
        phrasings: tuple[str, ...],
        swapped: bool,
    ):
        super().__init__(actions, control_hz, hold, size, cameras)
        for key, names in domains.items():
            check_names(f"task.suite.domains.{key}", names, SCENES)
        for one, other in itertools.combinations(domains, 2):
            if both := sorted({*domains[one]} & {*domains[other]}):
                raise SuiteError(f"task.suite.domains.{other} holds {both}, which stand in {one}, too")
        given = (scenes,) if isinstance(scenes, str) else scenes
        check_names("task.suite.scenes", given, [*domains, *SCENES])
        check_names("task.suite.phrasings", phrasings, STYLES)
        self.scenes = tuple(name for one in given for name in domains.get(one, (one,)))
        self.phrasings, self._swapped = phrasings, swapped
        first = next(iter(domains), "")
        self._known = {SCENES[name] for name in domains.get(first, ())}
        for name in self.scenes:
            if not self._companions(SCENES[name]):
                raise SuiteError(
                    f"task.suite.domains.{first} holds no other scene with container and table of {name}, so"
                    " nothing can lie beside its object; add one"
                )

    def reset(self, task: str, seed: int) -> None:
        """Lay out the scene and the things that `seed` draws, and ask for `task`."""
        check_task(task, self.tasks)
        scene = SCENES[scene_of(self.scenes, seed)]
        layout = draw_layout(scene, self._companions(scene), seed)
        rng = episode_rng(seed, Stream.REQUEST)
        style = str(rng.choice(self.phrasings))
        goals = TASKS[task].goals
        goal = goals[(int(rng.integers(2)) + self._swapped) % 2] if goals else ""
        thing = int(self._swapped)
        self.request = Request(layout, thing, goal)
        named = THINGS[(scene.thing, layout.companion)[thing]]
        self.instruction = instruction(task, style, named.words, f"{goal} {_goal_kind(task, scene)}")
        model, data = lay_out(layout)
        self.task, self.noise_level, self.manner = task, -1.0, -1
        self._goal: SceneTask = TASKS[task](self.request, model)
        self._bench.begin(model, data, self._goal, flanges(layout.hands))

    def privileged(self) -> dict[str, Array]:
        """True poses, see TwoArmSuite, of what the words name first; the scene's place in scene.SCENES;
        and of scripted episodes noise_level and the place of their manner in behaviour.MANNERS, -1 for
        neither.
        """
        return super().privileged() | {
            "scene": np.array(_NUMBERS[self.request.layout.scene.name]),
            "noise_level": np.array(self.noise_level),
            "manner": np.array(self.manner),
        }

    def expert(self, noise_level: float, rng: np.random.Generator) -> Expert:
        """The task's plan, carried out by its essential way-points alone if the noise level is 0, bent in one
        of behaviour.MANNERS that `rng` draws, or at 1 random way-points about the objects.
        """
        check_noise_level(noise_level)
        bench, goal = self._bench, self._goal
        hands = fingertips(bench.actions.poses)
        self.noise_level, points, more = noise_level, [], None
        if noise_level < 1.0:
            points = plan(self.task, self.request, goal.object_poses(bench.data), hands)
        else:
            more = Wander(lambda: goal.object_poses(bench.data)[:, :2], rng).next
        if 0.0 < noise_level < 1.0:
            self.manner = int(rng.integers(len(MANNERS)))
            points = MANNERS[self.manner](points, hands, noise_level, rng)
        follower = Follower(points, hands, 1 / self.embodiment.fps, more)
        return lambda: bench.actions.encode(flanges(follower()), bench.target)

    def _companions(self, scene: Scene) -> tuple[str, ...]:
        """Objects that may lie beside a scene's own."""
        return tuple(
            name
            for name in THINGS
            if name != scene.thing and Scene(name, scene.container, scene.table) in self._known
        )


def _goal_kind(task: str, scene: Scene) -> str:
    """What a task's goals are in a scene."""
    return scene.container if task == "pick_place" else "mat"
