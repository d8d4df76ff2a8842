"""worldloop bench physics and bench world: how fast true and imagined frames come."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any

import torch

from actors.factory import build_simulator, open_clips
from actors.process import prepare_process
from envs.physics.pool import TaskPool
from envs.precision import mixed_precision
from envs.simulators.replay import future_of
from pipeline.commands.demo_world import demo_recipe

_CHUNKS = 8  # steps of a simulator that are timed


def physics(cfg: dict[str, Any]) -> None:
    """Actions carried out per second with all views rendered, with one worker and with one per core."""
    task, rates = cfg["task"], {}
    for workers in sorted({1, torch.get_num_threads()}):
        pool = TaskPool(task["suite"], task["name"], 2 * workers, task["horizon"], workers)
        jobs = [(seed, 0.5) for seed in range(16 * workers)]
        pool.script(jobs[:workers], task["chunk"])
        began = time.perf_counter()
        tracks = pool.script(jobs, task["chunk"])
        frames = sum(len(track) for track in tracks)
        rates[workers] = frames / (time.perf_counter() - began)
        views, _, *size = tracks[0].rows["frames"][0].shape
        pool.close()
        print(
            f"{workers} worker(s): {rates[workers]:.0f} actions/s with all views,"
            f" {views * rates[workers]:.0f} view-frames/s at {size} (goal 400 on 2 cores)"
        )
    print(f"{max(rates)} workers are {rates[max(rates)] / rates[min(rates)]:.2f}x one")


def world(cfg: dict[str, Any]) -> None:
    """Generated frames per second, and the forward pass's share of a simulator step."""
    prepare_process(0)
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
