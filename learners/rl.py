"""The reinforcement-learning loop: collect whole episodes, let an algorithm turn them into updates, watch for trouble.

Where a policy is updated: `update` below, by the losses of ppo.py, grpo.py and filtered_bc.py. Rollouts come from a
fleet (actors/fleet.py): this process or any number of Ray actors, in any world of this project. Every iteration starts
fresh episodes and draws its randomness from (seed, iteration), so a run resumed from its checkpoint repeats what it
would have done, and so do any number of actors.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Protocol

import torch
from tensordict import NestedKey, TensorDict
from torch import Tensor, nn
from tqdm import tqdm

from actors.fleet import Books, Fleet
from actors.policies.vla import ChunkPolicy
from actors.rollouts import trained_weights
from envs.schema import CHUNK, JUDGE_STATUS, LOG_PROB, SUCCESS, Status
from learners.feed import AsyncFeed, Feed
from learners.fit import TrainingDiverged, _truncate, save_atomic
from learners.interrupt import deferred_sigterm


@dataclass(frozen=True)
class RLConfig:
    """Options of the loop, shared by all algorithms.

    Args:
        iterations: rounds of collecting and updating.
        envs: episodes side by side over all hosts, and so the least number of episodes per iteration.
        shards: jobs an iteration is cut into, each of envs / shards episodes; results depend on this, not on who runs them.
        schedule: "sync" learns from rollouts of the newest policy only; "async" lets hosts run on meanwhile.
        max_policy_lag: versions a rollout may be behind, if async.
        queue: jobs submitted and not yet learned from at most, if async.
        max_dropped: share of all episodes that may be lost (dead judges, NaN actions) before the run stops.
        epochs: passes over each iteration's data.
        minibatch: transitions per update.
        lr: learning rate of the policy.
        clip: largest gradient norm.
        kl_stop: mean KL to the behaviour policy at which an iteration's epochs end early.
        anchor: weight of cloning what is known to have worked in physics (demonstrations and the policy's own true
            successes) beside the algorithm's loss; it keeps RL from wandering where only the simulator says it works.
        anchor_batch: frames of that per update.
        rewards_later: let rollouts go on without waiting for the judge, whose verdicts are filled in at their end.
        freeze_perception: train only what follows the policy's encoder, so that no picture is encoded twice.
        checkpoint_every: iterations between checkpoints.
        seed: of start frames, exploration and minibatches.
    """

    iterations: int = 40
    envs: int = 128
    shards: int = 1
    schedule: str = "sync"
    max_policy_lag: int = 2
    queue: int = 8
    max_dropped: float = 0.05
    epochs: int = 3
    minibatch: int = 256
    lr: float = 2e-4
    clip: float = 1.0
    kl_stop: float = 0.15
    anchor: float = 0.0
    anchor_batch: int = 96
    rewards_later: bool = False
    freeze_perception: bool = False
    checkpoint_every: int = 5
    seed: int = 0

    def __post_init__(self) -> None:
        if self.schedule not in ("sync", "async"):
            raise ValueError(f"schedule={self.schedule!r} must be sync or async")
        if self.envs % self.shards:
            raise ValueError(f"envs={self.envs} must be a multiple of shards={self.shards}")


class Algorithm(Protocol):
    """What tells algorithms apart; one file each.

    Attributes:
        name: in the config.
        bootstraps: whether it values next observations, so that rollouts must say what perception makes of them.
        patient: whether it learns from whole first episodes only, so that rewards may arrive after them.
        together: consecutive episodes that belong together, such as a group.
    """

    name: str
    bootstraps: bool
    patient: bool
    together: int

    def seeds(self, starts: int, envs: int, generator: torch.Generator) -> list[int]:
        """Episode seeds of one iteration, more than `envs` where early endings should be refilled."""
        ...

    def prepare(self, batch: TensorDict) -> tuple[TensorDict, dict[str, float]]:
        """Turn a rollout [B, T] into a flat set of transitions with everything `loss` needs."""
        ...

    def loss(self, minibatch: TensorDict) -> tuple[Tensor, dict[str, float]]:
        """Scalar loss of some transitions and figures to log."""
        ...

    def modules(self) -> nn.Module:
        """All that is trained, the policy included."""
        ...

    def groups(self, lr: float) -> list[dict[str, Any]]:
        """Parameter groups for the optimiser; `lr` is the policy's."""
        ...


