"""Builds worlds and policies from the config, in any process: no code travels, only numbers and names.

Every choice is a class that its config section names (`_target_`, see envs/targets.py); what is known of the
world that it shall work in is handed to it as a WorldSpec.
"""

from __future__ import annotations

import ctypes
import json
import os
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.envs import TransformedEnv

from envs.conditioning import PoseMapStyle
from envs.embodiment import Embodiment, EmbodimentError, Robot
from envs.episodes.clips import ClipStore
from envs.geometry.kinematics import Kinematics, KinematicsError
from envs.initial_states import InitialStates
from envs.judges.base import Judge
from envs.manifest import check_part
from envs.physics.env import PhysicsEnv
from envs.physics.pool import TaskPool, available_cores
from envs.physics.suite import SuiteError, build_suite, check_task, task_names
from envs.simulators.base import WORLD_OPTIONS, Simulator
from envs.simulators.state_experts.base import StateDecoder
from envs.specs import ActionMode, Rewards, WorldSpec
from envs.targets import TARGET, ConfigError, build, options, to_plain
from envs.transforms import world_transforms
from envs.world import WorldEnv

__all__ = [
    "ConfigError",
    "build",
    "build_algorithm",
    "build_judge",
    "build_kinematics",
    "build_physics",
    "build_policy",
    "build_pool",
    "build_simulator",
    "build_state_decoder",
    "build_world",
    "check_world",
    "device_of",
    "embodiment_of",
    "load",
    "open_clips",
    "options",
    "pose_style",
    "prepare_process",
    "rewards_of",
    "world_spec",
]

T = TypeVar("T")

_suites: dict[str, tuple[Embodiment, tuple[str, ...]]] = {}  # robot and tasks of each section


