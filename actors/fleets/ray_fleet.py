"""Hosts as Ray actors under a supervisor of our own.

Why not TorchRL's RayCollector: it does not survive faults. In sync mode one dead actor shuts all of it down;
with max_restarts every weight sync after a restart fails; with a replay buffer its thread dies unnoticed and
the learner waits for ever. Here a job is a pure function of weights, seeds and exploration seed
(rollouts.py), so a host that died is replaced and its job run again by anybody, with the same result;
TorchRL's Collector works inside each host.

The supervisor is one thread in the learner's process. It hands out jobs, watches deadlines, rebuilds what
died and keeps what came back; the learner only submits and takes.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from typing import Any

import ray
from ray.exceptions import (
    GetTimeoutError,
    ObjectStoreFullError,
    OutOfDiskError,
    RayActorError,
    RayError,
    RayTaskError,
)
from tqdm import tqdm

from actors.fleets.fleet import EpisodeLedger, FleetError, Patience, Result
from actors.fleets.host_actor import HostActor, Member
from actors.rollouts.host import Job, Stopwatch, Weights, size_of, unpack
from actors.rollouts.recipe import Recipe
from envs.judges.base import JudgeError
from envs.targets import options


class RayFleet:
    """See the module's docstring; a Fleet.

    Args:
        recipe: what every host is built from.
        actors: how many.
        resources: options of the actors, such as num_cpus and num_gpus.
        patience: deadlines and retries; those of launch.patience if not given.
        attached: further actors that end with the fleet, such as the judge service.
    """

    def __init__(
        self,
        recipe: Recipe,
        actors: int,
        resources: dict[str, Any] | None = None,
        patience: Patience | None = None,
        attached: tuple[Any, ...] = (),
    ):
        self.ledger, self.size, self.episodes = EpisodeLedger(), actors, recipe.episodes
        section = recipe.config["launch"]["patience"]
        self.patience = patience or options(Patience, section, "launch.patience")
        self._recipe, self._resources = recipe.plain(), dict(resources or {"num_cpus": 1})
        self._attached = attached
        self._actor_class: Any = ray.remote(HostActor)
        self._queue: deque[Job] = deque()
        self._done: deque[Result] = deque()
        self._tries: dict[int, int] = {}
        self._deaths: dict[int, int] = {}
        self._newest: tuple[int, Any] = (-1, None)
        self._failed_builds = 0.0
        self._count = 0
        self._error: FleetError | None = None
        self._closing = False
        self._changed = threading.Condition()
        self.finished = 0  # jobs that came through
        self.recoveries: list[float] = []  # seconds from a death being seen to its replacement being ready
        self._lost_at: deque[float] = deque()
        self._members = [self._build() for _ in range(actors)]
        self._thread = threading.Thread(target=self._supervise, name="fleet", daemon=True)
        self._thread.start()

    # -- the learner's side
    def publish(self, version: int, weights: Weights) -> dict[str, float]:
        """See Fleet.publish."""
        watch = Stopwatch()
        try:
            ref = ray.put(weights)
        except (ObjectStoreFullError, OutOfDiskError) as error:
            raise FleetError(
                f"the object store is full ({type(error).__name__}); raise launch.object_store_mb, free disk"
                " space for what Ray spills, or lower rl.queue and rl.envs"
            ) from error
        with self._changed:
            if version < self._newest[0]:
                raise ValueError(
                    f"weights of version {version} were published after version {self._newest[0]}; versions"
                    " only grow"
                )
            self._newest = (version, ref)
        return {"sync_bytes": float(size_of(weights)), "sync_ms": 1e3 * watch.read()}

    def submit(self, job: Job) -> None:
        """See Fleet.submit."""
        with self._changed:
            self._queue.append(job)
            self._changed.notify_all()

    def take(self) -> Result:
        """See Fleet.take."""
        with self._changed:
            while not self._done:
                if self._error is not None:
                    raise self._error
                if not self._queue and not any(m.job for m in self._members):
                    raise FleetError("nothing was submitted, so there is nothing to wait for")
                self._changed.wait(1.0)
            return self._done.popleft()

    def resize(self, actors: int) -> None:
        """Add or remove hosts while running; a removed host's job is run by another."""
        if actors < 1:
            raise ValueError("a fleet needs at least one host; close() ends it")
        with self._changed:
            while len(self._members) < actors:
                self._members.append(self._build())
            while len(self._members) > actors:
                idle = [m for m in self._members if m.job is None]
                self._retire((idle or self._members)[-1], "removed")
            self.size = actors
            self._changed.notify_all()

    @property
    def processes(self) -> list[int]:
        """Process ids of the hosts that are built."""
        return [member.pid for member in list(self._members) if member.built]

    def kill(self, number: int) -> None:
        """Kill one host, busy or not, as a fault would; for chaos tests."""
        with self._changed:
            ray.kill(self._members[number % len(self._members)].actor, no_restart=True)

    def kill_attached(self) -> None:
        """Kill what is attached, such as the judge service, which Ray then restarts; for chaos tests."""
        for actor in self._attached:
            ray.kill(actor, no_restart=False)

    def close(self) -> None:
        """See Fleet.close."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        self._thread.join(timeout=30)
        for actor in (*(member.actor for member in self._members), *self._attached):
            ray.kill(actor, no_restart=True)
        self._members.clear()

    # -- the supervisor's side
    def _build(self) -> Member:
        actor = self._actor_class.options(max_restarts=0, **self._resources).remote(self._recipe)
        self._count += 1
        return Member(self._count, actor, actor.ready.remote(), time.monotonic())

    def _supervise(self) -> None:
        try:
            while not self._closing:
                with self._changed:
                    self._hand_out()
                    refs = [m.ref for m in self._members if m.ref is not None]
                    if not refs:
                        self._changed.wait(0.2)
                        continue
                ready, _ = ray.wait(refs, num_returns=1, timeout=0.05)
                with self._changed:
                    for member in [m for m in self._members if m.ref in ready]:
                        self._finish(member)
                    self._check_deadlines()
                    self._changed.notify_all()
        except FleetError as error:
            self._stop(error)
        except Exception as error:  # whatever it is, the learner must hear of it instead of waiting for ever
            self._stop(FleetError(f"the supervisor failed: {type(error).__name__}: {error}"))

    def _stop(self, error: FleetError) -> None:
        with self._changed:
            self._error = error
            self._changed.notify_all()

    def _hand_out(self) -> None:
        version, weights = self._newest
        if weights is None:
            return
        for member in self._members:
            if self._queue and member.built and member.job is None:
                member.job, member.version, member.since = self._queue.popleft(), version, time.monotonic()
                member.ref = member.actor.run.remote(member.job, version, [weights])

    def _finish(self, member: Member) -> None:
        ref, member.ref = member.ref, None
        try:
            value = ray.get(ref, timeout=self.patience.job)
        except RayTaskError as error:  # our code raised; the host itself lives
            self._raised(member, error)
        except (RayActorError, GetTimeoutError, RayError) as error:
            self._died(member, error)
        else:
            if not member.built:
                member.pid, self._failed_builds = value, 0.0
                if self._lost_at:
                    self.recoveries.append(time.monotonic() - self._lost_at.popleft())
                return
            arrays, facts = value
            assert member.job is not None
            result = Result(member.job, member.version, unpack(arrays), bytes=size_of(arrays), **facts)
            self._done.append(result)
            self.finished += 1
            for counts in (self._tries, self._deaths):
                counts.pop(member.job.number, None)
            member.job = None

    def _raised(self, member: Member, error: RayTaskError) -> None:
        job, member.job = member.job, None
        if job is None:  # the host could not be built
            self._died(member, error)
            return
        if isinstance(error.cause, JudgeError):
            raise FleetError(str(error.cause))
        tries = self._tries[job.number] = self._tries.get(job.number, 0) + 1
        if tries <= self.patience.retries:
            self._queue.appendleft(job)
            return
        cause = error.cause
        self._done.append(Result(job, member.version, None, failure=f"{type(cause).__name__}: {cause}"))

    def _died(self, member: Member, error: Exception) -> None:
        if not member.built:
            # Our own code that raises will raise again; a process that was killed while it began had bad
            # luck.
            self._failed_builds += 1.0 if "creation task" in str(error) else 0.1
            if self._failed_builds >= self.patience.rebuilds * max(1, len(self._members)):
                raise FleetError(f"hosts cannot be built, time after time; the last time: {_root(error)}")
        else:
            self._lost_at.append(time.monotonic())
        doing = (
            f"ran job {member.job.number}"
            if member.job
            else "was being built"
            if not member.built
            else "was idle"
        )
        tqdm.write(f"fleet: host {member.number} died while it {doing}: {_root(error)}; building another")
        self.ledger.deaths += 1
        if member.job is not None:
            self._survivable(member.job.number, error)
        place = self._members.index(member)
        self._requeue(member)
        self._members[place] = self._build()

    def _survivable(self, job: int, error: Exception) -> None:
        """Chance kills a host or two; a job that ends whoever runs it would be run for ever."""
        deaths = self._deaths[job] = self._deaths.get(job, 0) + 1
        if deaths > self.patience.deaths:
            raise FleetError(
                f"job {job} ended {deaths} hosts (launch.patience.deaths={self.patience.deaths}), the last:"
                f" {_root(error)}. Hosts that run out of memory want a lower rl.envs or more rl.shards, slow"
                " ones a longer launch.patience.job"
            )

    def _requeue(self, member: Member) -> None:
        if member.job is not None:
            self.ledger.rerun += self.episodes
            self._queue.appendleft(member.job)
            member.job = None

    def _retire(self, member: Member, why: str) -> None:
        ray.kill(member.actor, no_restart=True)
        self._requeue(member)
        self._members.remove(member)
        tqdm.write(f"fleet: host {member.number} {why}")

    def _check_deadlines(self) -> None:
        now = time.monotonic()
        for member in list(self._members):
            limit = self.patience.job if member.built else self.patience.start
            if member.ref is None or now - member.since <= limit:
                continue
            what = (
                f"job {member.job.number}" if member.job else "being built (are there resources left for it?)"
            )
            tqdm.write(
                f"fleet: the learner waits for host {member.number}, {what}, for {now - member.since:.0f} s,"
                " over launch.patience; it is replaced"
            )
            ray.kill(member.actor, no_restart=True)
            self._died(member, TimeoutError(f"no answer in {limit:g} s"))


def _root(error: Exception) -> str:
    cause = getattr(error, "cause", None) or error
    return f"{type(cause).__name__}: {str(cause).strip().splitlines()[-1] if str(cause).strip() else ''}"
