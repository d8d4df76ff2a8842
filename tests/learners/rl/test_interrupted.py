"""A world that gives up in the middle of a rollout, as where a judge's budget is used up, costs no iteration
that was finished.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from tensordict import TensorDictBase

from actors.fleets.fleet import LocalFleet
from actors.rollouts.host import Host
from envs.physics.toy_tracking import ToyTrackingEnv
from learners.rl.loop import train_rl
from learners.rl.starts import Starts
from learners.training.checkpoint import Checkpoints
from tests.learners.rl.test_algorithms import algorithm_of, policy_of, rows_of, settings


class Exhausted(RuntimeError):
    """Stands for a budget that is used up."""


class Budgeted(ToyTrackingEnv):
    """ToyTrackingEnv that may be reset a number of times."""

    resets = 1000

    def _reset(self, tensordict: TensorDictBase | None = None, **more: Any) -> TensorDictBase:
        self.resets -= 1
        if self.resets < 0:
            raise Exhausted("judge.budget is used up")
        return super()._reset(tensordict, **more)


def test_a_rollout_that_fails_leaves_a_checkpoint_of_what_came_before(tmp_path: Path) -> None:
    def run(folder: Path, resets: int = 1000) -> tuple[list[dict[str, Any]], int]:
        env = Budgeted(4, actions=1, tolerance=0.15, starts=4)
        policy, replica = (policy_of("chunk_gaussian", env.spec) for _ in range(2))
        algorithm = algorithm_of("ppo", policy, env.spec)
        fleet, env.resets = LocalFleet(Host(env, replica, algorithm.bootstraps)), resets
        plan = settings(iterations=4, shards=2, checkpoint_every=5)
        try:
            stats = train_rl(fleet, policy, algorithm, plan, folder, Starts(range(4)))
        finally:
            fleet.close()
        assert stats["ledger"]["learned"] == stats["ledger"]["requested"] == 32
        return rows_of(folder), resets - env.resets

    whole, resets = run(tmp_path / "whole")
    with pytest.raises(Exhausted):
        run(tmp_path / "cut", resets=resets * 5 // 8)  # in the third of four iterations
    newest = Checkpoints(tmp_path / "cut").newest
    assert newest is not None and int(newest.name[-9:]) == len(rows_of(tmp_path / "cut")) > 1
    assert run(tmp_path / "cut")[0] == whole
