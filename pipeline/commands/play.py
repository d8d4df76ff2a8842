"""What `worldloop play` opens: the task's physics, and beside it the world that a run of it has learned."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from actors.factory import build_judge, build_simulator, build_state_decoder, build_world, open_clips
from actors.playing.game import Game, Recorded
from actors.playing.imagination import ImaginedSide, start_of
from actors.world_config import build_kinematics, embodiment_of, pose_style, world_spec
from envs.embodiment import Embodiment
from envs.episodes.formats.lerobot.dataset import LeRobotDataset
from envs.initial_states import InitialStates
from envs.physics.checked import observation, rendered
from envs.physics.suite import Observation, TaskSuite, build_suite, task_names, task_of
from envs.targets import ConfigError
from pipeline.acting import acting
from pipeline.commands.worlds.sweep import usual_travel
from pipeline.evaluation.by_task import tasks_told
from pipeline.graph.stage import WEIGHTS
from pipeline.loop import build_loop, has_physics

Cfg = Mapping[str, Any]
_PARTS = ("simulator", "state", "judge")


def learned_world(cfg: Cfg, root: Path) -> dict[str, Path]:
    """Weights of the newest imagined world that a run has finished, by part: simulator, state and judge; {}
    if it has none yet.
    """
    graph = build_loop(cfg, root)
    for node in reversed(graph.nodes.values()):
        made = {part: node.inputs[part] for part in _PARTS if isinstance(node.inputs.get(part), str)}
        if len(made) == len(_PARTS) and all(graph.finished(str(stage)) for stage in made.values()):
            return {part: graph.folder(str(stage)) / WEIGHTS for part, stage in made.items()}
    return {}


def build_game(cfg: Cfg, world: Mapping[str, Path], actions: Path | None = None) -> Game:
    """The game of a config.

    Args:
        cfg: the resolved config.
        world: see `learned_world`.
        actions: a LeRobot data set of this robot whose actions can be played, None for none.

    Raises:
        ConfigError: if there is neither physics nor a learned world, or the actions are another robot's, or
            of episodes that this physics does not know.
    """
    if not has_physics(cfg) and not world:
        raise ConfigError(
            "this task has no physics (task.suite is empty), and no run of this config has learned a world"
            " yet: first `worldloop run` with the same options, or choose a task with a suite"
        )
    names, robot = task_names(cfg["task"]["name"]), embodiment_of(cfg)
    suite = build_suite(cfg["task"]["suite"]) if has_physics(cfg) else None
    recorded = _recorded(actions, robot, names, suite) if actions is not None else []
    if suite is None:
        store = open_clips(cfg, cfg["task"]["data"])
        imagination = _imagination(cfg, world, InitialStates.of(store))
        return Game(robot, names, None, imagination, None, recorded, usual_travel(store, cfg).numpy())
    tasks = tuple(dict.fromkeys((*names, *suite.tasks)))
    if not world:
        return Game(robot, tasks, suite, None, None, recorded)
    begin = partial(_start, cfg)
    suite.reset(tasks[0], 0)
    imagination = _imagination(cfg, world, begin(observation(suite), rendered(suite)))
    return Game(robot, tasks, suite, imagination, begin, recorded)


def _start(cfg: Cfg, observed: Observation, pictures: NDArray[np.uint8]) -> InitialStates:
    return start_of(world_spec(cfg), observed, pictures, pose_style(cfg), build_kinematics(cfg))


def _imagination(cfg: Cfg, world: Mapping[str, Path], starts: InitialStates) -> ImaginedSide:
    cfg = acting(cfg)
    simulator = build_simulator(cfg, world["simulator"])
    decoder = build_state_decoder(cfg, simulator, world["state"])
    return ImaginedSide(build_world(cfg, simulator, decoder, build_judge(cfg, world["judge"]), starts, 1))


def _recorded(
    folder: Path, robot: Embodiment, names: Sequence[str], suite: TaskSuite | None
) -> list[Recorded]:
    """The recorded actions of a data set, by episode; `names` are the tasks that are played by turns."""
    data = LeRobotDataset(folder)
    wanted, found = (
        (one.robot, one.action_names, one.action_kind, one.delta, one.fps) for one in (robot, data.embodiment)
    )
    if wanted != found:
        raise ConfigError(f"actions={folder} are of {found}, but this task's robot is {wanted}")
    out, told = [], []
    for number, episode in enumerate(data):
        outcome = {True: "success", False: "failure", None: ""}[episode.succeeded]
        title = f"{number}: {episode.instruction}, seed {episode.seed} {episode.source} {outcome}".strip()
        out.append(Recorded(title, task_of(names, episode.seed), episode.seed, episode.commands[1:]))
        told.append((episode.seed, episode.instruction))
    if suite is None:
        return out
    tasks = tasks_told(suite, names, told)
    if None in tasks:
        seed, words = told[tasks.index(None)]
        raise ConfigError(
            f"actions={folder}: the episode of seed {seed} was told {words!r}, which this suite says of none"
            " of its tasks there; say the options task=... that it was recorded with"
        )
    return [replace(one, task=task) for one, task in zip(out, tasks, strict=True) if task]
