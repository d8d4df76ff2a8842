"""Stages of reinforcement learning: in the imagined world, and in physics for comparison."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor
from tqdm import tqdm

from actors.factory import build_algorithm, build_policy, open_clips
from actors.fleets.fleet import Fleet, FleetError
from actors.fleets.launch import build_fleet
from actors.policies.contract import action_key, freeze_perception, rl_rate
from actors.process import prepare_process
from actors.rollouts.recipe import Recipe
from actors.world_config import rewards_of
from envs.episodes.clips import ClipStore
from envs.episodes.key_frames import key_points
from envs.initial_states import decision_points, shared_out
from envs.rng import Purpose, episode_seeds
from envs.specs import CHUNK
from envs.targets import target
from learners.rl.algorithm import Algorithm, RLConfig
from learners.rl.loop import train_rl
from learners.rl.recorded.decisions import RecordedDecisions, TrueExperience
from learners.rl.recorded.rollout import dataset_rollout
from learners.rl.starts import Starts, weighed
from learners.stages.imitation import Cloning
from learners.training.parallel import leads
from pipeline.evaluation.by_task import tasks_of_episodes, tasks_of_first_frames
from pipeline.evaluation.result import result_of
from pipeline.graph.artefact import save_weights
from pipeline.graph.stage import Inputs, Place, stage
from pipeline.graph.view import ConfigView
from pipeline.stages.given import (
    PHYSICS,
    WORLD,
    Cfg,
    datasets,
    deployed_in,
    imagined_chunks,
    learning_episodes,
    mode_of,
    newest_episodes,
    open_store,
    rl_options,
    successful_episodes,
)
from pipeline.stages.judging.cost import priced
from pipeline.stages.judging.recordings import judge_of_recordings
from pipeline.stages.trials import true_success

LEARNING = ("policy", "algorithm", "rl", "imitation", "microbatches")


@stage(reads=(*WORLD, *LEARNING, "extra_starts.share"), place=Place.LEARNERS)
@priced
def rl(cfg: ConfigView, folder: Path, inputs: Inputs) -> dict[str, Any]:
    """RL inside the simulator, or by recorded decisions alone where imagined ones weigh nothing; the role
    `starts`, if somebody plays it, holds first frames that nothing more was recorded of.

    The role `known` says in which round the policy was deployed, whose true decisions are learned from and
    whose successes anchor it; without one demonstrations alone anchor it.

    Settings: number of the round, iterations.

    Raises:
        FleetError: if too many episodes are lost; also what to change, where the judge lost most of them.
    """
    ready = begin(cfg, inputs)
    if ready.true.alone and leads():
        tqdm.write("rl: imagined decisions weigh nothing and are not made; it learns from recorded ones")
    fleet = build_fleet(ready.recipe) if leads() and not ready.true.alone else None
    try:
        watch = true_success(cfg, ready.settings, inputs.weights("policy"))
        learning = (fleet, ready.policy, ready.algorithm, ready.settings, folder, ready.starts)
        stats = train_rl(*learning, true=ready.true, watch=watch)
        stats["alarms"] = [*stats["alarms"], *nothing_left(ready.settings, ready.true.decisions)]
    except FleetError as error:
        raise FleetError(f"{error}{what_the_judge_needs(cfg, fleet)}") from error
    finally:
        if fleet is not None:
            fleet.close()
    save_weights(ready.policy, folder)
    last = {f"last_{key}": value for key, value in stats.pop("last").items()}
    return {"lr": ready.settings.lr, **ready.known, **stats, **last}


@dataclass(frozen=True)
class Imagination:
    """What learns in a simulator, and what from, before the first iteration.

    Args:
        recipe: of the hosts that imagine.
        starts: of imagined episodes.
        true: what physics has told.
        rollout: those true episodes [N, T] as the critic values them, if there are any.
        known: figures of all this.
        store: of all recordings; inside: its episodes in which imagined ones begin, all if None; beyond: of
            first frames alone.
    """

    policy: Any
    algorithm: Algorithm
    settings: RLConfig
    recipe: Recipe
    starts: Starts
    true: TrueExperience
    rollout: TensorDict | None
    known: dict[str, float]
    store: ClipStore
    inside: Tensor | None
    beyond: ClipStore | None


def begin(cfg: ConfigView, inputs: Inputs) -> Imagination:
    """All that the stage `rl` begins with; see there."""
    number, deployed = inputs.settings["number"], deployed_in(inputs, "known")
    prepare_process(cfg["seed"], cfg["threads"])
    store = open_store(cfg, inputs)
    policy = build_policy(cfg, inputs.weights("policy"))
    lr, iterations = rl_rate(policy, cfg["rl"]["lr"]), inputs.settings["iterations"]
    settings = rl_options(cfg, iterations=iterations, seed=cfg["seed"] * 100 + number, lr=lr)
    anchor = Cloning(policy, store, successful_episodes(cfg, store, deployed), mode_of(cfg))
    if settings.freeze_perception:
        freeze_perception(policy)
        anchor.encode()
    algorithm = build_algorithm(cfg, policy)
    inside = None if settings.starts == "first" else newest_episodes(store, inputs, learning_episodes(store))
    data, more = (datasets(inputs.folders(role)) for role in ("data", "starts"))
    beyond = open_clips(cfg, more) if more else None
    extra = range(len(store), len(store) + (0 if beyond is None else len(beyond)))
    known, rollout, decisions = _warm_up(cfg, inputs, policy, algorithm, store, settings.seed)
    recipe = Recipe(
        config=cfg.plain(),
        episodes=settings.envs // settings.shards,
        policy=str(inputs.weights("policy")),
        simulator=str(inputs.weights("simulator")),
        decoder=str(inputs.weights("state")),
        judge=str(inputs.weights("judge")),
        data=tuple(str(path) for path in (*data, *more)),
        inside=() if inside is None else tuple(inside.tolist()),
        first=() if inside is None else tuple(extra),
        horizon=imagined_chunks(cfg) * int(cfg["task"]["chunk"]),
        freeze_perception=settings.freeze_perception,
        bootstrap=algorithm.bootstraps,
        later=settings.rewards_later,
    )
    starts = starts_of(cfg, *_begun(store, inside, settings.starts == "key"), len(extra))
    recorded = decisions is not None and settings.recorded > 0
    if worth := worth_in(inputs):
        starts, mean = by_worth(starts, tasks_of_starts(cfg, store, inside, beyond), worth)
        if recorded:
            settings = replace(settings, imagined=settings.imagined * mean)
        known["imagined_weight"] = settings.imagined
    alone = settings.envs * imagined_chunks(cfg) if recorded and not settings.imagined else 0
    true = TrueExperience(anchor, decisions, alone)
    return Imagination(
        *(policy, algorithm, settings, recipe, starts, true, rollout, known), store, inside, beyond
    )


def _begun(store: ClipStore, inside: Tensor | None, key: bool) -> tuple[int, Sequence[int]]:
    """How many starts recorded episodes offer, and the numbers of those that are taken."""
    if inside is None:
        return len(store), learning_episodes(store).tolist()
    episode, frame = decision_points(store, inside)
    chosen = key_points(store, episode, frame).nonzero().flatten().tolist() if key else range(len(frame))
    return len(frame), chosen


def starts_of(cfg: Cfg, begun: int, chosen: Sequence[int], extra: int) -> Starts:
    """Where imagined episodes begin: at the `chosen` ones of `begun` starts, and at the `extra` ones that
    stand after all of these.
    """
    share, shared = cfg["extra_starts"]["share"], cfg["simulator"]["shared_noise"]
    pool = shared_out(chosen, range(begun, begun + extra), share) if extra else chosen
    return Starts(pool, 0 if shared else begun + extra)


def worth_in(inputs: Inputs) -> dict[str, float]:
    """What imagined returns are worth by task, as the role `worth` has measured it; {} if nobody plays it."""
    if "worth" not in inputs.found:
        return {}
    return {task: float(one["value"]) for task, one in result_of(inputs.folder("worth"))["worth"].items()}


def by_worth(starts: Starts, tasks: Sequence[str], worth: Mapping[str, float]) -> tuple[Starts, float]:
    """Starts of which each task has a share as its imagined decisions are worth, and their mean worth, which
    weighs them all beside recorded ones: together each task's decisions weigh what they are worth.

    Args:
        tasks: of all start numbers.
        worth: by task; one that was not measured is worth the mean of the others.
    """
    mean = sum(worth.values()) / len(worth)
    each = [worth.get(tasks[start], mean) for start in starts.pool]
    return replace(starts, pool=weighed(starts.pool, each)), sum(each) / len(each)


def tasks_of_starts(cfg: Cfg, store: ClipStore, inside: Tensor | None, beyond: ClipStore | None) -> list[str]:
    """The task of each start number: of moments or episodes, then of the first frames beyond."""
    every = torch.arange(len(store)) if inside is None else inside
    tasks = dict(zip(every.tolist(), tasks_of_episodes(cfg, store, every), strict=True))
    begun = every if inside is None else decision_points(store, inside)[0]
    more = [] if beyond is None else tasks_of_first_frames(cfg, beyond)
    return [*(tasks[number] for number in begun.tolist()), *more]


def what_the_judge_needs(cfg: Cfg, fleet: Fleet | None) -> str:
    """What to change in a judge that lost most of the episodes that were lost; "" where it did not."""
    if fleet is None or 2 * fleet.ledger.dropped.get("judge", 0) <= fleet.ledger.lost:
        return ""
    kind: Any = target(cfg["judge"], "judge")
    return f". {kind.__name__}: {kind.remedy(cfg['judge'])}"


def nothing_left(settings: RLConfig, decisions: RecordedDecisions | None) -> list[str]:
    """An alarm where the algorithm's loss is on nothing, neither imagined nor recorded."""
    if settings.imagined or (decisions is not None and settings.recorded):
        return []
    return [
        "nothing but the anchor was learned from: rl.imagined=0 leaves imagined decisions out, and"
        " recorded ones need rl.recorded above 0, an algorithm with a critic (algorithm=ppo), a policy that"
        " is not scored on tokens, and labelled episodes of the deployed policy"
    ]