class Anchor(Protocol):
    """Something with batches and a loss that is added to the algorithm's."""

    def sample(self, count: int, generator: torch.Generator) -> TensorDict:
        """A batch."""
        ...

    def loss(self, data: TensorDict, generator: torch.Generator) -> Tensor:
        """Its scalar loss."""
        ...


@dataclass
class Alarms:
    """Watches an RL run for the ways it goes wrong quietly.

    Args:
        patience: iterations in a row without reward variance before the alarm.
        kl: KL per iteration that counts as exploding.
        entropy_drop: fall of entropy (nats) from the first iteration that counts as collapse.
    """

    patience: int = 3
    kl: float = 0.5
    entropy_drop: float = 12.0
    silent: int = 0
    entropy: float | None = None
    raised: list[str] = field(default_factory=list)

    def check(self, figures: dict[str, float], iteration: int) -> None:
        """Look at one iteration's figures; warns once per kind, stops the run on numbers that are not finite."""
        bad = [key for key, value in figures.items() if not math.isfinite(value)]
        if bad:
            raise TrainingDiverged(f"rl: {bad} not finite at iteration {iteration}; lower rl.lr or raise algorithm clipping; the last checkpoint is kept")
        self.silent = self.silent + 1 if figures["reward_std"] < 1e-6 else 0
        if self.silent == self.patience:
            self._warn("no reward variance", iteration, "every episode scores the same; check the judge, or start from a policy that succeeds sometimes")
        if figures.get("kl", 0.0) > self.kl:
            self._warn("exploding KL", iteration, f"KL {figures['kl']:.3g} in one iteration; lower rl.lr or rl.epochs")
        if "entropy" in figures:
            self.entropy = figures["entropy"] if self.entropy is None else self.entropy
            if self.entropy - figures["entropy"] > self.entropy_drop:
                self._warn("collapsed entropy", iteration, "exploration is gone; raise algorithm.entropy or policy.std")

    def _warn(self, kind: str, iteration: int, advice: str) -> None:
        if kind not in [text.split(" at ")[0] for text in self.raised]:
            self.raised.append(f"{kind} at iteration {iteration}: {advice}")
            tqdm.write(f"ALARM rl: {self.raised[-1]}")


def first_episode(done: Tensor) -> Tensor:
    """Which steps [B, T] belong to the first episode of their slot, from done flags [B, T]."""
    before = torch.cat([torch.zeros_like(done[:, :1]), done[:, :-1]], 1)
    return before.long().cumsum(1) == 0


def judged(batch: TensorDict) -> Tensor:
    """Which steps [B, T] belong to episodes that no judge's error or abstention has spoiled."""
    if JUDGE_STATUS not in batch["next"].keys(True, True):
        return torch.ones(batch.shape, dtype=torch.bool, device=batch.device)
    bad = batch["next", JUDGE_STATUS].squeeze(-1) != Status.OK.value
    done = batch["next", "done"].squeeze(-1)
    spoiled = torch.zeros_like(bad)
    poison = torch.zeros_like(bad[:, 0])
    for t in reversed(range(batch.shape[1])):  # a bad verdict ends its episode, so it spoils what came before it
        poison = torch.where(done[:, t], bad[:, t], poison)
        spoiled[:, t] = poison
    return ~spoiled


