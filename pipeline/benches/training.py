"""worldloop bench overfit and bench pretrained: that what was released frozen learns, and that beginning from
learned weights pays.
"""

from __future__ import annotations

import statistics
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from actors.factory import ConfigError, bench_config, build_simulator, open_clips, options, prepare_process
from envs.episodes import Episode, LeRobotWriter
from envs.episodes.clips import ClipSpec, ClipStore
from envs.episodes.formats.foreign import Cut, read_foreign, resize
from envs.layouts import CommandLayout
from envs.physics.pool import BenchPool
from envs.simulators.base import WorldShape
from envs.simulators.dit.latent_world import LatentWorld, unit
from envs.simulators.gesim.engine import GESimConfig, GESimulator
from learners.stages.state import train_state
from learners.stages.vision import VisionConfig, train_vision
from learners.training.fit import FitConfig

TINY_NET: dict[str, Any] = {
    "num_attention_heads": 4,
    "attention_head_dim": 32,
    "num_layers": 4,
    "text_embed_dim": 16,
    "adaln_lora_dim": 32,
    "pose_num_attention_heads": 4,
    "pose_attention_head_dim": 16,
}
TINY_VAE: dict[str, Any] = {"base_dim": 4, "dim_mult": [1, 1, 1, 1], "num_res_blocks": 1}


def bridge_under_calibration(
    bundle: Path, clips: Path, target: Path, turn: int = 0, size: tuple[int, int] = (32, 48), frames: int = 16
) -> ClipStore:
    """One episode of three views: calibration, poses and joints of a GE-Sim 2.0 bundle, frames of three
    Bridge clips, dealt to the views from `turn` on.
    """
    body = next(iter(read_foreign(bundle, Cut(frames=frames, size=size))))
    videos = [clip.frames for clip, _ in zip(read_foreign(clips, Cut(frames=frames)), range(3), strict=False)]
    seen = np.ones(frames, bool)
    pictures = np.stack(
        [
            resize(video, seen, body.intrinsic[:1], size)[0][:, 0]
            for video in (*videos[turn:], *videos[:turn])
        ],
        1,
    )
    LeRobotWriter(target, body.views, size, body.fps).write([replace(body, frames=pictures, seen=seen)])
    return ClipStore([target], CommandLayout.JOINTS)


@torch.no_grad()
def latent_error(world: LatentWorld, store: ClipStore, episodes: Tensor, begin: Tensor) -> float:
    """Root-mean-square error of generated latents of single chunks, as a share of what saying nothing moves
    would cost (1 is no better).
    """
    clip = store.clips(episodes, begin, ClipSpec(world.shape.memory, world.shape.chunk))
    world.eval()
    made, *_ = world._denoise(world.build_inputs(clip, 0, generator=torch.Generator().manual_seed(1)))
    truth = world.encode(unit(clip["future", "frames"]))
    still = world.encode(
        unit(clip["memory", "frames"][:, 0, -1:].expand(-1, world.shape.chunk, -1, -1, -1, -1))
    )
    return float((made - truth).square().mean().sqrt() / (still - truth).square().mean().sqrt())


def overfit(cfg: Mapping[str, Any], steps: int = 400) -> dict[str, float]:
    """A tiny GE-Sim on a bundle's calibration and Bridge frames: vision, then adapters alone, then the state
    expert.

    The autoencoder has random weights, so errors are those of latents. finetune.data=[bundle folder, clip
    folder].
    """
    if len(cfg["finetune"]["data"]) != 2:
        raise ConfigError(
            "say which recordings: worldloop bench overfit finetune.data=[../shared/data/gesim_v2,../shared/data/bridge]"
        )
    prepare_process(0)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        bundle, clips = cfg["finetune"]["data"]
        store, turned = (
            bridge_under_calibration(Path(bundle), Path(clips), folder / f"data-{turn}", turn)
            for turn in (0, 1)
        )
        shape = WorldShape(3, store.size, 5, 4, 30.0, (), CommandLayout.JOINTS)
        world = GESimulator.build(
            shape, GESimConfig(net=TINY_NET, vae=TINY_VAE, sampling="edm", augment=0.0), None
        )
        _normalise_latents(world, store)
        begin = torch.arange(0, 10)
        every = torch.zeros_like(begin)
        found = {"vision_before": latent_error(world, store, every, begin)}
        train_vision(
            world,
            store,
            torch.arange(1),
            VisionConfig(alone=1.0, unroll=1),
            FitConfig(2 * steps, 8, 3e-3, ema=0.98, bf16=False),
            folder / "vision",
        )
        found["vision_after"] = latent_error(world, store, every, begin)
        adapted = GESimulator.build(shape, world.config, None)
        adapted.load_state_dict(world.state_dict())
        codec: Any = adapted.codec
        codec.latent_mean, codec.latent_std = world.codec.latent_mean, world.codec.latent_std
        found["adapters_before"] = latent_error(adapted, turned, every, begin)
        train_vision(
            adapted,
            turned,
            torch.arange(1),
            VisionConfig(alone=1.0, unroll=1, lora=16),
            FitConfig(steps, 8, 3e-3, ema=0.98, bf16=False),
            folder / "lora",
        )
        found["adapters_after"] = latent_error(adapted, turned, every, begin)
        expert = world.state_expert()
        expert.normalise(store.arrays["states"], store.arrays["recorded"])
        found["state_before"] = _state_error(world, expert, store, begin)
        train_state(
            expert,
            world,
            store,
            torch.arange(1),
            FitConfig(steps, 8, 2e-3, ema=0.98, bf16=False),
            folder / "state",
        )
        expert.attach(world)
        found["state_after"] = _state_error(world, expert, store, begin)
    print(
        f"latents of its chunks, as a share of the error of a still picture: {found['vision_before']:.2f} -> {found['vision_after']:.2f} after {2 * steps} steps"
    )
    print(
        f"that network on the same clips dealt to other views, adapters of rank 16 alone learning: {found['adapters_before']:.2f} -> {found['adapters_after']:.2f} after {steps} steps"
    )
    print(
        f"joint states, in spreads of the recording: {found['state_before']:.2f} -> {found['state_after']:.2f} after {steps} steps"
    )
    return found


