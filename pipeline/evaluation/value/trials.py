"""Tries candidates on equal starts, in imagination and in physics; what has been tried is not tried again.

Each part of a cell is a file of its own: true outcomes, which no simulator changes, and one repeat in
imagination. A file's name ends in a hash of all that its numbers depend on.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor
from torchrl.envs import TransformedEnv

from actors.factory import at_once, build_physics, build_pool
from actors.policies.recorded import Commands, RecordedActions
from actors.rollouts.evaluate import Outcome, evaluate
from envs.judges.base import counted
from envs.physics.env import PhysicsEnv
from envs.physics.pool import PoolError, TaskPool
from envs.physics.worker import Track
from envs.specs import IMAGE
from pipeline.evaluation.value.candidates import Candidate
from pipeline.graph.kept import Kept, Tensors

COUNT = "count/"  # before the names of what a judge counted, in what is kept


@dataclass
class Physics:
    """True outcomes of candidates from the starts of recorded episodes.

    Args:
        cfg: the resolved config.
        identity: what tells this physics from others.
        kept: where outcomes are kept.
        spread: float32 [A], see candidates.action_spread.
    """

    cfg: Mapping[str, Any]
    identity: Mapping[str, Any]
    kept: Kept
    spread: Tensor
    _env: PhysicsEnv | None = field(default=None, init=False)
    _pool: TaskPool | None = field(default=None, init=False)

    def outcome(self, candidate: Candidate, about: Mapping[str, Any], seeds: list[int]) -> Tensors:
        """success bool [N] from the starts of episodes with these seeds; of scripted experts also what they
        commanded, commands float32 [N, T, A] and length int64 [N].

        Args:
            about: what tells the candidate from others.
        """
        identity = {"physics": self.identity, "candidate": about, "seeds": seeds}
        make = self._scripted if candidate.expert is not None else self._acted
        return self.kept.get(f"true-{candidate.name}", identity, lambda: make(candidate, seeds))

    def strangeness(self, seeds: list[int], first: Tensor, where: Mapping[str, Any]) -> Tensor:
        """Mean absolute difference in grey levels, float32 [N, N], of recorded first frames uint8
        [N, V, 3, H, W] and of the pictures with which the episodes of N seeds begin.

        Args:
            where: what tells the recordings from others.
        """
        identity = {"physics": self.identity, **where, "seeds": seeds}
        return self.kept.get("starts", identity, lambda: self._compared(seeds, first))["off"]

    def _compared(self, seeds: list[int], first: Tensor) -> Tensors:
        env, seen = self._physics(len(seeds)), []
        for begin in range(0, len(seeds), env.batch_size[0]):
            part = seeds[begin : begin + env.batch_size[0]]
            env.schedule([*part, *[part[-1]] * (env.batch_size[0] - len(part))])
            seen.append(env.reset()[IMAGE][: len(part)])
        begun = torch.cat(seen).float()
        return {"off": torch.stack([(row.float() - begun).abs().flatten(1).mean(1) for row in first])}

    def _physics(self, seeds: int) -> PhysicsEnv:
        width = at_once(self.cfg, min(self.cfg["evaluate"]["envs"], seeds))
        if self._env is None or self._env.batch_size[0] != width:
            self._close_env()
            self._env = build_physics(self.cfg, width)
        return self._env

    def _acted(self, candidate: Candidate, seeds: list[int]) -> Tensors:
        env = self._physics(len(seeds))
        policy, stochastic = candidate.build(self.cfg, self.spread), self.cfg["policy_value"]["stochastic"]
        outcome = evaluate(env, policy, seeds, stochastic, f"true {candidate.name}")
        _check_all(
            candidate, seeds, [seed for seed, counted in zip(seeds, outcome.counted, strict=True) if counted]
        )
        return {"success": outcome.success}

    def _scripted(self, candidate: Candidate, seeds: list[int]) -> Tensors:
        self._pool = self._pool or build_pool(self.cfg)
        assert candidate.expert is not None
        jobs = [(seed, candidate.expert) for seed in seeds]
        tracks = self._pool.script(jobs, self.cfg["task"]["chunk"])
        _check_all(candidate, seeds, [track.seed for track in tracks])
        return scripted_outcomes(tracks)

    def close(self) -> None:
        """End the worker processes."""
        self._close_env()
        if self._pool is not None:
            self._pool.close()

    def _close_env(self) -> None:
        if self._env is not None:
            self._env.close()


def _check_all(candidate: Candidate, seeds: Sequence[int], known: Sequence[int]) -> None:
    """Refuse a value of which some episodes are unknown, for the imagined ones would stand beside others.

    Raises:
        PoolError: if physics crashed in one.
    """
    if crashed := sorted(set(seeds) - set(known)):
        raise PoolError(
            f"physics crashes again and again in the episodes of the seeds {crashed[:4]} under"
            f" {candidate.name}, so its true value on these starts is unknown; leave it out"
            " (policy_value.policies), or mend the suite"
        )


def scripted_outcomes(tracks: list[Track]) -> Tensors:
    """success, commands and length (see Physics.outcome) of scripted episodes."""
    rows = [track.stack() for track in tracks]
    length = torch.tensor([len(row["commands"]) for row in rows])
    commands = torch.zeros(len(rows), int(length.max()), rows[0]["commands"].shape[-1])
    for n, row in enumerate(rows):
        commands[n, : length[n]] = torch.from_numpy(row["commands"]).float()
    success = torch.tensor([bool(row["success"][-1]) for row in rows])
    return {"success": success, "commands": commands, "length": length}


@dataclass
class Imagination:
    """Judged outcomes of candidates in an imagined world that begins at N recorded first frames.

    Args:
        cfg: the resolved config.
        world: whose initial states those are.
        identity: what tells the world and its starts from others.
        kept: where outcomes are kept.
        spread: float32 [A], see candidates.action_spread.
    """

    cfg: Mapping[str, Any]
    world: TransformedEnv
    identity: Mapping[str, Any]
    kept: Kept
    spread: Tensor

    def outcome(
        self, candidate: Candidate, about: Mapping[str, Any], repeat: int, true: Tensors | None
    ) -> Tensors:
        """success and judged, bool [N] each, of one repeat, and what the judge counted meanwhile, int64 [].

        Args:
            about: what tells the candidate from others.
            true: of a scripted expert, whose commands are replayed: it cannot see generated frames.
        """
        identity = {"world": self.identity, "candidate": about, "repeat": repeat}
        name = f"imagined-{candidate.name}-{repeat}"
        return self.kept.get(name, identity, lambda: self._acted(candidate, repeat, true))

    def _acted(self, candidate: Candidate, repeat: int, true: Tensors | None) -> Tensors:
        base = self.world.base_env
        if candidate.expert is not None:
            assert true is not None
            commands = Commands(true["commands"], true["length"])
            policy: Any = RecordedActions(commands, base.spec, base.mode, lambda: base.elapsed)
        else:
            policy = candidate.build(self.cfg, self.spread)
        count, judge = len(base.starts), self.world.transform[-1].judge
        before = counted(judge)
        # seeds that differ by a multiple of the initial states' number begin alike and draw other noise
        seeds = list(range(repeat * count, (repeat + 1) * count))
        outcome: Outcome = evaluate(
            self.world,
            policy,
            seeds,
            self.cfg["policy_value"]["stochastic"],
            f"imagined {candidate.name}",
            sampling_seed=repeat,
        )
        told = {COUNT + name: torch.tensor(value - before[name]) for name, value in counted(judge).items()}
        return {"success": outcome.success, "judged": outcome.counted, **told}