def train_rl(
    fleet: Fleet,
    policy: ChunkPolicy,
    algorithm: Algorithm,
    config: RLConfig,
    folder: Path,
    starts: int | None = None,
    name: str = "rl",
    seed_pool: Sequence[int] | None = None,
    anchor: Anchor | None = None,
) -> dict[str, Any]:
    """Improve `policy` in place.

    Args:
        fleet: hosts of config.envs / config.shards episodes each; the policy's trained tensors are published to it.
        starts: number of start frames in imagination; None in physics, where `seed_pool` says which seeds may be used.
        folder: receives checkpoint.pt, metrics.jsonl and learned.jsonl, the jobs that were learned from; a checkpoint found there is resumed.
        anchor: what RLConfig.anchor speaks of.

    Returns:
        Seconds spent, episodes used, alarms, the fleet's books, and the metrics of the last iteration.

    Raises:
        TrainingDiverged: on numbers that are not finite.
        FleetError: if too many episodes are lost.
        SystemExit: after SIGTERM, once a checkpoint is written.
    """
    if config.envs // config.shards != fleet.episodes:
        raise ValueError(f"rl.envs={config.envs} in rl.shards={config.shards} jobs are {config.envs // config.shards} episodes each, but the hosts hold {fleet.episodes}")
    if fleet.episodes % algorithm.together:
        raise ValueError(f"rl.envs / rl.shards = {fleet.episodes} must be a multiple of algorithm.group={algorithm.together}, or groups would be torn apart")
    if config.rewards_later and not algorithm.patient:
        raise ValueError(f"rl.rewards_later=true, but algorithm={algorithm.name} learns from every step as it was rewarded; use grpo or filtered_bc")
    folder.mkdir(parents=True, exist_ok=True)
    checkpoint, log, learned = folder / "checkpoint.pt", folder / "metrics.jsonl", folder / "learned.jsonl"
    trained = algorithm.modules()
    optimiser = torch.optim.Adam(algorithm.groups(config.lr), lr=config.lr, eps=1e-5)
    alarms, first, episodes, wave = Alarms(), 0, 0, 0
    spent = {"rollout": 0.0, "update": 0.0}
    if checkpoint.exists():
        saved = torch.load(checkpoint, weights_only=True)
        trained.load_state_dict(saved["modules"])
        optimiser.load_state_dict(saved["optimiser"])
        first, episodes, spent = saved["iteration"], saved["episodes"], saved["spent"]
        alarms.entropy, alarms.silent, alarms.raised = saved["entropy"], saved["silent"], saved["raised"]
        books = fleet.books = Books(**saved["books"])
        books.drop("learner died", books.asked - books.learned - sum(books.dropped.values()))
        wave = saved["wave"]
        _truncate(log, first)
        _truncate(learned, first)

    def seeds(iteration: int) -> list[int]:
        pool = starts or len(seed_pool or ())
        drawn = algorithm.seeds(pool, config.envs, torch.Generator().manual_seed(config.seed * 1_000_003 + iteration))
        return drawn if seed_pool is None else [seed_pool[s % pool] for s in drawn]

    def sampling(iteration: int, shard: int) -> int:
        return config.seed * 7_919 + iteration + shard * 1_000_000_007

    common = (fleet, config.shards, seeds, sampling, lambda: trained_weights(policy), config.max_dropped, wave)
    feed = Feed(*common) if config.schedule == "sync" else AsyncFeed(*common, config.max_policy_lag, config.queue)
    bar = tqdm(total=config.iterations, initial=first, desc=name, unit="it", dynamic_ncols=True)
    figures: dict[str, float] = {}

    def save(iteration: int) -> None:
        state = {"modules": trained.state_dict(), "optimiser": optimiser.state_dict(), "iteration": iteration, "episodes": episodes, "spent": spent, "books": asdict(fleet.books)}
        state |= {"wave": feed.upcoming(iteration), "episodes_per_job": fleet.episodes}
        save_atomic({**state, "entropy": alarms.entropy, "silent": alarms.silent, "raised": alarms.raised}, checkpoint)

    with log.open("a") as rows, learned.open("a") as jobs, deferred_sigterm() as asked:
        for iteration in range(first, config.iterations):
            began = time.perf_counter()
            batch, supply = feed.gather(iteration)
            collected = time.perf_counter()
            # Minibatches are drawn by the iteration alone, whatever collecting has used up.
            figures = update(batch, algorithm, optimiser, config, torch.Generator().manual_seed(config.seed * 2_000_003 + iteration), anchor)
            updated = time.perf_counter()
            spent["rollout"] += collected - began
            spent["update"] += updated - collected
            done = batch["next", "done"]
            episodes += int(done.sum() + (~done[:, -1]).sum())
            fleet.books.drop("judge", int(figures["dropped_by_judge"]))
            fleet.books.learned += len(batch) - int(figures["dropped_by_judge"])
            figures |= supply | {"time/rollout": collected - began, "time/update": updated - collected}
            figures["time/actors_idle_share"] = max(0.0, 1 - supply["time/actors_busy"] / (fleet.size * (updated - began)))
            alarms.check(figures, iteration)
            rows.write(json.dumps({"step": iteration, **{f"{name}/{k}": v for k, v in figures.items()}}) + "\n")
            rows.flush()
            jobs.write(json.dumps({"step": iteration, "jobs": [job for job, _ in feed.learned], "versions": [version for _, version in feed.learned]}) + "\n")
            jobs.flush()
            bar.update()
            bar.set_postfix_str(f"success {figures['success']:.2f}", refresh=False)
            if iteration == first:
                tqdm.write(f"{name}: about {(updated - began) * (config.iterations - first - 1) / 60:.1f} min for {config.iterations - first - 1} more iterations")
            if (iteration + 1) % config.checkpoint_every == 0 or asked():
                save(iteration + 1)
            if asked() and iteration + 1 < config.iterations:
                bar.close()
                tqdm.write(f"{name}: SIGTERM; stopped after iteration {iteration}, the same command goes on from there")
                raise SystemExit(143)
    bar.close()
    checkpoint.unlink(missing_ok=True)
    books = fleet.books
    # What was submitted ahead and never learned from is no loss, but it was asked for.
    books.drop("unused", books.asked - books.learned - sum(books.dropped.values()))
    return {**{f"{k}_seconds": v for k, v in spent.items()}, "episodes": episodes, "alarms": alarms.raised, "books": asdict(books), "last": figures}


