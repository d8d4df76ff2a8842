"""worldloop bench overfit and bench pretrained: that what was released frozen learns, and that beginning from
learned weights pays.
"""

from __future__ import annotations

import statistics
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import nn

from actors.factory import build_pool, build_simulator, build_state_decoder, open_clips
from actors.process import prepare_process
from actors.world_config import world_spec
from envs.episodes import Episode, LeRobotWriter
from envs.episodes.clips import ClipStore
from envs.rng import step_generator
from envs.simulators.base import Simulator
from envs.targets import ConfigError
from learners.stages.simulator import SimulatorFitConfig, train_simulator
from learners.stages.state import train_state
from learners.training.fit import FitConfig

_BATCHES = 6  # of clips on which a loss is measured


def _fit(steps: int, lr: float, seed: int = 0) -> FitConfig:
    return FitConfig(
        steps, 8, lr, warmup=min(20, steps), ema=0.98, bf16=False, seed=seed, checkpoint_every=steps
    )


def _clips(lora: int = 0) -> SimulatorFitConfig:
    return SimulatorFitConfig(
        single_chunk_fraction=1.0, unroll=1, strides=(1,), recent_fraction=0.0, lora=lora
    )


@torch.no_grad()
def clip_loss(simulator: Simulator, store: ClipStore, count: int = 16) -> float:
    """The simulator's loss on single chunks, on the same clips and noise at every call."""
    simulator.eval()
    spec = simulator.clip_spec()
    values = []
    for number in range(_BATCHES):
        generator = step_generator(0, number)
        clip = store.sample(torch.arange(len(store)), count, spec, generator).to(simulator.device)
        values.append(float(simulator.loss(clip, generator)[0]))
    return statistics.mean(values)


def overfit(cfg: Mapping[str, Any], steps: int = 400) -> dict[str, float]:
    """A simulator on the recordings of task.data: all weights, then adapters alone from other weights, then
    the state expert. Losses on the clips that it learns from, before and after.
    """
    if not cfg["task"].get("data"):
        raise ConfigError(
            "say which recordings: worldloop bench overfit task.data=[folder of a LeRobot data set]"
        )
    prepare_process(0, 0)
    store = open_clips(cfg, cfg["task"]["data"])
    episodes = torch.arange(len(store))
    found: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        world = build_simulator(cfg)
        found["simulator_before"] = clip_loss(world, store)
        train_simulator(world, store, episodes, _clips(), _fit(steps, 3e-3), folder / "simulator")
        found["simulator_after"] = clip_loss(world, store)
        adapted = build_simulator(cfg)
        found["adapters_before"] = clip_loss(adapted, store)
        train_simulator(adapted, store, episodes, _clips(lora=16), _fit(steps, 3e-3), folder / "adapters")
        found["adapters_after"] = clip_loss(adapted, store)
        expert = build_state_decoder(cfg, world)
        stats = train_state(expert, world, store, episodes, _fit(1, 1e-9), folder / "state-0")
        found["state_before"] = stats["loss"]
        stats = train_state(expert, world, store, episodes, _fit(steps, 2e-3), folder / "state", fresh=False)
        found["state_after"] = stats["loss"]
    for part in ("simulator", "adapters", "state"):
        print(f"{part:<10} loss {found[f'{part}_before']:.3f} -> {found[f'{part}_after']:.3f}, {steps} steps")
    return found


def pretrained(
    cfg: Mapping[str, Any], learned: int = 400, steps: int = 100, seeds: tuple[int, ...] = (0, 1, 2)
) -> dict[str, list[float]]:
    """A simulator on few new episodes, from weights learned on other ones and from nothing: loss on episodes
    that nobody learned from.
    """
    found: dict[str, list[float]] = {"from nothing": [], "from learned weights": []}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        old, new, kept = (
            scripted(cfg, folder / part, base, count)
            for part, base, count in (("old", 0, 48), ("new", 1000, 8), ("kept", 2000, 12))
        )
        for seed in seeds:
            prepare_process(seed, 0)
            first = build_simulator(cfg)
            _learn(first, old, learned, seed, folder / f"old-{seed}")
            for label in found:
                prepare_process(seed + 100, 0)
                world = build_simulator(cfg)
                if label == "from learned weights":
                    world.load_state_dict(first.state_dict())
                else:
                    _share_codec(first, world)
                fresh = label == "from nothing"
                _learn(world, new, steps, seed, folder / f"{label}-{seed}", fresh)
                found[label].append(clip_loss(world, kept))
    for label, values in found.items():
        each = ", ".join(f"{value:.3f}" for value in values)
        print(
            f"{label}: loss {statistics.mean(values):.3f} on held-out episodes (seeds {each}), {steps} steps"
        )
    wins = sum(b < a for a, b in zip(*found.values(), strict=True))
    print(f"learned weights are the better beginning for {wins} of {len(seeds)} seeds")
    return found


def _share_codec(first: nn.Module, world: nn.Module) -> None:
    """Give latent worlds one autoencoder, so that their losses can be compared."""
    codec = getattr(first, "codec", None)
    if isinstance(codec, nn.Module):
        world.get_submodule("codec").load_state_dict(codec.state_dict())


def scripted(cfg: Mapping[str, Any], folder: Path, base: int, count: int) -> ClipStore:
    """Scripted episodes of growing noise."""
    pool, robot = build_pool(cfg), world_spec(cfg).embodiment
    try:
        tracks = pool.script([(base + n, (n % 4) / 3) for n in range(count)], cfg["task"]["chunk"])
    finally:
        pool.close()
    LeRobotWriter(folder, robot).write([Episode.from_track(track, "noisy", robot) for track in tracks])
    return open_clips(cfg, [folder])


def _learn(
    world: Simulator, store: ClipStore, steps: int, seed: int, folder: Path, fresh: bool = True
) -> None:
    every = torch.arange(len(store))
    train_simulator(world, store, every, _clips(), _fit(steps, 1e-3, seed), folder, fresh=fresh)
