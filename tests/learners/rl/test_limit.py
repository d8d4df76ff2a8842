"""RL that may learn from so many episodes and no more, as where it is compared with deployments."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

import learners.rl.loop as module
from actors.fleets.fleet import LocalFleet
from actors.rollouts.host import Host
from envs.physics.toy_tracking import ToyTrackingEnv
from learners.rl.loop import train_rl
from learners.rl.starts import Starts
from tests.learners.rl.test_algorithms import Stop, algorithm_of, policy_of, rows_of, settings
from tests.sections import offered

EPISODES = 70


def run(name: str, folder: Path, **limits: int) -> tuple[dict[str, Any], dict[str, torch.Tensor]]:
    """What RL says, and its weights, in a task whose episodes often end early."""
    env = ToyTrackingEnv(8, actions=1, tolerance=0.5, success_steps=1, starts=4)
    policy, replica = (policy_of("chunk_gaussian", env.spec) for _ in range(2))
    algorithm = algorithm_of(name, policy, env.spec)
    fleet = LocalFleet(Host(env, replica, algorithm.bootstraps))
    plan = settings(checkpoint_every=1, epochs=1, **limits)
    try:
        stats = train_rl(fleet, policy, algorithm, plan, folder, Starts(range(4)))
    finally:
        fleet.close()
    return stats, {key: value.clone() for key, value in policy.state_dict().items()}


@pytest.mark.parametrize("name", offered("algorithm"))
def test_it_ends_with_its_episodes_and_its_rates_fall_by_their_share(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    original, rates, played, slots = module.update, list[float](), list[int](), list[int]()

    def seen(*args: Any) -> dict[str, float]:
        done = args[0]["next", "done"]
        slots.append(len(done))
        # PPO goes on with further episodes where one ends, the others learn from first ones alone
        played.append(int(done.sum() + (~done[:, -1]).sum()) if name == "ppo" else len(done))
        rates.append(args[3].param_groups[0]["lr"])
        return original(*args)

    monkeypatch.setattr(module, "update", seen)
    stats, _ = run(name, tmp_path, iterations=9, episodes=EPISODES)
    few = max(played) // 4 if name == "ppo" else 2  # of two slots, or of a group of four
    assert EPISODES <= stats["episodes"] == sum(played) <= EPISODES + few
    assert len(slots) < 9 if name == "ppo" else len(slots) == 9
    shares = [sum(played[:number]) / EPISODES for number in range(len(played))]
    assert rates == pytest.approx([1e-3 * (1 - share) for share in shares])
    ledger = stats["ledger"]
    assert ledger["learned"] == sum(slots) == ledger["requested"] - ledger["dropped"].get("unused", 0)


def test_killed_and_resumed_it_learns_from_the_same_episodes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    limits = {"iterations": 9, "episodes": EPISODES}
    whole, weights = run("ppo", tmp_path / "whole", **limits)
    original = module.update

    def failing(*args: Any) -> dict[str, float]:
        if len(rows_of(tmp_path / "cut")) == 1:
            raise Stop
        return original(*args)

    monkeypatch.setattr(module, "update", failing)
    with pytest.raises(Stop):
        run("ppo", tmp_path / "cut", **limits)
    monkeypatch.setattr(module, "update", original)
    resumed, again = run("ppo", tmp_path / "cut", **limits)
    assert resumed["episodes"] == whole["episodes"]
    assert rows_of(tmp_path / "cut") == rows_of(tmp_path / "whole")
    assert all(torch.equal(value, again[key]) for key, value in weights.items())
