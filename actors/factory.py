"""Builds worlds and policies from the config, in any process: no code travels, only numbers and this module's
name.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import torch
from safetensors.torch import load_file
from torch import nn
from torchrl.envs import TransformedEnv

from actors.policies.chunk_gaussian import ChunkGaussianHead
from actors.policies.chunk_tokens import ChunkTokenHead
from actors.policies.heads import Head
from actors.policies.openpi import OpenPIPolicy
from actors.policies.vla import ChunkPolicy
from envs.conditioning import PoseMapStyle
from envs.episodes.clips import ClipStore
from envs.geometry.kinematics import Kinematics, KinematicsError, Robot
from envs.judges import Judge, LearnedJudge
from envs.layouts import CommandLayout
from envs.physics.env import PhysicsEnv
from envs.physics.pool import available_cores
from envs.physics.tabletop.bench import BenchConfig, frames_held
from envs.simulators.base import Simulator, WorldShape
from envs.simulators.state_experts.base import StateDecoder
from envs.simulators.state_experts.head import StateHead
from envs.simulators.unet.engine import UNetConfig, UNetSimulator
from envs.specs import ActionMode, Rewards
from envs.transforms import world_transforms
from envs.world import InitialStates, WorldEnv

T = TypeVar("T")


class ConfigError(ValueError):
    """A value in the config cannot work; the message names the key and the fix."""


def options(kind: type[T], section: Mapping[str, Any], key: str) -> T:
    """A dataclass from a config section; lists become tuples, unknown and missing keys are named.

    Raises:
        ConfigError: naming the config key.
    """
    known = {field.name for field in fields(kind)}  # type: ignore[arg-type]
    unknown = sorted(set(section) - known)
    if unknown:
        raise ConfigError(f"{key}.{unknown[0]} is not an option; {key} takes {sorted(known)}")
    values = {name: tuple(value) if isinstance(value, list) else value for name, value in section.items()}
    try:
        return kind(**values)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{key}: {error}") from error


def prepare_process(seed: int, threads: int = 0) -> None:
    """Settings every process needs before heavy work: seeds, threads, and an allocator that keeps its memory.

    Video batches are tens of megabytes; glibc would map and unmap them at every operation, and page faults
    then
    cost a third more time per training step (8.4 ms a sample with this, 11.3 without).
    """
    # Softmax tails leave gradients too small for normal floats, on which Intel CPUs are ten times slower;
    # threads
    # started later inherit the setting.
    torch.set_flush_denormal(True)
    torch.manual_seed(seed)
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
    """The device of simulators and learners.

    Raises:
        ConfigError: if launch.device asks for a GPU that is not there.
    """
    name = cfg["launch"]["device"]
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    if name.startswith("cuda") and not torch.cuda.is_available():
        raise ConfigError(f"launch.device={name}, but this machine has no CUDA device; use launch.device=cpu")
    return torch.device(name)


def bench_config(cfg: Mapping[str, Any]) -> BenchConfig:
    """Options of the true world."""
    task = cfg["task"]
    return options(
        BenchConfig,
        {
            "task": task["name"],
            "control_hz": task["control_hz"],
            "hold": task["hold"],
            "size": task["size"],
            "views": task["views"],
        },
        "task",
    )


def world_shape(cfg: Mapping[str, Any]) -> WorldShape:
    """What every simulator of this config shows."""
    task = cfg["task"]
    return WorldShape(
        len(task["views"]),
        tuple(task["size"]),
        task["chunk"],
        cfg["simulator"]["memory"],
        task["control_hz"],
        tuple(cfg["simulator"]["sides"]),
        CommandLayout(cfg["simulator"]["layout"]),
    )


def pose_style(cfg: Mapping[str, Any]) -> PoseMapStyle:
    """How this config's pose maps are drawn."""
    return options(PoseMapStyle, cfg["simulator"]["pose_map"], "simulator.pose_map")


