"""The reinforcement-learning loop: collect whole episodes, let an algorithm turn them into updates, watch for
trouble.

Rollouts come from a fleet (actors/fleets): this process or any number of Ray actors, in any world of this
project; update.py learns from them. Every iteration starts fresh episodes and draws its randomness from
(seed, iteration), so a run resumed from its checkpoint repeats what it would have done, and so do any number
of actors. Of several workers that learn together (parallel.py), the first one has the fleet and shows the
others what came.
"""

from __future__ import annotations

import json
import os
import time
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from tqdm import tqdm

from actors.fleets.fleet import EpisodeLedger, Fleet
from actors.rollouts.host import Weights, trained_weights
from envs.rng import update_seed
from envs.targets import ConfigError
from learners.rl.alarms import Alarms
from learners.rl.algorithm import Algorithm, RLConfig, episode_counts, within
from learners.rl.feed import Feed, build_feed
from learners.rl.film import film_rollouts
from learners.rl.recorded.decisions import TrueExperience
from learners.rl.starts import Starts
from learners.rl.update import update
from learners.rl.watch import Watch
from learners.training.checkpoint import Checkpoints, adam_moments, buffers_of, truncate_log
from learners.training.interrupt import deferred_signals, leave
from learners.training.parallel import Trainee, from_leader, leads

# Why episodes spoil: by the ledger's reason the figure that counts them, and what happened.
_SPOILED = {
    "judge": ("dropped_by_judge", "a judge that gave no judgement"),
    "NaN actions": ("dropped_nan", "a policy that says NaN"),
    "physics": ("dropped_by_physics", "physics that crashes"),
}


