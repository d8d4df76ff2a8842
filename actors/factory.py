"""Builds worlds and policies from the config, in any process: no code travels, only numbers and names.

Every choice is a class that its config section names (`_target_`, see envs/targets.py); what is known of the
world that it shall work in is handed to it as a WorldSpec.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import TransformedEnv

from actors.process import device_of
from actors.weights import load
from actors.world_config import build_kinematics, pose_style, rewards_of, world_spec
from envs.embodiment import EmbodimentError
from envs.episodes.clips import ClipStore
from envs.initial_states import InitialStates
from envs.judges.base import Judge
from envs.physics.env import PhysicsEnv
from envs.physics.pool import TaskPool, available_cores
from envs.physics.suite import SuiteError
from envs.simulators.base import WORLD_OPTIONS, Simulator
from envs.simulators.compiling import compile_parts
from envs.simulators.state_experts.base import StateDecoder
from envs.simulators.tokens.text_world import TextWorld
from envs.specs import ActionMode
from envs.targets import ConfigError, build, target, to_plain
from envs.transforms import world_transforms
from envs.world import WorldEnv

_ALGORITHM = {"bootstraps": False, "supports_delayed_reward": False, "group_size": 1}
_shapes: dict[str, tuple[int, ...]] = {}  # of the features of simulators that judges asked for


def open_clips(cfg: Mapping[str, Any], folders: Iterable[Path | str]) -> ClipStore:
    """Data sets as one store that shows what this config's worlds show."""
    return ClipStore([Path(folder) for folder in folders], world_spec(cfg), style=pose_style(cfg))


def build_simulator(cfg: Mapping[str, Any], weights: Path | None = None) -> Simulator:
    """The learned world of the simulator section, with weights if given."""
    section = {name: value for name, value in cfg["simulator"].items() if name not in WORLD_OPTIONS}
    model: Simulator = build(section, "simulator", spec=world_spec(cfg))
    return compile_parts(load(model, weights).to(device_of(cfg)), cfg["launch"]["compile"])


def build_state_decoder(
    cfg: Mapping[str, Any], simulator: Simulator, weights: Path | None = None
) -> StateDecoder:
    """What decodes the robot's states from that simulator's features."""
    decoder: StateDecoder = build(
        cfg["simulator"]["state_expert"], "simulator.state_expert", simulator=simulator
    )
    decoder = compile_parts(load(decoder, weights).to(device_of(cfg)), cfg["launch"]["compile"])
    decoder.attach(simulator)
    return decoder


def build_judge(cfg: Mapping[str, Any], weights: Path | None = None) -> Judge:
    """The judge of the judge section."""
    section = {name: value for name, value in cfg["judge"].items() if name != "rewards"}
    context: dict[str, Any] = {"spec": world_spec(cfg)}
    if getattr(target(section, "judge"), "reads_features", False):
        context["feature_shape"] = _feature_shape(cfg)
    judge: Judge = build(section, "judge", **context)
    return load(judge, weights).to(device_of(cfg))


def _feature_shape(cfg: Mapping[str, Any]) -> tuple[int, ...]:
    """Of the simulator's features of a chunk; building one is the only way to know, and its first weights
    shall draw none of the numbers that others go on with.
    """
    known = json.dumps([to_plain(cfg["simulator"]), to_plain(cfg["task"])], sort_keys=True, default=str)
    if known not in _shapes:
        with torch.random.fork_rng(devices=[]):
            _shapes[known] = build_simulator(cfg).feature_shape
    return _shapes[known]


def build_text_world(cfg: Mapping[str, Any], weights: Path | None = None) -> TextWorld:
    """The text world of a judge that asks for one, judge.text_world; see tokens/text_world.py."""
    world: TextWorld = build(cfg["judge"]["text_world"], "judge.text_world", spec=world_spec(cfg))
    return load(world, weights).to(device_of(cfg))


def build_policy(cfg: Mapping[str, Any], weights: Path | None = None) -> TensorDictModuleBase:
    """The policy of the policy section; see actors/policies/contract.py.

    It stays in evaluation mode but where it is cloned: with dropout, an RL update would find other
    likelihoods than the rollout that it learns from.
    """
    policy: TensorDictModuleBase = build(cfg["policy"], "policy", spec=world_spec(cfg))
    return load(policy, weights).to(device_of(cfg)).eval()