def build_kinematics(cfg: Mapping[str, Any]) -> Kinematics | None:
    """Forward kinematics of the robot, if simulator.kinematics says which."""
    robot = cfg["simulator"]["kinematics"]
    if robot is None:
        return None
    nested = {
        name: tuple(tuple(arm) for arm in value) if name == "joints" else value
        for name, value in robot.items()
    }
    try:
        return Kinematics(options(Robot, nested, "simulator.kinematics"))
    except KinematicsError as error:
        raise ConfigError(str(error)) from error


def joints_to_hands(cfg: Mapping[str, Any]) -> Kinematics | None:
    """Kinematics for those who say joints to a world of end-effector commands; where none are named, the
    bench's, whose worlds those are.
    """
    return build_kinematics(cfg) or (
        Kinematics() if CommandLayout(cfg["simulator"]["layout"]) is CommandLayout.EEF else None
    )


def open_clips(cfg: Mapping[str, Any], folders: Iterable[Path]) -> ClipStore:
    """Data sets as one store, with the commands and pose maps that the simulator takes."""
    return ClipStore(list(folders), CommandLayout(cfg["simulator"]["layout"]), pose_style(cfg))


def build_simulator(cfg: Mapping[str, Any], weights: Path | None = None) -> Simulator:
    """The learned world of simulator.engine, with weights if given."""
    engine, shape = cfg["simulator"]["engine"], world_shape(cfg)
    section = cfg["simulator"]["model"]
    if engine == "unet":
        model: Simulator = UNetSimulator(shape, options(UNetConfig, section, "simulator.model"))
        model.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    elif engine == "dit":
        from envs.simulators.dit.engine import DiTConfig, DiTSimulator

        model = DiTSimulator(shape, options(DiTConfig, section, "simulator.model"))
    elif engine == "gesim":
        from envs.simulators.gesim.engine import GESimConfig, GESimulator

        try:
            model = GESimulator.build(
                shape, options(GESimConfig, section, "simulator.model"), cfg["simulator"]["checkpoint"]
            )
        except ValueError as error:
            raise ConfigError(f"simulator.model: {error}") from error
    elif engine == "remote":
        from envs.simulators.remote.engine import RemoteConfig, RemoteSimulator

        return RemoteSimulator(shape, options(RemoteConfig, section, "simulator.model"))
    else:
        raise ConfigError(f"simulator.engine={engine!r} is unknown; choose unet, dit, gesim or remote")
    return load(model, weights).to(device_of(cfg))


def build_state_decoder(
    cfg: Mapping[str, Any], simulator: Simulator, weights: Path | None = None
) -> StateDecoder:
    """What decodes joint states from that simulator's features."""
    shape, engine = simulator.shape, cfg["simulator"]["engine"]
    if engine == "unet":
        decoder: StateDecoder = StateHead(simulator.feature_shape[0], shape.chunk, shape.memory)
    elif engine == "remote":
        from envs.simulators.remote.engine import GivenStates

        return GivenStates(shape.chunk)
    elif engine == "gesim":
        from envs.simulators.gesim.engine import GESimulator

        assert isinstance(simulator, GESimulator)
        decoder = simulator.state_expert()
    else:
        from envs.simulators.dit.engine import DiTSimulator
        from envs.simulators.state_experts.flow import StateExpertConfig, untrained_expert

        assert isinstance(simulator, DiTSimulator)
        decoder = untrained_expert(
            simulator, options(StateExpertConfig, cfg["simulator"]["state"], "simulator.state")
        )
    decoder = load(decoder, weights).to(device_of(cfg))
    decoder.attach(simulator)
    return decoder


def build_judge(cfg: Mapping[str, Any], weights: Path | None = None) -> LearnedJudge:
    """The learned judge."""
    section = cfg["judge"]
    judge = LearnedJudge(
        len(cfg["task"]["views"]),
        frames_held(cfg["task"]["hold"], cfg["task"]["control_hz"]),
        section["margin"],
        section["width"],
        section["points"],
        section["aims"],
    )
    return load(judge, weights).to(device_of(cfg))


