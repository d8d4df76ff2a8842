"""Any number of Ray actors give the bits that one process gives, and whatever dies is replaced."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import ray
import torch
from tensordict import TensorDict

from actors.factory import build_algorithm, build_policy
from actors.fleets.cluster import Plan, connect
from actors.fleets.fleet import Fleet, FleetError, LocalFleet, Patience
from actors.fleets.launch import build_fleet
from actors.fleets.ray_fleet import RayFleet
from actors.rollouts.host import Job, pack, trained_weights, unpack
from actors.rollouts.recipe import Recipe, build_host
from envs.targets import ConfigError, options
from learners.rl.algorithm import RLConfig
from learners.rl.loop import train_rl
from learners.rl.starts import Starts
from tests.sampling import those


@pytest.fixture(scope="module")
def cluster(cfg: dict[str, Any]) -> Iterator[None]:
    connect(cfg["launch"])
    yield
    ray.shutdown()


def patience(recipe: Recipe, **changes: Any) -> Patience:
    """launch.patience with some of it changed."""
    return options(Patience, {**recipe.config["launch"]["patience"], **changes}, "launch.patience")


def learn(
    fleet: Fleet, recipe: Recipe, folder: Path, **changes: Any
) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    cfg = recipe.config
    policy = build_policy(cfg, Path(recipe.policy))
    policy.freeze_perception()
    torch.manual_seed(3)
    smoke = {"checkpoint_every": 1, "iterations": 2, "envs": 16, "shards": 4, "epochs": 1, "minibatch": 32}
    own = {**cfg["rl"], "microbatches": 1, "seed": 0, "freeze_perception": True, **smoke, **changes}
    settings = options(RLConfig, own, "rl")
    stats = train_rl(fleet, policy, build_algorithm(cfg, policy), settings, folder, Starts(range(8)))
    return {name: value.clone() for name, value in policy.state_dict().items()}, stats


def rollout(fleet: Fleet, recipe: Recipe) -> list[TensorDict]:
    policy = build_policy(recipe.config, Path(recipe.policy))
    policy.freeze_perception()
    fleet.publish(0, trained_weights(policy))
    for number in range(4):
        fleet.submit(Job(number, tuple(range(12 * number, 12 * number + 12)), 100 + number))
    results = sorted((fleet.take() for _ in range(4)), key=lambda r: r.job.number)  # type: ignore[union-attr]
    return [r.batch for r in results if r is not None and r.batch is not None]


def films_of(folder: Path) -> dict[str, bytes]:
    """What hosts imagined, by the names of videos."""
    return {path.name: path.read_bytes() for path in sorted(folder.glob("media/*"))}


def equal(one: TensorDict, other: TensorDict) -> bool:
    return all(torch.equal(value, other[key]) for key, value in one.items(True, True)) and set(
        one.keys(True, True)
    ) == set(other.keys(True, True))


@pytest.mark.parametrize("actors", those([2], [1, 2, 3]))
def test_rollouts_and_learned_weights_are_the_same_bits_for_any_number_of_actors(
    cluster: None, recipe: Recipe, tmp_path: Path, actors: int
) -> None:
    local = LocalFleet(build_host(recipe))
    wanted = rollout(local, recipe)
    before = torch.get_num_threads()
    torch.set_num_threads(before + 1)  # whatever a process computes with, its jobs take rl.threads
    assert all(equal(a, b) for a, b in zip(wanted, rollout(local, recipe), strict=True))
    assert torch.get_num_threads() == before + 1
    torch.set_num_threads(before)
    weights, _ = learn(LocalFleet(build_host(recipe)), recipe, tmp_path / "local")
    films = films_of(tmp_path / "local")
    assert list(films) == ["imagined-step000000.mp4", "imagined-step000001.mp4"]
    fleet = RayFleet(recipe, actors)
    try:
        got = rollout(fleet, recipe)
        assert len(got) == 4 and all(equal(a, b) for a, b in zip(wanted, got, strict=True))
        learned, stats = learn(fleet, recipe, tmp_path / str(actors))
    finally:
        fleet.close()
    assert all(torch.equal(value, learned[name]) for name, value in weights.items())
    assert films_of(tmp_path / str(actors)) == films
    assert stats["ledger"]["learned"] == stats["ledger"]["requested"] == 32


def test_hosts_get_a_core_as_soon_as_the_learner_does(cluster: None) -> None:
    assert ray.get(ray.remote(lambda: os.nice(0)).remote()) == os.nice(0)


def test_a_killed_host_is_replaced_and_its_job_run_again(cluster: None, recipe: Recipe) -> None:
    wanted = rollout(LocalFleet(build_host(recipe)), recipe)
    fleet = RayFleet(recipe, 2)
    try:
        rollout(fleet, recipe)  # both are built now, or soon
        deadline = time.monotonic() + 60
        while len(fleet.processes) < 2 and time.monotonic() < deadline:
            time.sleep(0.1)
        for number in range(4):
            fleet.submit(Job(number, tuple(range(12 * number, 12 * number + 12)), 100 + number))
        os.kill(fleet.processes[0], signal.SIGKILL)
        fleet.kill(1)
        got = sorted((fleet.take() for _ in range(4)), key=lambda r: r.job.number)  # type: ignore[union-attr]
        assert [r.job.number for r in got if r] == [0, 1, 2, 3]
        assert all(
            r is not None and r.batch is not None and torch.equal(r.batch["episode_seed"], w["episode_seed"])
            for r, w in zip(got, wanted, strict=True)
        )
        assert fleet.ledger.deaths == 2
    finally:
        fleet.close()


@pytest.mark.long
def test_hosts_come_and_go_while_running(cluster: None, recipe: Recipe, tmp_path: Path) -> None:
    fleet = RayFleet(recipe, 1)
    try:
        fleet.resize(3)
        assert len(rollout(fleet, recipe)) == 4
        fleet.resize(1)
        assert len(rollout(fleet, recipe)) == 4
        with pytest.raises(ValueError, match="at least one"):
            fleet.resize(0)
    finally:
        fleet.close()


@pytest.mark.long
def test_async_keeps_lag_bounded_and_books_balanced(cluster: None, recipe: Recipe, tmp_path: Path) -> None:
    fleet = RayFleet(recipe, 2)
    try:
        _, stats = learn(fleet, recipe, tmp_path, iterations=4, schedule="async", max_policy_lag=1, queue=6)
    finally:
        fleet.close()
    ledger = stats["ledger"]
    assert ledger["learned"] == 4 * 16
    assert ledger["requested"] == ledger["learned"] + sum(ledger["dropped"].values())
    assert stats["last"]["policy_lag_max"] <= 1


@pytest.mark.long
def test_a_job_that_raises_is_given_up_and_counted(cluster: None, recipe: Recipe, tmp_path: Path) -> None:
    fleet = RayFleet(recipe, 1, patience=patience(recipe, retries=0))
    try:
        policy = build_policy(recipe.config, Path(recipe.policy))
        policy.freeze_perception()
        weights = trained_weights(policy)
        # of another shape, so taking over raises
        fleet.publish(0, {name: value[..., :-1] for name, value in weights.items()})
        fleet.submit(Job(0, tuple(range(4)), 0))
        result = fleet.take()
        assert result is not None and result.batch is None and result.failure.startswith("RuntimeError")
        fleet.publish(1, weights)
        fleet.submit(Job(1, tuple(range(4)), 0))
        result = fleet.take()
        assert result is not None and result.batch is not None and result.version == 1
        with pytest.raises(ValueError, match="versions only grow"):
            fleet.publish(0, weights)
    finally:
        fleet.close()


@pytest.mark.long
def test_a_job_that_ends_every_host_stops_the_run(cluster: None, recipe: Recipe) -> None:
    fleet = RayFleet(recipe, 1, patience=patience(recipe, job=0.01, deaths=1))
    try:
        fleet.publish(0, {})
        fleet.submit(Job(0, tuple(range(4)), 0))
        with pytest.raises(FleetError, match=r"job 0 ended 2 hosts.*0\.01? s.*launch\.patience\.job"):
            fleet.take()
    finally:
        fleet.close()


@pytest.mark.long
def test_hosts_that_cannot_be_built_stop_the_run(cluster: None, recipe: Recipe) -> None:
    plain = recipe.plain() | {"data": ("/nowhere",)}
    fleet = RayFleet(Recipe(**plain), 1, patience=patience(recipe, rebuilds=2))
    try:
        fleet.publish(0, {})
        fleet.submit(Job(0, (0,), 0))
        with pytest.raises(FleetError, match="/nowhere"):
            fleet.take()
    finally:
        fleet.close()


def test_a_plan_that_cannot_be_scheduled_is_refused(cfg: dict[str, Any]) -> None:
    launch = {
        **cfg["launch"],
        "actors": 5,
        "place": {**cfg["launch"]["place"], "actors": {"num_cpus": 1, "num_gpus": 0.5}},
    }
    plan = Plan.of(launch)
    with pytest.raises(ConfigError, match=r"launch\.place\.actors .* needs 1 CPU and 0.5 GPU"):
        plan.check([{"CPU": 8.0}])
    plan.check([{"CPU": 3.0, "GPU": 2.0}, {"CPU": 2.0, "GPU": 1.0}])
    with pytest.raises(ConfigError, match=r"launch\.strategy"):
        Plan.of({**launch, "strategy": "random"})


def test_missing_weights_are_named_before_anything_starts(cluster: None, recipe: Recipe) -> None:
    with pytest.raises(ConfigError, match="/nowhere"):
        build_fleet(Recipe(**(recipe.plain() | {"policy": "/nowhere"})))


def test_rollouts_survive_packing() -> None:
    batch = TensorDict(
        {("a", "b"): torch.arange(6).reshape(2, 3), "c": torch.zeros(2, 3, 4, dtype=torch.uint8)}, [2, 3]
    )
    assert equal(batch, unpack(pack(batch)))