def train_rl(
    fleet: Fleet | None,
    policy: TensorDictModuleBase,
    algorithm: Algorithm,
    config: RLConfig,
    folder: Path,
    starts: Starts,
    name: str = "rl",
    true: TrueExperience | None = None,
    watch: Watch | None = None,
) -> dict[str, Any]:
    """Improve `policy` in place.

    Args:
        fleet: hosts of config.envs / config.shards episodes each; the policy's trained tensors are published
            to it. Of several workers only the leading one has one; none where nothing is imagined
            (true.alone).
        starts: where episodes may begin.
        folder: receives checkpoints, metrics.jsonl and learned.jsonl, the jobs that were learned from, and
            as often as a checkpoint a video of imagined episodes; a checkpoint found there is resumed.
        true: what RLConfig.recorded and RLConfig.anchor speak of.
        watch: looks at the policy while it learns; its figures stand in metrics.jsonl, beside the seconds of
            rollouts and updates so far (time/learning), in which it does not count.

    Returns:
        Seconds spent, episodes used, alarms, the fleet's ledger, and the metrics of the last iteration.

    Raises:
        TrainingDiverged: on numbers that are not finite.
        FleetError: if too many episodes are lost. Whatever stops a rollout, a checkpoint of the iterations
            before it is written first.
        KeyboardInterrupt, SystemExit: after SIGINT and SIGTERM, once a checkpoint is written.
    """
    if fleet is not None:
        _check(fleet, algorithm, config)
    folder.mkdir(parents=True, exist_ok=True)
    checkpoints, log, learned = Checkpoints(folder), folder / "metrics.jsonl", folder / "learned.jsonl"
    trainee = Trainee(algorithm.modules(), apart=False)  # all that hosts must know is read between updates
    optimiser = torch.optim.Adam(algorithm.groups(config.lr), lr=config.lr, eps=1e-5)
    rates = [group["lr"] for group in optimiser.param_groups]
    alarms, ledger, first, episodes, wave, over = Alarms(), EpisodeLedger(), 0, 0, 0, False
    spent, figures = {"rollout": 0.0, "update": 0.0}, dict[str, float]()
    alone = true is not None and true.alone > 0

    def state() -> dict[str, Any]:
        return {
            "modules": trainee.parameters,
            "buffers": buffers_of(trainee.module),
            "optimiser": adam_moments(optimiser, trainee.trained),
        }

    if checkpoints.newest is not None:
        facts = checkpoints.load(state())
        assert facts is not None
        first, episodes, spent, wave = facts["iteration"], facts["episodes"], facts["spent"], facts["wave"]
        figures = facts["last"]
        alarms = Alarms(**facts["alarms"])
        ledger = EpisodeLedger(**facts["ledger"])
        ledger.drop("learner died", ledger.requested - ledger.learned - sum(ledger.dropped.values()))
        over = facts["over"]
    if leads():
        truncate_log(log, first)
        truncate_log(learned, first)

    def share_over(iteration: int) -> float:
        return iteration / config.iterations if config.episodes is None else episodes / config.episodes

    feed: Feed | None = None
    if fleet is not None:
        fleet.ledger = ledger
        feed = build_feed(fleet, algorithm, config, starts, wave)

    def gather(iteration: int, weights: Weights) -> tuple[TensorDict, dict[str, float]]:
        assert feed is not None, "only the leading worker is asked"
        return feed.gather(iteration, weights)

    def facts_of(iteration: int) -> dict[str, Any]:
        facts = {
            "iteration": iteration,
            "over": over,
            "episodes": episodes,
            "wave": 0 if feed is None else feed.upcoming(iteration),
            "spent": spent,
            "ledger": asdict(ledger),
            "alarms": asdict(alarms),
            "last": figures,
        }
        if feed is not None:
            facts["episodes_per_job"] = feed.fleet.episodes
        return facts

    bar = tqdm(
        total=config.iterations, initial=first, desc=name, unit="it", dynamic_ncols=True, disable=not leads()
    )
    nowhere = Path(os.devnull)
    with (
        (log if leads() else nowhere).open("a") as rows,
        (learned if leads() else nowhere).open("a") as jobs,
        deferred_signals() as stop_requested,
    ):
        for iteration in range(first, first if over else config.iterations):
            began = time.perf_counter()
            for group, lr in zip(optimiser.param_groups, rates, strict=True):
                group["lr"] = lr * (1 - share_over(iteration))
            before = facts_of(iteration)
            try:
                weights = trainee(trained_weights, policy)
                batch, supply = (None, {}) if alone else from_leader(partial(gather, iteration, weights))
            except Exception:
                # nothing was learned yet of this iteration, as where a judge's budget is used up; what was
                # learned before is kept, and what was lost is asked for again
                if iteration > first and iteration % config.checkpoint_every:
                    checkpoints.save(iteration, state(), before)
                raise
            collected = time.perf_counter()
            if batch is not None:
                if config.episodes is not None:
                    batch = within(batch, algorithm, config.episodes - episodes)
                starts.check_groups(batch, algorithm.group_size)
            seed = update_seed(config.seed, iteration)
            figures = update(batch, algorithm, trainee, optimiser, config, seed, true)
            updated = time.perf_counter()
            spent["rollout"] += collected - began
            spent["update"] += updated - collected
            if batch is not None:
                episodes += int(episode_counts(batch, algorithm).sum())
            last = iteration + 1 == config.iterations or share_over(iteration + 1) >= 1
            if batch is not None:
                spoiled = {reason: int(figures[key]) for reason, (key, _) in _SPOILED.items()}
                ledger.settle(len(batch), spoiled)
                if feed is not None:
                    causes = [what for reason, (_, what) in _SPOILED.items() if spoiled[reason]]
                    feed.check_losses(" and ".join(causes) or "none now")
            for version, shown in feed.footage.items() if feed is not None else ():
                film_rollouts(folder, version, shown)
            figures |= supply | {"time/rollout": collected - began, "time/update": updated - collected}
            figures["time/learning"] = sum(spent.values())
            enough = False
            if watch is not None and (last or watch.due(iteration, config.iterations)):
                weights = trainee(trained_weights, policy)
                seen, enough = from_leader(partial(watch.look, iteration, weights))
                figures |= seen
            if feed is not None:
                figures["time/actors_idle_share"] = max(
                    0.0, 1 - supply["time/actors_busy"] / (feed.fleet.size * (updated - began))
                )
                jobs.write(
                    json.dumps(
                        {
                            "step": iteration,
                            "jobs": [job for job, _ in feed.learned],
                            "versions": [version for _, version in feed.learned],
                        }
                    )
                    + "\n"
                )
                jobs.flush()
            alarms.check(figures, iteration)
            rows.write(
                json.dumps({"step": iteration, **{f"{name}/{k}": v for k, v in figures.items()}}) + "\n"
            )
            rows.flush()
            bar.update()
            if "success" in figures:
                bar.set_postfix_str(f"success {figures['success']:.2f}", refresh=False)
            if iteration == first and leads():
                tqdm.write(
                    f"{name}: about {(updated - began) * (config.iterations - first - 1) / 60:.1f} min for"
                    f" {config.iterations - first - 1} more iterations"
                )
            over = enough or last
            stop = from_leader(stop_requested)
            if (iteration + 1) % config.checkpoint_every == 0 or over or stop:
                checkpoints.save(iteration + 1, state(), facts_of(iteration + 1))
            if stop:
                bar.close()
                tqdm.write(
                    f"{name}: stopped after iteration {iteration}, as asked; the same command goes on from"
                    " there"
                )
                leave(stop)
            if over:
                break
    bar.close()
    trainee.release()
    # What was submitted ahead and never learned from is no loss, but it was asked for.
    ledger.drop("unused", ledger.requested - ledger.learned - sum(ledger.dropped.values()))
    return {
        **{f"{k}_seconds": v for k, v in spent.items()},
        "episodes": episodes,
        "alarms": alarms.raised,
        "ledger": asdict(ledger),
        "last": figures,
    }


def _check(fleet: Fleet, algorithm: Algorithm, config: RLConfig) -> None:
    if config.envs // config.shards != fleet.episodes:
        raise ConfigError(
            f"rl.envs={config.envs} in rl.shards={config.shards} jobs are {config.envs // config.shards}"
            f" episodes each, but the hosts hold {fleet.episodes}"
        )
    if fleet.episodes % algorithm.group_size:
        raise ConfigError(
            f"rl.envs / rl.shards = {fleet.episodes} must be a multiple of the {algorithm.group_size}"
            f" episodes that algorithm={algorithm.name} keeps together, or groups would be torn apart;"
            " change rl.envs"
        )
    if config.rewards_later and not algorithm.supports_delayed_reward:
        raise ConfigError(
            f"rl.rewards_later=true, but algorithm={algorithm.name} learns from every step as it was"
            " rewarded; use grpo or filtered_bc"
        )