def _warm_up(
    cfg: Cfg, inputs: Inputs, policy: Any, algorithm: Algorithm, store: ClipStore, seed: int
) -> tuple[dict[str, float], TensorDict | None, RecordedDecisions | None]:
    """Let a critic, if the algorithm has one, learn from the deployed policies' true episodes first; one that
    begins from nothing spoils the first iterations. What it says of their decisions RL learns from, too.
    """
    past = recorded_episodes(store, deployed_in(inputs, "known"), cfg["rl"]["recorded_rounds"])
    past = past[torch.isin(past, learning_episodes(store)) & store.arrays["labelled"][past]]
    if not hasattr(algorithm, "warm_up") or not len(past):
        return {}, None, None
    rewards, judge, features = rewards_of(cfg), None, None
    if rewards.progress:  # to some judges every question costs
        judge, features = judge_of_recordings(cfg, inputs, store, past)
    rollout = dataset_rollout(policy, store, past, rewards, judge, features)
    rollout, knew = algorithm.warm_up(rollout, seed)
    if action_key(policy) != CHUNK:
        return {"critic_knew": knew}, rollout, None
    decisions = RecordedDecisions(policy, store, rollout, mode_of(cfg))
    figures = {"critic_knew": knew, "recorded_decisions": float(len(decisions))}
    return figures, rollout, decisions if len(decisions) else None


