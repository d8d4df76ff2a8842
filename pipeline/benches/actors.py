"""worldloop bench actors: what Ray costs and brings, as ratios within one run."""

from __future__ import annotations

import json
import tempfile
import time
from pathlib import Path
from typing import Any

import ray

from actors.factory import build_policy
from actors.fleets.cluster import Plan, connect
from actors.fleets.fleet import Fleet, LocalFleet, Result
from actors.fleets.ray_fleet import RayFleet
from actors.policies.contract import freeze_perception
from actors.process import prepare_process
from actors.rollouts.host import Job, trained_weights
from actors.rollouts.recipe import Recipe, build_host
from actors.world_config import world_spec
from envs.specs import TEXT_BYTES
from pipeline.commands.demo_world import demo_recipe

_EPISODES, _JOBS = 32, 6


def actors(cfg: dict[str, Any]) -> None:
    """Rollouts per second here and on one and two Ray actors of one thread, where the time goes, bytes,
    weight sync, and recovery.
    """
    cfg = {**cfg, "rl": {**cfg["rl"], "threads": 1}}  # or two actors would share the cores of one
    prepare_process(0, 1)
    with tempfile.TemporaryDirectory() as folder:
        recipe = demo_recipe(cfg, Path(folder), _EPISODES)
        plan = Plan.of(cfg["launch"])
        connect(cfg["launch"])
        rates: dict[str, float] = {}
        for name, count in (("local", 0), ("1 actor", 1), ("2 actors", 2)):
            fleet: Fleet = (
                RayFleet(recipe, count, plan.options("actors")) if count else LocalFleet(build_host(recipe))
            )
            try:
                rates[name] = _measure(name, fleet, recipe)
                if isinstance(fleet, RayFleet) and count == 2:
                    _recovery(fleet)
            finally:
                fleet.close()
        print(
            f"1 actor is {rates['1 actor'] / rates['local']:.2f}x local;"
            f" 2 actors are {rates['2 actors'] / rates['1 actor']:.2f}x one (goal 1.8)"
        )
        ray.shutdown()
        _row(Path(folder))


def _measure(name: str, fleet: Fleet, recipe: Recipe) -> float:
    """Episodes per second of jobs that are all there at once, after one warm-up per host."""
    policy = build_policy(recipe.config, Path(recipe.policy))
    if recipe.freeze_perception:
        freeze_perception(policy)
    sync = fleet.publish(0, trained_weights(policy))
    number = 0

    def work(jobs: int) -> tuple[list[Result], float]:
        nonlocal number
        began = time.perf_counter()
        for _ in range(jobs):
            fleet.submit(Job(number, tuple(range(_EPISODES)), number))
            number += 1
        results = [result for result in (fleet.take() for _ in range(jobs)) if result.batch is not None]
        return results, time.perf_counter() - began

    while isinstance(fleet, RayFleet) and len(fleet.processes) < fleet.size:
        time.sleep(0.1)
    work(2 * fleet.size)
    results, seconds = work(_JOBS)
    forward = sum(r.forward_seconds for r in results) / (fleet.size * seconds)
    rate = _EPISODES * len(results) / seconds
    goal = 95 if name == "local" else 90
    line = (
        f"{name:<8} {rate:6.1f} episodes/s, {100 * forward:.1f}% of wall time inside networks (goal {goal})"
    )
    if results[0].bytes:
        batch = results[0].batch
        assert batch is not None
        spec = world_spec(recipe.config)
        pictures = 3 * spec.views * spec.size[0] * spec.size[1]
        seen = batch.numel() * (pictures + 4 * spec.state_dim + TEXT_BYTES)
        line += (
            f"; {results[0].bytes / _EPISODES / 1024:.0f} KiB per episode on the wire,"
            f" {results[0].bytes / seen:.2f}x what the policy sees (image, state, instruction; goal 1.2)"
            f"; weights {sync['sync_bytes'] / 1024:.0f} KiB published in {sync['sync_ms']:.1f} ms, taken over"
            f" in {1e3 * max(r.load_seconds for r in results):.1f} ms"
        )
    print(line)
    return rate


def _recovery(fleet: RayFleet) -> None:
    for number in range(1000, 1004):
        fleet.submit(Job(number, tuple(range(_EPISODES)), number))
    fleet.kill(0)
    began = time.monotonic()
    for _ in range(4):
        fleet.take()
    deadline = time.monotonic() + 60
    while not fleet.recoveries and time.monotonic() < deadline:
        time.sleep(0.05)
    recovery = f"{fleet.recoveries[0]:.1f} s" if fleet.recoveries else "not within a minute"
    print(
        f"a killed host was replaced after {recovery} (goal 10); the four jobs under way were done after"
        f" {time.monotonic() - began:.1f} s"
    )


def _row(folder: Path) -> None:
    """Cost of one metric row, as the RL loop writes it."""
    figures = {f"rl/figure_{k}": float(k) for k in range(30)}
    with (folder / "rows.jsonl").open("a") as rows:
        began = time.perf_counter()
        for step in range(1000):
            rows.write(json.dumps({"step": step, **figures}) + "\n")
            rows.flush()
        print(f"one metric row costs {time.perf_counter() - began:.4f} ms (goal 1)")