def prepare_process(seed: int, threads: int = 0) -> None:
    """Settings every process needs before heavy work: seeds, threads, and an allocator that keeps its memory.

    Video batches are tens of megabytes; glibc would map and unmap them at every operation, and page faults
    then cost a third more time per training step (8.4 ms a sample with this, 11.3 without).
    """
    # Softmax tails leave gradients too small for normal floats, on which Intel CPUs are ten times slower;
    # threads started later inherit the setting.
    torch.set_flush_denormal(True)
    torch.manual_seed(seed)
    # Threads sum gradients of indexing in any order otherwise: the same seed would give other weights, the
    # sooner the busier the machine is. Where a GPU has no such kernel, torch warns and goes on.
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
    torch.use_deterministic_algorithms(True, warn_only=True)
    torch.utils.deterministic.fill_uninitialized_memory = False  # type: ignore[attr-defined]
    # Processes that train together on a machine share its cores; Ray Train and torchrun say how many they
    # are.
    torch.set_num_threads(
        threads or max(1, available_cores() // int(os.environ.get("LOCAL_WORLD_SIZE", "1")))
    )
    try:
        libc = ctypes.CDLL("libc.so.6")
    except OSError:
        return  # another C library: slower, not wrong
    trim, top_pad, mmap = -1, -2, -3
    libc.mallopt(mmap, 2**31 - 1)
    libc.mallopt(trim, 2**31 - 1)
    libc.mallopt(top_pad, 2**26)


def device_of(cfg: Mapping[str, Any]) -> torch.device:
    """The device of policies, simulators, judges and learners.

    Raises:
        ConfigError: if launch.device asks for a GPU that is not there.
    """
    name = cfg["launch"]["device"]
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    if name.startswith("cuda") and not torch.cuda.is_available():
        raise ConfigError(f"launch.device={name}, but this machine has no CUDA device; use launch.device=cpu")
    return torch.device(name)


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
    robots = [(str(folder), _recorded_robot(Path(folder))) for folder in task["data"]]
    first, robot = robots[0]
    for folder, other in robots[1:]:
        if difference := robot.differs(other):
            raise ConfigError(f"task.data: {first} and {folder} are of different robots: {difference}")
    return robot


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
    """See that robot and tasks are there as the config names them, which reading the config cannot tell.

    Raises:
        ConfigError: with a line for each thing that is wrong.
    """
    robot, wrong = world_spec(cfg).embodiment, []
    if cfg["task"].get("suite") is not None:
        for name in task_names(cfg["task"]["name"]):
            try:
                check_task(name, _suite(cfg["task"]["suite"])[1])
            except SuiteError as error:
                wrong.append(str(error))
    named = {"": cfg, "policy.": cfg["policy"], "judge.": cfg["judge"]}
    for key, section in named.items():
        # what other packages' classes mean by the word is theirs
        if "cameras" in section and str(section.get(TARGET, "envs.")).startswith(("actors.", "envs.")):
            try:
                robot.views_of(section["cameras"])
            except ValueError as error:
                wrong.append(f"{key}{error}")
    if wrong:
        raise ConfigError("\n".join(wrong))


def _recorded_robot(folder: Path) -> Embodiment:
    path = folder / "meta" / "info.json"
    if not path.is_file():
        raise ConfigError(f"task.data: {path} does not exist; name folders of LeRobot v3.0 data sets")
    try:
        return Embodiment.from_info(json.loads(path.read_text()))
    except (EmbodimentError, KeyError, ValueError) as error:
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


def open_clips(cfg: Mapping[str, Any], folders: Iterable[Path | str]) -> ClipStore:
    """Data sets as one store that shows what this config's worlds show."""
    return ClipStore([Path(folder) for folder in folders], world_spec(cfg), style=pose_style(cfg))


def build_simulator(cfg: Mapping[str, Any], weights: Path | None = None) -> Simulator:
    """The learned world of the simulator section, with weights if given."""
    section = {name: value for name, value in cfg["simulator"].items() if name not in WORLD_OPTIONS}
    model: Simulator = build(section, "simulator", spec=world_spec(cfg))
    return load(model, weights).to(device_of(cfg))


def build_state_decoder(
    cfg: Mapping[str, Any], simulator: Simulator, weights: Path | None = None
) -> StateDecoder:
    """What decodes the robot's states from that simulator's features."""
    decoder: StateDecoder = build(
        cfg["simulator"]["state_expert"], "simulator.state_expert", simulator=simulator
    )
    decoder = load(decoder, weights).to(device_of(cfg))
    decoder.attach(simulator)
    return decoder


def build_judge(cfg: Mapping[str, Any], weights: Path | None = None) -> Judge:
    """The judge of the judge section."""
    section = {name: value for name, value in cfg["judge"].items() if name != "rewards"}
    judge: Judge = build(section, "judge", spec=world_spec(cfg))
    return load(judge, weights).to(device_of(cfg))


def build_policy(cfg: Mapping[str, Any], weights: Path | None = None) -> TensorDictModuleBase:
    """The policy of the policy section; see actors/policies/contract.py."""
    policy: TensorDictModuleBase = build(cfg["policy"], "policy", spec=world_spec(cfg))
    return load(policy, weights).to(device_of(cfg))


def rewards_of(cfg: Mapping[str, Any]) -> Rewards:
    """What progress and success are worth in both worlds."""
    return options(Rewards, cfg["judge"]["rewards"], "judge.rewards")


def build_physics(cfg: Mapping[str, Any], batch: int, record: bool = False, seed: int = 0) -> PhysicsEnv:
    """The true world.

    Raises:
        ConfigError: if the task has no suite, or no task of that name.
    """
    task = cfg["task"]
    if task.get("suite") is None:
        raise ConfigError("task.suite is empty: this task is known from data alone and has no physics")
    try:
        pool = TaskPool(task["suite"], task["name"], batch, task["horizon"], cfg["launch"]["workers"])
        return PhysicsEnv(pool, world_spec(cfg), ActionMode(task["mode"]), rewards_of(cfg), record, seed)
    except (SuiteError, EmbodimentError) as error:
        raise ConfigError(str(error)) from error


def build_pool(cfg: Mapping[str, Any]) -> TaskPool:
    """Worker processes that run scripted episodes of the task, one slot each."""
    task, workers = cfg["task"], cfg["launch"]["workers"] or available_cores()
    try:
        return TaskPool(task["suite"], task["name"], workers, task["horizon"], workers)
    except (SuiteError, EmbodimentError) as error:
        raise ConfigError(str(error)) from error


def build_algorithm(cfg: Mapping[str, Any], policy: TensorDictModuleBase) -> Any:
    """The algorithm of the algorithm section (learners.rl.algorithm.Algorithm) around a policy."""
    return build(cfg["algorithm"], "algorithm", policy=policy, spec=world_spec(cfg))


def build_world(
    cfg: Mapping[str, Any],
    simulator: Simulator,
    decoder: StateDecoder,
    judge: Judge,
    starts: InitialStates,
    batch: int,
    later: bool = False,
    horizon: int | None = None,
) -> TransformedEnv:
    """The imagined world with its three transforms.

    Args:
        starts: where episodes begin.
        batch: of them side by side.
        later: see JudgeReward.
        horizon: control steps of an episode, the task's by default.
    """
    task, section = cfg["task"], cfg["simulator"]
    simulator.eval(), decoder.eval(), judge.eval()
    base = WorldEnv(
        simulator,
        starts,
        batch,
        horizon or task["horizon"],
        ActionMode(task["mode"]),
        section["shared_noise"],
        section["bf16"],
    )
    transforms = world_transforms(
        world_spec(cfg),
        decoder,
        judge,
        rewards_of(cfg),
        later=later,
        style=pose_style(cfg),
        kinematics=build_kinematics(cfg),
    )
    return TransformedEnv(base, transforms)


def load(module: T, weights: Path | None) -> T:
    """Load safetensors weights strictly.

    Raises:
        ConfigError: if the file is missing or of another architecture, naming the first differences.
        DamagedArtefact: if it is part of a finished stage and has changed since.
    """
    if weights is None:
        return module
    assert isinstance(module, nn.Module)
    if not weights.exists():
        raise ConfigError(f"{weights} does not exist; run the stage that makes it")
    check_part(weights.resolve())
    try:
        found, wanted = load_file(weights), module.state_dict()
    except SafetensorError as error:
        raise ConfigError(f"{weights} cannot be read: {error}; restore the file") from error
    wrong = [
        f"{k}: file {tuple(found[k].shape)}, model {tuple(wanted[k].shape)}"
        for k in found.keys() & wanted.keys()
        if found[k].shape != wanted[k].shape
    ]
    missing, extra = sorted(wanted.keys() - found.keys()), sorted(found.keys() - wanted.keys())
    if wrong or missing or extra:
        raise ConfigError(
            f"{weights} is of another architecture or robot: missing {missing[:4]}, unexpected {extra[:4]},"
            f" differing {wrong[:4]}. Use the config it was trained with (config.yaml beside it)."
        )
    module.load_state_dict({name: value.to(wanted[name].dtype) for name, value in found.items()})
    return module  # type: ignore[return-value]
