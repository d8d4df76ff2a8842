"""Who runs jobs: the contract that learners see, and the fleet of one that runs them in this process."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

from tensordict import TensorDict

from actors.rollouts.footage import Footage
from actors.rollouts.host import Host, Job, Stopwatch, Weights, size_of
from envs.ranges import Natural, Positive

HARMLESS = ("stale", "unused", "learner died")  # reasons to drop episodes that say nothing against the hosts


class FleetError(RuntimeError):
    """Collection cannot go on; the message says who failed, why, and what to change."""


@dataclass
class Result:
    """A finished job.

    Args:
        job: which.
        version: of the weights that acted.
        batch: the rollout [B, T]; None if the job was given up, for the reason in `failure`.
        seconds: the host was busy with it.
        load_seconds: of these, taking over new weights.
        forward_seconds: of these, inside the networks.
        bytes: that travelled.
        footage: of the episodes that the job asked to be shown.
        counted: see Host.counted.
    """

    job: Job
    version: int
    batch: TensorDict | None
    seconds: float = 0.0
    load_seconds: float = 0.0
    forward_seconds: float = 0.0
    bytes: int = 0
    failure: str = ""
    footage: tuple[Footage, ...] = ()
    counted: dict[str, int] = field(default_factory=dict)


@dataclass
class EpisodeLedger:
    """Episodes and why they were lost; `requested == learned + sum(dropped.values())` once a run has ended.

    Episodes of a job that is run again after its host died count in `rerun`: they were begun, nobody learned
    from them, and the same episodes came later.

    What the hosts' judges counted (Host.counted) stands in `judged`; a goal that several hosts imagine counts
    for each.
    """

    requested: int = 0
    learned: int = 0
    dropped: dict[str, int] = field(default_factory=dict)
    rerun: int = 0
    deaths: int = 0
    judged: dict[str, int] = field(default_factory=dict)

    def drop(self, reason: str, episodes: int) -> None:
        """Episodes that nobody will learn from."""
        if episodes:
            self.dropped[reason] = self.dropped.get(reason, 0) + episodes

    def count(self, judged: Mapping[str, int]) -> None:
        """What a judge counted in a job that has come back."""
        for name, number in judged.items():
            self.judged[name] = self.judged.get(name, 0) + number

    def settle(self, episodes: int, spoiled: Mapping[str, int]) -> None:
        """A rollout of so many episodes was learned from, but for those that something spoiled."""
        for reason, count in spoiled.items():
            self.drop(reason, count)
        self.learned += episodes - sum(spoiled.values())

    @property
    def lost(self) -> int:
        """Episodes dropped because something failed; not those that came too late or were not needed any
        more.
        """
        return sum(count for reason, count in self.dropped.items() if reason not in HARMLESS)


@dataclass(frozen=True)
class Patience:
    """How long the supervisor waits before it acts, in seconds, and how often it tries.

    Args:
        job: for a rollout.
        start: for a host to be built.
        retries: times a job that raised is tried again.
        stage: for a whole stage that runs elsewhere.
        rebuilds: times in a row and per host that building may raise before the run stops; being killed
            meanwhile counts a tenth.
        deaths: hosts that may die of one and the same job, or be replaced because of it, before the run
            stops.
    """

    job: Positive
    start: Positive
    stage: Positive
    retries: Natural
    rebuilds: Natural
    deaths: Natural


class Fleet(Protocol):
    """Runs jobs with the newest published weights."""

    ledger: EpisodeLedger
    size: int
    episodes: int

    def publish(self, version: int, weights: Weights) -> dict[str, float]:
        """Make weights known; jobs that begin from now on use them. Returns sync_bytes and sync_ms."""
        ...

    def submit(self, job: Job) -> None:
        """Queue a job."""
        ...

    def take(self) -> Result:
        """A finished job; waits for one.

        Raises:
            FleetError: if nobody is left to wait for.
        """
        ...

    def close(self) -> None:
        """Let go of all hosts."""
        ...


class LocalFleet:
    """One host in this process; a job runs when somebody takes its result, and its errors are raised as they
    are.

    Args:
        host: runs the jobs; closed with the fleet.
    """

    def __init__(self, host: Host):
        self.host, self.ledger, self.size = host, EpisodeLedger(), 1
        self.episodes = host.env.batch_size[0]
        self._queue: deque[Job] = deque()
        self._newest: tuple[int, Weights] = (-1, {})

    def publish(self, version: int, weights: Weights) -> dict[str, float]:
        """See Fleet.publish."""
        watch = Stopwatch()
        self._newest = (version, weights)
        return {"sync_bytes": float(size_of(weights)), "sync_ms": 1e3 * watch.read()}

    def submit(self, job: Job) -> None:
        """See Fleet.submit."""
        self._queue.append(job)

    def take(self) -> Result:
        """See Fleet.take."""
        if not self._queue:
            raise FleetError("nothing was submitted, so there is nothing to wait for")
        watch = Stopwatch()
        job, (version, weights) = self._queue.popleft(), self._newest
        if self.host.version != version:
            self.host.load(version, weights)
        loaded, forward = watch.read(), self.host.meter.seconds
        batch = self.host.run(job)
        seconds, forward = loaded + watch.read(), self.host.meter.seconds - forward
        host = self.host
        return Result(
            job, version, batch, seconds, loaded, forward, footage=host.footage, counted=host.counted
        )

    def close(self) -> None:
        """See Fleet.close."""
        self.host.close()
