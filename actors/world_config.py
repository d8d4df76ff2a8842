"""What a config says of the robot and of the worlds around it, before anything is built."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from actors.recorded_grippers import with_recorded_grippers
from actors.rehearsal import judge_faults, policy_faults, refusals
from envs.chunked import check_mode
from envs.conditioning import PoseMapStyle
from envs.embodiment import Embodiment, EmbodimentError, Robot
from envs.episodes.formats.lerobot.info import arms_are_said
from envs.episodes.formats.lerobot.robot import agreed_robot, alike_calibrated
from envs.geometry.kinematics import Kinematics, KinematicsError
from envs.physics.suite import SuiteError, build_suite, check_task, task_names
from envs.simulators.base import WORLD_OPTIONS
from envs.specs import Rewards, WorldSpec
from envs.targets import TARGET, ConfigError, options, target, to_plain

_suites: dict[str, tuple[Embodiment, tuple[str, ...]]] = {}  # robot and tasks of each section


def embodiment_of(cfg: Mapping[str, Any]) -> Embodiment:
    """The robot: that of the task suite (task.suite), or of the data where there is no physics (task.data).

    Raises:
        ConfigError: if neither is given, or does not describe a robot.
    """
    task = cfg["task"]
    if task.get("suite") is not None:
        return _suite(task["suite"])[0]
    if not task.get("data"):
        raise ConfigError(
            "task.suite and task.data are both empty, so no robot is known; choose task=push or another"
            " suite, or name LeRobot data sets by task.data=[folder]"
        )
    robots = [(str(folder), *_recorded_robot(Path(folder))) for folder in task["data"]]
    first, robot, stated = robots[0]
    for folder, other, _ in robots[1:]:
        if difference := robot.differs(other):
            raise ConfigError(f"task.data: {first} and {folder} are of different robots: {difference}")
        robot = alike_calibrated(robot, other)
    said = [(folder, other.arms) for folder, other, says in robots if says]
    for folder, arms in said:
        if arms != said[0][1]:
            raise ConfigError(
                f"task.data: {said[0][0]} and {folder} are of different robots: arms are {said[0][1]}, but"
                f" {arms}; correct features.action.info.worldloop.arms in one of their meta/info.json"
            )
    return robot if stated else with_recorded_grippers(robot, [Path(folder) for folder, *_ in robots])


def _suite(section: Mapping[str, Any]) -> tuple[Embodiment, tuple[str, ...]]:
    """Robot and tasks of a suite; building one compiles its models."""
    known = json.dumps(to_plain(section), sort_keys=True)
    if known not in _suites:
        try:
            suite = build_suite(section)
        except (SuiteError, EmbodimentError) as error:
            raise ConfigError(str(error)) from error
        _suites[known] = suite.embodiment, tuple(suite.tasks)
    return _suites[known]


def check_world(cfg: Mapping[str, Any]) -> None:
    """See that robot, tasks and variants are there as the config names them, and that simulator, policy,
    algorithm, judge and text world can be built so, which reading the config cannot tell.

    Raises:
        ConfigError: with a line for each thing that is wrong.
    """
    spec = world_spec(cfg)
    robot, wrong = spec.embodiment, []
    if cfg["task"].get("suite") is not None:
        seen, known = _suite(cfg["task"]["suite"])
        for name in task_names(cfg["task"]["name"]):
            try:
                check_task(name, known)
            except SuiteError as error:
                wrong.append(str(error))
        sizes = sorted({tuple(camera.size) for camera in seen.cameras})
        if sizes != [tuple(cfg["task"]["size"])]:
            wrong.append(
                f"task.size={list(cfg['task']['size'])}, but the suite renders {list(map(list, sizes))}; give"
                " all its cameras that size (a suite with an option for it takes task.suite.size=${..size})"
            )
        wrong += _variant_faults(cfg["task"], seen, known)
    named = {"": cfg, "policy.": cfg["policy"], "judge.": cfg["judge"]}
    for key, section in named.items():
        # what other packages' classes mean by the word is theirs
        if "cameras" in section and str(section.get(TARGET, "envs.")).startswith(("actors.", "envs.")):
            try:
                robot.views_of(section["cameras"])
            except ValueError as error:
                wrong.append(f"{key}{error}")
    simulator = None
    if not cfg["finetune"]["data"]:  # else it is the robot of those data that counts
        own = {name: value for name, value in cfg["simulator"].items() if name not in WORLD_OPTIONS}
        simulator, refused = refusals(own, "simulator", spec=spec)
        wrong += refused
        try:
            check_state_expert(cfg)
        except ConfigError as error:
            wrong.append(str(error))
        try:
            check_mode(robot, cfg["task"]["mode"])
        except ValueError as error:
            wrong.append(str(error))
        wrong += policy_faults(cfg, spec)
    if refused := judge_faults(cfg, spec, simulator):
        wrong += refused
    elif "text_world" in cfg["judge"]:
        wrong += refusals(cfg["judge"]["text_world"], "judge.text_world", spec=spec)[1]
    if wrong:
        raise ConfigError("\n".join(wrong))


def _variant_faults(task: Mapping[str, Any], robot: Embodiment, tasks: tuple[str, ...]) -> Iterator[str]:
    """What is wrong with the variants of a task, whose suite has this robot and these tasks: each has to have
    both, since what has learned the task acts in them.
    """
    for name, changes in task.get("variants", {}).items():
        try:
            own, known = _suite({**task["suite"], **changes})
            for one in task_names(task["name"]):
                if one in tasks:
                    check_task(one, known)
        except ConfigError as error:
            yield f"task.variants.{name}: {error}"
            continue
        here, there = ([(one.name, one.size, one.calibrated) for one in of.cameras] for of in (robot, own))
        odd = robot.differs(own)
        if not odd and here != there:
            odd = f"cameras (name, size, calibrated) are {here}, but here {there}"
        if odd:
            yield (
                f"task.variants.{name} has another robot than task.suite, so what learned the task cannot act"
                f" in it: {odd}; leave out of it what changes actions or cameras"
            )


def check_state_expert(cfg: Mapping[str, Any]) -> None:
    """See that the state expert can decode this robot's states, before the simulator that it reads learns.

    Raises:
        ConfigError: naming the key and the fix.
    """
    section = cfg["simulator"]["state_expert"]
    kind: Any = target(section, "simulator.state_expert")
    try:
        kind.check(section, world_spec(cfg).embodiment)
    except ValueError as error:
        raise ConfigError(f"simulator.state_expert: {error}") from error


def _recorded_robot(folder: Path) -> tuple[Embodiment, bool]:
    """The robot of a data set, and whether the set says itself which numbers are an arm's."""
    path = folder / "meta" / "info.json"
    if not path.is_file():
        raise ConfigError(f"task.data: {path} does not exist; name folders of LeRobot data sets")
    try:
        info = json.loads(path.read_text())
        return agreed_robot(info), arms_are_said(info["features"])
    except ValueError as error:
        raise ConfigError(f"task.data: {path}: {error}") from error


