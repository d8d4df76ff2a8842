"""A Host in a Ray actor, and what its supervisor keeps in mind of it."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any

import ray
from ray.actor import ActorHandle

from actors.rollouts.host import Host, Job, Stopwatch, Weights, pack
from actors.rollouts.recipe import build_host_process


class HostActor:
    """A Host in a Ray actor; see rollouts.Host."""

    def __init__(self, recipe: dict[str, Any]):
        self.host: Host = build_host_process(recipe)

    def ready(self) -> int:
        """This process's id, once built."""
        return os.getpid()

    def run(self, job: Job, version: int, weights: list[Any]) -> tuple[Weights, dict[str, Any]]:
        """The rollout's arrays, and by name what else a Result says; `weights` holds a reference, fetched
        only if needed.
        """
        watch = Stopwatch()
        if self.host.version != version:
            self.host.load(version, ray.get(weights[0]))
        loaded, forward = watch.read(), self.host.meter.seconds
        arrays = pack(self.host.run(job))
        return arrays, {
            "seconds": loaded + watch.read(),
            "load_seconds": loaded,
            "forward_seconds": self.host.meter.seconds - forward,
            "footage": self.host.footage,
            "counted": self.host.counted,
        }


@dataclass
class Member:
    """One host: an actor that is being built or works on a job or waits for one."""

    number: int
    actor: ActorHandle
    ref: Any
    since: float
    job: Job | None = None
    version: int = -1
    pid: int = 0

    @property
    def built(self) -> bool:
        return self.pid != 0
