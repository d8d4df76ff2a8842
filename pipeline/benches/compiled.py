"""worldloop bench compiled: what launch.compile is worth to a simulator, in training and in sampling."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict

from actors.factory import build_simulator
from actors.process import device_of, prepare_process
from envs.episodes.clips import ClipStore
from envs.precision import mixed_precision
from envs.rng import constant_generator
from envs.simulators.base import Simulator
from envs.simulators.compiling import begin_step, replays
from envs.simulators.inputs import build_inputs
from learners.training.optimisers import OPTIMISERS
from pipeline.benches.timing import best
from pipeline.benches.training import scripted

_EPISODES = 12
_SAMPLED = (1, 32)  # sessions side by side


def compiled(cfg: Mapping[str, Any]) -> dict[str, dict[str, float]]:
    """Least seconds of a training step, at the config's batch, and of a chunk, plain and compiled both ways,
    on launch.device; printed as ratios to the plain run, and returned by row and way.

    Raises:
        ConfigError: if the task has no physics to record clips in, or the device is not there.
        ValueError: if there is no compiler.
    """
    device, batch = device_of(cfg), cfg["simulator_fit"]["first"]["fit"]["batch"]
    prepare_process(cfg["seed"], cfg["threads"])
    found: dict[str, dict[str, float]] = {}
    with tempfile.TemporaryDirectory() as name:
        store = scripted(cfg, Path(name) / "clips", 0, _EPISODES)
        for how in (None, "blocks", "graphs"):
            torch.compiler.reset()
            world = build_simulator({**cfg, "launch": {**cfg["launch"], "compile": how}})
            rows = {f"a training step of {batch}": _training(world, _clips(world, store, batch))}
            for count in _SAMPLED:
                rows[f"a chunk of {count}"] = _sampling(world, _clips(world, store, count))
            for row, work in rows.items():
                with mixed_precision(device, True):
                    work()  # the second run of a compiled part records its graph
                    found.setdefault(row, {})[how or "plain"] = best(work, 3, device)
    for row, by in found.items():
        print(
            f"{row}: {by['plain'] * 1e3:.1f} ms, "
            + ", ".join(f"launch.compile={how} {by['plain'] / by[how]:.2f}x" for how in ("blocks", "graphs"))
        )
    return found


def _clips(world: Simulator, store: ClipStore, count: int) -> TensorDict:
    """Clips [count] of one chunk, on the world's device."""
    every = torch.arange(len(store))
    return store.sample(every, count, world.clip_spec(), constant_generator(0)).to(world.device)


def _training(world: Simulator, clip: TensorDict) -> Callable[[], None]:
    optimisers = OPTIMISERS["adamw"](dict(world.named_parameters()), 1e-4, 0.0, ())

    def step() -> None:
        world.train()
        for optimiser in optimisers:
            optimiser.zero_grad(set_to_none=True)
        if replays(world):
            begin_step()
        world.loss(clip, constant_generator(0))[0].backward()
        for optimiser in optimisers:
            optimiser.step()

    return step


def _sampling(world: Simulator, clip: TensorDict) -> Callable[[], None]:
    inputs = build_inputs(world.spec, clip, 0)

    @torch.no_grad()
    def chunk() -> None:
        world.eval()
        world.predict(inputs)

    return chunk
