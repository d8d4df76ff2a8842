"""Rollouts far beyond the length of an episode: does video drift, and does it collapse?

Truth comes from a robot that pays no heed to its task, for hundreds of frames; without physics from the
longest recordings there are.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from actors.factory import build_pool, open_clips
from actors.world_config import world_spec
from envs.episodes.clips import ClipStore
from envs.episodes.episode import Episode
from envs.episodes.formats.lerobot_writer import LeRobotWriter
from envs.judges.perceptual import PerceptualDistance
from envs.manifest import read_manifest, write_manifest
from envs.rng import Purpose, episode_seeds
from envs.simulators.base import Simulator
from envs.simulators.replay import replay
from pipeline.evaluation.fidelity.frames import by_frame, frame_errors, psnr

_TRIES = 4  # scripted episodes for each that is wanted; some succeed by chance, and end
_END = 0.1  # share of the frames that are the end
_OFFSET = 500_000  # of their seeds among those of evaluation


def long_episodes(cfg: Mapping[str, Any], folder: Path) -> ClipStore | None:
    """Scripted episodes of fidelity.long.frames, recorded once; None if all ended before.

    Args:
        cfg: the resolved config, with physics.
        folder: where they are kept.
    """
    section, chunk = cfg["fidelity"]["long"], cfg["task"]["chunk"]
    horizon = -(-section["frames"] // chunk) * chunk
    mine = {"task": dict(cfg["task"]), "long": dict(section)}
    longer = {**cfg, "task": {**cfg["task"], "horizon": horizon}}
    manifest = read_manifest(folder)
    if manifest is None or manifest["result"] != mine:
        shutil.rmtree(folder, ignore_errors=True)
        robot, wanted = world_spec(longer).embodiment, section["episodes"]
        seeds = episode_seeds(cfg["seed"], Purpose.EVALUATE, _TRIES * wanted, _OFFSET)
        pool, kept = build_pool(longer), []
        try:
            for begin in range(0, len(seeds), wanted):
                jobs = [(seed, section["noise_level"]) for seed in seeds[begin : begin + wanted]]
                kept += [track for track in pool.script(jobs, chunk) if len(track) == horizon + 1]
                if len(kept) >= wanted:
                    break
        finally:
            pool.close()
        if not kept:
            return None
        episodes = [Episode.from_track(track, "long", robot) for track in kept[:wanted]]
        LeRobotWriter(folder / "dataset", robot).write(episodes)
        write_manifest(folder, {"stage": "fidelity-long", "result": mine})
    return open_clips(longer, [folder / "dataset"])


def longest(store: ClipStore, episodes: Tensor, count: int) -> Tensor:
    """The `count` longest of some episodes int64 [N]."""
    return episodes[store.length[episodes].argsort(descending=True, stable=True)][:count]


@torch.no_grad()
def drift(
    simulator: Simulator,
    store: ClipStore,
    episodes: Tensor,
    bf16: bool,
    distance: PerceptualDistance,
) -> dict[str, Any]:
    """Error against frame number of long rollouts, and whether they collapse.

    Returns:
        episodes and frames; by_frame, errors [T]; still and unrelated, the PSNR [T] of the first frame held
        and of the same moment of another episode (None of one episode), which say how much an error is;
        sharpness [T], the mean gradient of generated over that of true frames: below 1 is blur, above it
        noise; end, PSNR and sharpness over the last tenth; collapsed, whether in that tenth the error is
        that of an unrelated picture or more, or the sharpness less than half or more than twice the truth's;
        None where the sharpness does not say so and no other episode is as long.
    """
    made = replay(simulator, store, episodes, bf16=bf16)
    true = store.frames(made.rows)
    errors, valid = frame_errors(made.frames, true, distance), made.valid
    still = store.frames(store.start[episodes])[:, None].expand_as(true)
    sharp = _gradient(made.frames) / _gradient(true).clamp(min=1e-6)
    last = max(1, round(_END * valid.shape[1]))
    ends = valid.clone()
    ends[:, :-last] = False
    others = {"still": _mse(still, true)}
    if len(episodes) > 1:
        others["unrelated"] = _mse(true.roll(1, 0), true)
        both = valid & valid.roll(1, 0)
    out: dict[str, Any] = {
        "episodes": len(episodes),
        "frames": int(valid.sum(1).max()),
        "by_frame": by_frame(errors, valid),
        "sharpness": _line(sharp, valid),
        "still": _line(psnr(others["still"]), valid),
        "unrelated": _line(psnr(others["unrelated"]), both) if "unrelated" in others else None,
    }
    error, sharpness = float(errors["mse"].mean(-1)[ends].mean()), float(sharp[ends].mean())
    out["end"] = {"psnr": float(psnr(errors["mse"])[ends].mean()), "sharpness": sharpness}
    out["collapsed"] = True if not 0.5 <= sharpness <= 2.0 else None
    if not out["collapsed"] and "unrelated" in others and bool((both & ends).any()):
        # Episodes begin alike, and may end alike.
        bar = max(float(others["unrelated"][some].mean()) for some in (both, both & ends))
        out["collapsed"] = error >= bar
    return out


def _mse(made: Tensor, true: Tensor) -> Tensor:
    """[N, T] over all views, episode by episode to spare memory."""
    pairs = zip(made, true, strict=True)
    return torch.stack([((a.float() - b.float()) / 255).square().mean((1, 2, 3, 4)) for a, b in pairs])


def _gradient(frames: Tensor) -> Tensor:
    """Mean absolute difference of neighbouring pixels, [N, T], in grey levels."""
    out = []
    for episode in frames:
        pictures = episode.float()
        out.append(
            pictures.diff(dim=-1).abs().mean((1, 2, 3, 4)) + pictures.diff(dim=-2).abs().mean((1, 2, 3, 4))
        )
    return torch.stack(out)


def _line(values: Tensor, valid: Tensor) -> list[float | None]:
    """Means [T] over episodes of values [N, T]."""
    return [
        float(values[valid[:, t], t].mean()) if valid[:, t].any() else None for t in range(valid.shape[1])
    ]