def build_policy(cfg: Mapping[str, Any], weights: Path | None = None) -> ChunkPolicy:
    """The policy; it acts and learns on the CPU, for it is small."""
    section = cfg["policy"]
    chunk = cfg["task"]["chunk"]
    if section["head"] == "gaussian":
        head: Callable[[int], Head] = partial(
            ChunkGaussianHead, chunk=chunk, knots=section["knots"], std=section["std"]
        )
    elif section["head"] == "tokens":
        head = partial(ChunkTokenHead, chunk=chunk, bins=section["bins"])
    else:
        raise ConfigError(f"policy.head={section['head']!r} is unknown; choose gaussian or tokens")
    return load(
        ChunkPolicy(
            len(cfg["task"]["views"]),
            head,
            section["width"],
            section["points"],
            channels=section["channels"],
            aims=section["aims"],
        ),
        weights,
    )


def build_openpi(cfg: Mapping[str, Any], url: str) -> OpenPIPolicy:
    """An openpi server as a policy for the worlds of this config."""
    layout = CommandLayout(cfg["simulator"]["layout"])
    return OpenPIPolicy(
        url,
        tuple(cfg["task"]["views"]),
        cfg["task"]["chunk"],
        layout,
        ActionMode(cfg["task"]["mode"]),
        joints_to_hands(cfg),
    )


def build_physics(cfg: Mapping[str, Any], batch: int, record: bool = False, seed: int = 0) -> PhysicsEnv:
    """The true world."""
    task = cfg["task"]
    return PhysicsEnv(
        bench_config(cfg),
        batch,
        task["chunk"],
        task["horizon"],
        ActionMode(task["mode"]),
        options(Rewards, cfg["judge"]["rewards"], "judge.rewards"),
        cfg["launch"]["workers"],
        record,
        seed,
    )


def build_world(
    cfg: Mapping[str, Any],
    simulator: Simulator,
    decoder: StateDecoder,
    judge: Judge,
    starts: InitialStates,
    batch: int,
    later: bool = False,
    seed: int = 0,
) -> TransformedEnv:
    """The imagined world with its three transforms; `later` is JudgeReward's."""
    task = cfg["task"]
    simulator.eval(), decoder.eval(), judge.eval()
    base = WorldEnv(
        simulator,
        starts,
        batch,
        task["horizon"],
        ActionMode(task["mode"]),
        cfg["simulator"]["shared_noise"],
        cfg["simulator"]["bf16"],
        seed,
    )
    rewards = options(Rewards, cfg["judge"]["rewards"], "judge.rewards")
    return TransformedEnv(
        base,
        world_transforms(
            decoder, judge, rewards, tuple(task["views"]), later, pose_style(cfg), build_kinematics(cfg)
        ),
    )


def load(module: T, weights: Path | None) -> T:
    """Load safetensors weights strictly.

    Raises:
        ConfigError: if the file is missing or of another architecture, naming the first differences.
    """
    if weights is None:
        return module
    assert isinstance(module, nn.Module)
    if not weights.exists():
        raise ConfigError(f"{weights} does not exist; run the stage that makes it")
    found, wanted = load_file(weights), module.state_dict()
    wrong = [
        f"{k}: file {tuple(found[k].shape)}, model {tuple(wanted[k].shape)}"
        for k in found.keys() & wanted.keys()
        if found[k].shape != wanted[k].shape
    ]
    missing, extra = sorted(wanted.keys() - found.keys()), sorted(found.keys() - wanted.keys())
    if wrong or missing or extra:
        raise ConfigError(
            f"{weights} is of another architecture: missing {missing[:4]}, unexpected {extra[:4]}, differing {wrong[:4]}. Use the config it was trained with (config.yaml beside it)."
        )
    module.load_state_dict({name: value.to(wanted[name].dtype) for name, value in found.items()})
    return module  # type: ignore[return-value]