def _normalise_latents(world: GESimulator, store: ClipStore) -> None:
    """Give the random autoencoder latents of unit spread, as a trained one has."""
    with torch.no_grad():
        latents = world.encode(unit(store.frames(torch.arange(13))[None]))
        codec: Any = world.codec
        codec.latent_mean.copy_(
            codec.latent_mean + codec.latent_std * latents.mean((0, 1, 3, 4, 5)).view(1, -1, 1, 1, 1)
        )
        codec.latent_std.mul_(latents.std((0, 1, 3, 4, 5)).clamp(min=1e-4).view(1, -1, 1, 1, 1))


@torch.no_grad()
def _state_error(world: GESimulator, expert: Any, store: ClipStore, begin: Tensor) -> float:
    clip = store.clips(torch.zeros_like(begin), begin, ClipSpec(world.shape.memory, world.shape.chunk))
    features = expert.read(
        expert.look(world, world.build_inputs(clip, 0, generator=torch.Generator().manual_seed(1)))
    )
    history, zero = clip["history"], torch.zeros_like(begin)
    made = expert.eval().decode(
        features, clip["future", "commands"], history["commands"], history["states"], zero, zero
    )
    return float(((made - clip["future", "states"]) / expert.state_std).square().mean().sqrt())


def pretrained(
    cfg: Mapping[str, Any], learned: int = 400, steps: int = 100, seeds: tuple[int, ...] = (0, 1, 2)
) -> dict[str, list[float]]:
    """The small simulator on few new episodes, from weights learned on other ones and from nothing: loss on
    episodes nobody learned from.
    """
    found: dict[str, list[float]] = {"from nothing": [], "from learned weights": []}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        old, new, kept = (
            _episodes(cfg, folder / part, base, count)
            for part, base, count in (("old", 0, 48), ("new", 1000, 8), ("kept", 2000, 12))
        )
        for seed in seeds:
            prepare_process(seed)
            first = build_simulator(cfg)
            _learn(first, old, learned, seed, folder / f"old-{seed}")
            for label in found:
                prepare_process(seed + 100)
                world = build_simulator(cfg)
                if label == "from learned weights":
                    world.load_state_dict(first.state_dict())
                else:  # the autoencoder is the same, so that losses can be compared
                    world.codec.load_state_dict(first.codec.state_dict())  # type: ignore[union-attr]
                _learn(world, new, steps, seed, folder / f"{label}-{seed}")
                found[label].append(_held_loss(world, kept))
    for label, values in found.items():
        print(
            f"{label}: loss {statistics.mean(values):.3f} on held-out episodes (seeds {', '.join(f'{v:.3f}' for v in values)}) after {steps} steps on 8 new episodes"
        )
    wins = sum(b < a for a, b in zip(*found.values(), strict=True))
    print(f"learned weights are the better beginning for {wins} of {len(seeds)} seeds")
    return found


def _episodes(cfg: Mapping[str, Any], folder: Path, base: int, count: int) -> ClipStore:
    bench = bench_config(cfg)
    pool = BenchPool(bench, 4, cfg["task"]["horizon"], cfg["launch"]["workers"])
    try:
        tracks = pool.script([(base + n, (n % 4) / 3) for n in range(count)], cfg["task"]["chunk"])
    finally:
        pool.close()
    LeRobotWriter(folder, bench.views, bench.size, cfg["task"]["control_hz"]).write(
        [Episode.from_track(t, "noisy", bench.views, cfg["task"]["control_hz"]) for t in tracks]
    )
    return open_clips(cfg, [folder])


def _learn(world: Any, store: ClipStore, steps: int, seed: int, folder: Path) -> None:
    train_vision(
        world,
        store,
        torch.arange(len(store)),
        options(VisionConfig, {"alone": 1.0, "unroll": 1}, "vision"),
        FitConfig(steps, 8, 1e-3, warmup=20, seed=seed, bf16=False),
        folder,
    )


@torch.no_grad()
def _held_loss(world: Any, store: ClipStore, batches: int = 6) -> float:
    world.eval()
    spec = ClipSpec(world.shape.memory, world.shape.chunk)
    values = []
    for number in range(batches):
        generator = torch.Generator().manual_seed(number)
        values.append(
            float(world.loss(store.sample(torch.arange(len(store)), 16, spec, generator), generator)[0])
        )
    return statistics.mean(values)