def recorded_episodes(store: ClipStore, deployed: int, rounds: int | None) -> Tensor:
    """Episodes that deployed policies played, int64 [N]: in the last `rounds` rounds up to that in which the
    policy was deployed that RL begins with; in all, those after it and those of explore too, if None.
    """
    if rounds is None:
        return store.select(["policy-*"])
    return store.select([f"policy-{number}" for number in range(max(0, deployed - rounds + 1), deployed + 1)])


@stage(reads=(*PHYSICS, *LEARNING))
def rl_in_physics(cfg: ConfigView, folder: Path, inputs: Inputs) -> dict[str, Any]:
    """The same algorithm in physics, from the first policy: a control of imagination.

    Settings: iterations; or episodes, after which it ends. What the last rollout plays beyond them is neither
    learned from nor counted.
    """
    prepare_process(cfg["seed"], cfg["threads"])
    episodes = inputs.settings.get("episodes")
    # every iteration begins rl.envs episodes at least
    iterations = inputs.settings["iterations"] if episodes is None else -(-episodes // cfg["rl"]["envs"])
    limits = {"iterations": iterations, "episodes": episodes}
    policy = build_policy(cfg, inputs.weights("policy"))
    lr = rl_rate(policy, cfg["rl"]["lr"])
    settings = rl_options(cfg, **limits, anchor=0.0, imagined=1.0, seed=cfg["seed"] * 100, lr=lr)
    if settings.freeze_perception:
        freeze_perception(policy)
    algorithm = build_algorithm(cfg, policy)
    recipe = Recipe(
        config=cfg.plain(),
        episodes=settings.envs // settings.shards,
        policy=str(inputs.weights("policy")),
        freeze_perception=settings.freeze_perception,
        bootstrap=algorithm.bootstraps,
    )
    pool = episode_seeds(cfg["seed"], Purpose.PRACTICE, 4 * settings.envs * iterations)
    fleet = build_fleet(recipe)
    try:
        watch = true_success(cfg, settings, inputs.weights("policy"))
        stats = train_rl(fleet, policy, algorithm, settings, folder, Starts(pool), watch=watch)
    finally:
        fleet.close()
    save_weights(policy, folder)
    stats.pop("last")
    return {**stats, "physics_episodes": {"own": stats["episodes"]}}