def world_spec(cfg: Mapping[str, Any]) -> WorldSpec:
    """What the worlds of this config show, and how their simulators are conditioned.

    Raises:
        ConfigError: if the robot is unknown, or does not allow the conditioning that is asked for.
    """
    task, section = cfg["task"], cfg["simulator"]
    robot = embodiment_of(cfg)
    if section["kinematics"]:
        robot = replace(robot, kinematics=options(Robot, section["kinematics"], "simulator.kinematics"))
    drawn = _resolve(section["pose_map"], robot.calibrated and robot.commands_poses, "simulator.pose_map")
    rays = _resolve(section["ray_map"], robot.calibrated, "simulator.ray_map")
    try:
        return WorldSpec(robot, tuple(task["size"]), task["chunk"], drawn, rays)
    except ValueError as error:
        raise ConfigError(str(error)) from error


def _resolve(value: Any, auto: bool, key: str) -> bool:
    """`auto` is whatever the robot allows."""
    if value not in ("auto", True, False):
        raise ConfigError(f"{key}={value!r} must be auto, true or false")
    return auto if value == "auto" else bool(value)


def pose_style(cfg: Mapping[str, Any]) -> PoseMapStyle:
    """How this config's pose maps are drawn."""
    return options(PoseMapStyle, cfg["simulator"]["pose_map_style"], "simulator.pose_map_style")


def build_kinematics(cfg: Mapping[str, Any]) -> Kinematics | None:
    """Forward kinematics of the robot, if its description or simulator.kinematics names a model."""
    robot = world_spec(cfg).embodiment.kinematics
    if robot is None:
        return None
    try:
        return Kinematics(robot)
    except KinematicsError as error:
        raise ConfigError(str(error)) from error


def rewards_of(cfg: Mapping[str, Any]) -> Rewards:
    """What progress and success are worth in both worlds."""
    return options(Rewards, cfg["judge"]["rewards"], "judge.rewards")