def update(
    batch: TensorDict, algorithm: Algorithm, optimiser: torch.optim.Optimizer, config: RLConfig, generator: torch.Generator, anchor: Anchor | None = None
) -> dict[str, float]:
    """One iteration's optimisation on a rollout [B, T]; returns its figures."""
    done, success = batch["next", "done"].squeeze(-1), batch["next", SUCCESS].squeeze(-1)
    mine, fine = first_episode(done), judged(batch)
    reward = (batch["next", "reward"].squeeze(-1) * mine).sum(1)
    kept = fine[:, 0]
    figures = {
        "success": float((success & mine).any(1)[kept].float().mean()) if kept.any() else 0.0,
        "return": float(reward[kept].mean()) if kept.any() else 0.0,
        "reward_std": float(reward[kept].std(unbiased=False)) if kept.any() else 0.0,
        "dropped_by_judge": float((~kept).sum()),
    }
    data, extra = algorithm.prepare(batch)
    figures |= extra
    trained = [p for group in optimiser.param_groups for p in group["params"]]
    sums: dict[str, float] = {}
    count, stopped = 0, False
    for _ in range(config.epochs):
        order = torch.randperm(len(data), generator=generator)
        for pick in order.split(config.minibatch):
            if len(pick) < 16 and len(data) >= 16:
                continue
            loss, parts = algorithm.loss(data[pick])
            if parts.get("kl", 0.0) > config.kl_stop:
                stopped = True
                break
            if anchor is not None and config.anchor:
                pull = anchor.loss(anchor.sample(config.anchor_batch, generator), generator)
                loss = loss + config.anchor * pull
                parts["anchor"] = float(pull.detach())
            optimiser.zero_grad(set_to_none=True)
            loss.backward()
            norm = nn.utils.clip_grad_norm_(trained, config.clip)
            if not torch.isfinite(norm):
                raise TrainingDiverged(f"rl: gradient norm {float(norm)}; lower rl.lr; the last checkpoint is kept")
            optimiser.step()
            for key, value in {**parts, "grad_norm": float(norm), "loss": float(loss.detach())}.items():
                sums[key] = sums.get(key, 0.0) + value
            count += 1
        if stopped:
            break
    figures |= {key: value / max(1, count) for key, value in sums.items()}
    return figures | {"updates": float(count), "transitions": float(len(data))}


def transitions(batch: TensorDict, keep: Tensor, keys: Iterable[NestedKey], **extra: Tensor) -> TensorDict:
    """The flat set of kept steps: what losses read by key, chunk and behaviour log-probability, plus tensors [B, T, ...] by name."""
    flat = keep.reshape(-1).nonzero().squeeze(-1)
    source = {key: batch[key].flatten(0, 1)[flat] for key in (*keys, CHUNK, LOG_PROB)}
    out = TensorDict(source, [len(flat)])
    for key, value in extra.items():
        out[key] = value.flatten(0, 1)[flat]
    return out
