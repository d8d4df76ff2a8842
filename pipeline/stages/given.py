"""What stages are given: data of the stages before and its splits, options of a section, imagined worlds."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from actors.factory import build_judge, build_simulator, build_state_decoder, build_world, open_clips
from envs.episodes.clips import ClipStore
from envs.initial_states import InitialStates
from envs.manifest import read_manifest
from envs.specs import ActionMode
from envs.targets import ConfigError, options
from learners.rl.algorithm import RLConfig
from learners.training.fit import FitConfig
from pipeline.evaluation.by_task import evenly
from pipeline.graph.stage import Inputs

Cfg = Mapping[str, Any]

# Config sections behind the task, the shapes of a robot's world, a policy for it, the imagined world, and
# physics. Variants of a task are for evaluation alone: one more makes nothing else out of date.
TASK = tuple(f"task.{key}" for key in ("suite", "name", "size", "chunk", "horizon", "mode", "data", "envs"))
ROBOT = (
    *("seed", *TASK, "simulator.kinematics"),
    *("simulator.pose_map", "simulator.pose_map_style", "simulator.ray_map"),
)
POLICY = (*ROBOT, "threads", "policy")
WORLD = ("seed", "threads", *TASK, "simulator", "judge")
SIMULATOR = ("seed", "threads", *TASK, "simulator", "microbatches")
PHYSICS = (*POLICY, "judge.rewards")

# What a report shows.
EVERYTHING = (
    *("name", "seed", "threads", "microbatches", "task", "simulator", "judge", "policy", "algorithm", "rl"),
    *("rounds", "collect", "imitation", "extra_starts", "clone", "tokenizer_fit", "simulator_fit", "distill"),
    *("state_fit", "text_world_fit", "judge_fit", "equal_time"),
    *("evaluate", "measure"),
)

DATASETS = "datasets.json"  # of a stage whose data sets lie elsewhere: a list of their paths


def fit_options(cfg: Cfg, section: Mapping[str, Any], key: str) -> FitConfig:
    """FitConfig of the section at `key`, such as imitation.fit, seeded by the experiment."""
    given = {"seed": cfg["seed"], "microbatches": cfg["microbatches"], "key": key}
    return options(FitConfig, {**section, **given}, key)


def rl_options(cfg: Cfg, **more: Any) -> RLConfig:
    """RLConfig of the section rl, and what it leaves open."""
    return options(RLConfig, {**cfg["rl"], "microbatches": cfg["microbatches"], **more}, "rl")


def mode_of(cfg: Cfg) -> ActionMode:
    """How the numbers of a policy's chunks are meant."""
    return ActionMode(cfg["task"]["mode"])


def imagined_chunks(cfg: Cfg) -> int:
    """Chunks of an episode that RL imagines: enough for rl.horizon actions, at most the task's."""
    asked, chunk, whole = cfg["rl"]["horizon"], int(cfg["task"]["chunk"]), int(cfg["task"]["horizon"])
    return whole // chunk if asked is None else min(whole // chunk, -(-int(asked) // chunk))


def datasets(folders: Iterable[Path]) -> list[Path]:
    """The data sets that stages left in their folders, or point to."""
    out: list[str] = []
    for folder in folders:
        elsewhere = folder / DATASETS
        out += json.loads(elsewhere.read_text()) if elsewhere.exists() else [str(folder / "dataset")]
    return [Path(path) for path in out]


def open_store(cfg: Cfg, inputs: Inputs, role: str = "data") -> ClipStore:
    """The data sets of a role as one store."""
    return open_clips(cfg, datasets(inputs.folders(role)))


def learning_episodes(store: ClipStore) -> Tensor:
    """Episodes that simulators and policies learn from, int64 [N]: all but the held-out ones.

    Those of the calibration split are kept from judges only.
    """
    return torch.cat((store.split("train"), store.split("calibration"))).sort().values


