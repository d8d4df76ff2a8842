"""How rollouts reach the learner: all of one version, or as they come within a bounded lag.

Synchronous: every iteration publishes, runs its jobs, joins them in order; any fleet gives the same bits.
Asynchronous: jobs run on while the learner updates. What was submitted and not yet learned from is the one
bounded buffer, and the only place where a policy can grow old; a job's rollout, and so a GRPO group, is of
one version.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from tensordict import TensorDict

from actors.fleets.fleet import Fleet, FleetError, Result
from actors.rollouts.footage import Footage
from actors.rollouts.host import Job, Stopwatch, Weights
from envs.rng import iteration_generator, sampling_seed
from envs.targets import ConfigError
from learners.rl.algorithm import Algorithm, RLConfig
from learners.rl.starts import Starts

SHOWN = 6  # episodes


@dataclass
class Feed:
    """Rollouts of a fleet, iteration by iteration.

    Args:
        fleet: runs the jobs.
        shards: jobs per iteration.
        seeds: episode seeds of an iteration's number, shared out to its jobs in order.
        sampling: exploration seed of a job's iteration and place in it.
        max_dropped: share of the episodes asked for that may be lost before the run stops.
        first: wave of jobs to begin with; the waves of a synchronous feed are its iterations.
        shown_every: iterations between those of which some episodes are shown to people; 0 for none.

    Attributes:
        footage: what the last rollout shows, by the version of the weights that acted.
    """

    fleet: Fleet
    shards: int
    seeds: Callable[[int], list[int]]
    sampling: Callable[[int, int], int]
    max_dropped: float = 0.05
    first: int = 0
    shown_every: int = 0
    idle: float = field(default=0.0, init=False)
    # jobs of the last rollout, and their versions
    learned: list[tuple[int, int]] = field(default_factory=list, init=False)
    footage: dict[int, tuple[Footage, ...]] = field(default_factory=dict, init=False)

    def jobs(self, iteration: int) -> list[Job]:
        """The jobs of an iteration; consecutive seeds stay together, so groups are never torn apart."""
        seeds = self.seeds(iteration)
        part, rest = divmod(len(seeds), self.shards)
        if rest:
            raise ValueError(
                f"{len(seeds)} episode seeds cannot be shared out to rl.shards={self.shards} evenly"
            )
        due = self.shown_every and iteration % self.shown_every == 0
        return [
            Job(
                iteration * self.shards + k,
                tuple(seeds[k * part : (k + 1) * part]),
                self.sampling(iteration, k),
                min(part, SHOWN) if due and k == 0 else 0,
            )
            for k in range(self.shards)
        ]

    def gather(self, iteration: int, weights: Weights) -> tuple[TensorDict, dict[str, float]]:
        """The rollout [B, T] of an iteration that begins with these weights, and figures; those that no two
        runs share are named time/*.
        """
        sync = self.fleet.publish(iteration, weights)
        for job in self.jobs(iteration):
            self._submit(job)
        results = [self._take() for _ in range(self.shards)]
        return self._join(results, iteration, sync)

    def upcoming(self, iteration: int) -> int:
        """The wave of jobs that a run resumed after `iteration` iterations begins with; what was under way is
        lost with the learner, and counted.
        """
        return iteration

    def _submit(self, job: Job) -> None:
        self.fleet.ledger.requested += self.fleet.episodes
        self.fleet.submit(job)

    def _take(self) -> Result:
        watch = Stopwatch()
        result = self.fleet.take()
        self.idle += watch.read()
        self.fleet.ledger.count(result.counted)
        return result

    def _given_up(self, result: Result) -> None:
        self.fleet.ledger.drop(result.failure.split(":")[0], self.fleet.episodes)
        self.check_losses(result.failure)

    def check_losses(self, last: str) -> None:
        """Stop where too many episodes are lost.

        Raises:
            FleetError: with the ledger, and the `last` cause.
        """
        ledger = self.fleet.ledger
        if ledger.lost > self.max_dropped * max(ledger.requested, 20 * self.fleet.episodes):
            raise FleetError(
                f"{ledger.lost} of {ledger.requested} episodes were lost ({ledger.dropped}), more than"
                f" rl.max_dropped={self.max_dropped}; the last: {last}"
            )

    def _join(
        self, results: list[Result], iteration: int, sync: dict[str, float]
    ) -> tuple[TensorDict, dict[str, float]]:
        good = sorted((r for r in results if r.batch is not None), key=lambda r: r.job.number)
        for result in results:
            if result.batch is None:
                self._given_up(result)
        if not good:
            raise FleetError(f"no job of iteration {iteration} came through; the last: {results[-1].failure}")
        self.learned = [(r.job.number, r.version) for r in good]
        self.footage = {r.version: r.footage for r in good if r.footage}
        batch = torch.cat([r.batch for r in good if r.batch is not None])
        lag = [iteration - r.version for r in good]
        busy = sum(r.seconds for r in good)
        figures = {
            "sync_bytes": sync["sync_bytes"],
            "wire_bytes": float(sum(r.bytes for r in good)),
            "policy_lag": sum(lag) / len(lag),
            "policy_lag_max": float(max(lag)),
        }
        clock = {
            "time/sync_ms": sync["sync_ms"],
            "time/load_ms": 1e3 * sum(r.load_seconds for r in good),
            "time/actors_busy": busy,
            "time/forward_share": sum(r.forward_seconds for r in good) / max(busy, 1e-9),
            "time/learner_idle": self._idle(),
        }
        return batch, figures | clock

    def _idle(self) -> float:
        seconds, self.idle = self.idle, 0.0
        return seconds


@dataclass
class AsyncFeed(Feed):
    """Rollouts as they come.

    Args:
        max_lag: versions by which a rollout may be behind the learner when it is learned from; older ones are
            dropped.
        queue: jobs that may be submitted and not yet learned from.
    """

    max_lag: int = 2
    queue: int = 8
    _waiting: int = field(default=0, init=False)
    _next: list[Job] = field(default_factory=list, init=False)
    _wave: int = field(default=0, init=False)

    def __post_init__(self) -> None:
        self._wave = self.first
        if self.queue < self.shards:
            raise ConfigError(
                f"rl.queue={self.queue} must hold at least the rl.shards={self.shards} jobs of one iteration"
            )

    def gather(self, iteration: int, weights: Weights) -> tuple[TensorDict, dict[str, float]]:
        """The next rollouts that are young enough, whichever they are."""
        sync = self.fleet.publish(iteration, weights)
        fresh: list[Result] = []
        while len(fresh) < self.shards:
            self._fill()
            result = self._take()
            self._waiting -= 1
            if result.batch is None:
                self._given_up(result)
            elif iteration - result.version > self.max_lag:
                self.fleet.ledger.drop("stale", self.fleet.episodes)
            else:
                fresh.append(result)
        depth = float(self._waiting)
        self._fill()  # work for the hosts while the learner updates
        batch, figures = self._join(fresh, iteration, sync)
        return batch, figures | {"queue_depth": depth}

    def upcoming(self, iteration: int) -> int:
        """See Feed.upcoming; jobs that were submitted ahead are not asked for again, or some would be learned
        from twice.
        """
        return self._wave

    def _fill(self) -> None:
        while self._waiting < self.queue:
            if not self._next:
                self._next, self._wave = self.jobs(self._wave), self._wave + 1
            self._submit(self._next.pop(0))
            self._waiting += 1


def build_feed(fleet: Fleet, algorithm: Algorithm, config: RLConfig, starts: Starts, first: int = 0) -> Feed:
    """The feed of `config.schedule`, whose jobs draw their starts and exploration from (seed, iteration)."""

    def seeds(iteration: int) -> list[int]:
        generator = iteration_generator(config.seed, iteration)
        return starts.seeds(algorithm.seeds(len(starts.pool), config.envs, generator), iteration)

    def sampling(iteration: int, shard: int) -> int:
        return sampling_seed(config.seed, iteration, shard)

    common = (fleet, config.shards, seeds, sampling, config.max_dropped, first, config.checkpoint_every)
    if config.schedule == "sync":
        return Feed(*common)
    return AsyncFeed(*common, config.max_policy_lag, config.queue)
