"""worldloop bench collection and bench world: how fast true and imagined frames come."""

from __future__ import annotations

import os
import tempfile
import time
from pathlib import Path
from typing import Any

import torch

from actors.factory import build_simulator, open_clips
from actors.process import prepare_process
from actors.world_config import embodiment_of
from envs.episodes.episode import Episode
from envs.episodes.formats.lerobot.writer import LeRobotWriter
from envs.episodes.write_behind import WriteBehind
from envs.physics.pool import TaskPool
from envs.precision import mixed_precision
from envs.simulators.replay import future_of
from envs.targets import ConfigError
from pipeline.commands.demo_world import demo_recipe
from pipeline.loop import check_physics

_SHARD = 16  # episodes written while the next ones are played
_CHUNKS = 8  # steps of a simulator that are timed


def collection(cfg: dict[str, Any], episodes: int = 64) -> dict[int, float]:
    """Scripted episodes of the task written as a data set, on one core and on two: actions a second with all
    views rendered, and the ratio, for any suite.

    Both collect the same episodes, so they carry out the same actions; a core that this process may not use
    is one that nobody uses, threads that write videos included.

    Raises:
        ConfigError: if the task has no physics, or this process may use one core only.
    """
    check_physics(cfg, "bench collection")
    known = sorted(os.sched_getaffinity(0))
    if len(known) < 2:
        raise ConfigError("bench collection compares one core with two, and this process may use one only")
    task, robot = cfg["task"], embodiment_of(cfg)
    seconds: dict[int, float] = {}
    jobs = [(seed, 0.6 * (seed % 4) / 3) for seed in range(episodes)]
    try:
        for cores in (1, 2):
            os.sched_setaffinity(0, known[:cores])
            pool = TaskPool(task["suite"], task["name"], cores, task["horizon"], cores)
            pool.script(jobs[:cores], task["chunk"])  # models are compiled, contexts opened
            with tempfile.TemporaryDirectory() as folder:
                writer = LeRobotWriter(Path(folder) / "dataset", robot)
                began = time.perf_counter()
                actions = played = 0
                with WriteBehind(writer) as behind:
                    for begin in range(0, episodes, _SHARD):
                        tracks = pool.script(jobs[begin : begin + _SHARD], task["chunk"])
                        behind.write([Episode.from_track(track, "noisy", robot) for track in tracks])
                        actions += sum(len(track) - 1 for track in tracks)
                        played += len(tracks)
                seconds[cores] = time.perf_counter() - began
            pool.close()
            rate, views = actions / seconds[cores], len(robot.cameras)
            print(
                f"{cores} core(s): {rate:.0f} actions/s, {views * rate:.0f} view-frames/s at"
                f" {list(task['size'])}, {played} episodes, {episodes - played} dropped"
            )
    finally:
        os.sched_setaffinity(0, known)
    print(f"two cores collect {seconds[1] / seconds[2]:.2f}x as fast as one (goal 1.8)")
    return seconds


def world(cfg: dict[str, Any]) -> None:
    """Generated frames per second, and the forward pass's share of a simulator step."""
    prepare_process(0, 0)
    with tempfile.TemporaryDirectory() as folder:
        recipe = demo_recipe(cfg, Path(folder), 1)
        store, simulator = open_clips(cfg, recipe.data), build_simulator(cfg).eval()
        for batch in (1, 32):
            _time(cfg, simulator, store, batch)


def _time(cfg: dict[str, Any], simulator: Any, store: Any, batch: int) -> None:
    device, chunk = simulator.device, simulator.spec.chunk
    ids = torch.arange(batch) % len(store)
    state = simulator.reset(store.first(ids).to(device), torch.arange(batch, device=device))
    rows = store.start[ids][:, None] + torch.arange(1, chunk + 1)
    future = future_of(simulator, store, rows).to(device)
    spent, forward = [0.0], simulator.predict

    def timed(inputs: Any) -> Any:
        began = time.perf_counter()
        out = forward(inputs)
        spent[0] += time.perf_counter() - began
        return out

    simulator.predict = timed
    began = time.perf_counter()
    for _ in range(_CHUNKS):
        with mixed_precision(device, cfg["simulator"]["bf16"]):
            _, _, state = simulator.step(state, future)
    total = time.perf_counter() - began
    simulator.predict = forward
    print(
        f"batch {batch}: {_CHUNKS * batch * chunk / total:.0f} frames/s, forward pass"
        f" {100 * spent[0] / total:.1f}% of the step"
    )