def newest_episodes(store: ClipStore, inputs: Inputs, episodes: Tensor) -> Tensor:
    """Those of `episodes` that come from the last stage of the role data; recordings that a user lists are
    all of one.
    """
    owner = torch.tensor([row["dataset"] for row in store.episodes])
    first = len(store.parts) - len(datasets(inputs.folders("data")[-1:]))
    return episodes[owner[episodes] >= first]


def demonstrations(cfg: Cfg, store: ClipStore) -> Tensor:
    """The episodes that the first policy is cloned from, int64 [N]: of imitation.sources, not failed, and
    shared out over tasks.

    Raises:
        ConfigError: if there are fewer than imitation.demos.
    """
    section = cfg["imitation"]
    learnable = learning_episodes(store)
    mine = store.select(list(section["sources"]))
    mine = mine[torch.isin(mine, learnable)]
    good = [n for n in mine.tolist() if store.episodes[n]["success"] is not False]
    chosen = evenly(cfg, store, torch.tensor(good, dtype=torch.int64), section["demos"])
    if len(chosen) < section["demos"]:
        raise ConfigError(_too_few(section, store, learnable, len(chosen)))
    return chosen


def deployed_in(inputs: Inputs, role: str) -> int:
    """The round in which a policy was deployed, by the role of that deployment, or of what says how good it
    is: its trial, or a comparison that it stood; 0 if nobody plays it. Where a newer policy got worse that is
    no newer round.
    """
    if role not in inputs.found:
        return 0
    manifest = read_manifest(inputs.folder(role))
    assert manifest is not None, "a role is played by finished stages"
    return int(manifest["result"]["round"])


def _too_few(section: Mapping[str, Any], store: ClipStore, learnable: Tensor, found: int) -> str:
    """Why so few episodes can be cloned from, and what helps, by what becomes of the others."""
    allowed, mine = set(learnable.tolist()), set(store.select(list(section["sources"])).tolist())
    failed = {n for n, row in enumerate(store.episodes) if row["success"] is False}
    lost, held = len(mine & failed & allowed), len(mine - failed - allowed)
    rest = allowed - mine - failed
    others = sorted({store.episodes[n]["source"] for n in rest})
    why, fixes = [f"{lost} of these sources failed"] if lost else [], []
    if rest:
        why.append(f"{len(rest)} successful ones are of other sources, {others[:8]}")
        fixes.append("say \"imitation.sources=['*']\" for all, or name others")
    if held:
        why.append(f"{held} are held out")
        fixes.append("hold out fewer (splits)")
    if found:
        fixes.append(f"lower imitation.demos to {found} at most")
    fixes.append("record more that succeed" + (", or correct next.success" if lost and not found else ""))
    return (
        f"imitation.demos={section['demos']}, but the data hold {found} successful episodes of"
        f" imitation.sources={list(section['sources'])} for learning"
        f"{' (' + '; '.join(why) + ')' if why else ''}; {'; or '.join(fixes)}"
    )


def successful_episodes(cfg: Cfg, store: ClipStore, number: int) -> Tensor:
    """Episodes known to have worked in physics: successes of the policy deployed in round `number`, and the
    demonstrations where those are fewer; without deployments (number 0) the demonstrations alone.

    What older policies did pulls a better one back: cloned with theirs, one that succeeded in 44% was left
    with 38%, on its own 44%.
    """
    own, demos = store.select([f"policy-{number}"], succeeded=True), demonstrations(cfg, store)
    own = own[torch.isin(own, learning_episodes(store))]
    return own if len(own) >= len(demos) else torch.cat([demos, own])


def learns(module: nn.Module) -> bool:
    """Whether a part has anything to train."""
    return any(parameter.requires_grad for parameter in module.parameters())


def load_world(cfg: Cfg, inputs: Inputs, store: ClipStore, batch: int, episodes: Tensor | None = None) -> Any:
    """The imagined world of the roles simulator, state and judge, starting where the store's episodes do."""
    simulator = build_simulator(cfg, inputs.weights("simulator"))
    decoder = build_state_decoder(cfg, simulator, inputs.weights("state"))
    judge = build_judge(cfg, inputs.weights("judge"))
    return build_world(cfg, simulator, decoder, judge, InitialStates.of(store, episodes), batch)