def at_once(cfg: Mapping[str, Any], most: int) -> int:
    """How many of `most` episodes the task lets be laid out at once (task.envs)."""
    return min(most, cfg["task"].get("envs") or most)


def build_physics(
    cfg: Mapping[str, Any],
    batch: int,
    record: bool = False,
    seed: int = 0,
    changes: Mapping[str, Any] | None = None,
) -> PhysicsEnv:
    """The true world.

    Args:
        batch: episodes side by side, no more than `at_once` allows.
        record: keep every frame, for PhysicsEnv.pop_tracks.
        seed: of the stream of episode seeds.
        changes: options of the suite that are other than the config says, as one of task.variants is.

    Raises:
        ConfigError: if the task has no suite, no task of that name, or less room than is asked for.
    """
    task, suite = cfg["task"], _suite_of(cfg, changes)
    if at_once(cfg, batch) < batch:
        raise ConfigError(
            f"task.envs={task['envs']} episodes may be laid out side by side, but RL in physics asks for"
            f" {batch}, which is rl.envs / rl.shards: lower rl.envs, or take more shards"
        )
    try:
        pool = TaskPool(suite, task["name"], batch, task["horizon"], cfg["launch"]["workers"])
        return PhysicsEnv(pool, world_spec(cfg), ActionMode(task["mode"]), rewards_of(cfg), record, seed)
    except (SuiteError, EmbodimentError) as error:
        raise ConfigError(str(error)) from error


def build_pool(
    cfg: Mapping[str, Any], changes: Mapping[str, Any] | None = None, horizon: int | None = None
) -> TaskPool:
    """Worker processes that run scripted episodes of the task, one slot each.

    Args:
        changes: see build_physics.
        horizon: actions of an episode, the task's by default; 0 only lays it out.

    Raises:
        ConfigError: if the task has no suite, or no task of that name.
    """
    task, workers = cfg["task"], at_once(cfg, cfg["launch"]["workers"] or available_cores())
    actions, suite = task["horizon"] if horizon is None else horizon, _suite_of(cfg, changes)
    try:
        return TaskPool(suite, task["name"], workers, actions, workers)
    except (SuiteError, EmbodimentError) as error:
        raise ConfigError(str(error)) from error


def _suite_of(cfg: Mapping[str, Any], changes: Mapping[str, Any] | None) -> dict[str, Any]:
    """The section of the task's suite, some of its options changed."""
    suite = cfg["task"].get("suite")
    if suite is None:
        raise ConfigError(
            "task.suite is empty: this task is known from data alone and has no physics; choose a task with a"
            " suite (task=push)"
        )
    return {**suite, **(changes or {})}


def build_algorithm(cfg: Mapping[str, Any], policy: TensorDictModuleBase) -> Any:
    """The algorithm of the algorithm section (learners.rl.algorithm.Algorithm) around a policy; attributes
    that it does not say are those of one without a critic, steps or groups of its own.
    """
    made = build(cfg["algorithm"], "algorithm", policy=policy, spec=world_spec(cfg))
    for name, value in {"name": type(made).__name__, **_ALGORITHM}.items():
        if not hasattr(made, name):
            setattr(made, name, value)
    return made


def build_world(
    cfg: Mapping[str, Any],
    simulator: Simulator,
    decoder: StateDecoder,
    judge: Judge | None,
    starts: InitialStates,
    batch: int,
    later: bool = False,
    horizon: int | None = None,
) -> TransformedEnv:
    """The imagined world with its transforms.

    Args:
        judge: see world_transforms.
        starts: where episodes begin.
        batch: of them side by side.
        later: see JudgeReward.
        horizon: control steps of an episode, the task's by default.
    """
    task, section = cfg["task"], cfg["simulator"]
    simulator.eval(), decoder.eval()
    if judge is not None:
        judge.eval()
    base = WorldEnv(
        simulator,
        starts,
        batch,
        horizon or task["horizon"],
        ActionMode(task["mode"]),
        shared_noise=section["shared_noise"],
        bf16=section["bf16"],
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
