"""Rollouts far beyond the length of an episode: does video drift, and does it collapse?

Truth comes from a robot that pays no heed to its task, for hundreds of frames; without physics from the
longest recordings there are.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from actors.factory import build_pool, open_clips
from actors.world_config import world_spec
from envs.episodes.clips import ClipStore
from envs.episodes.episode import Episode
from envs.episodes.formats.lerobot.dataset import LeRobotDataset
from envs.episodes.formats.lerobot.writer import LeRobotWriter
from envs.files import write_json
from envs.judges.perceptual import PerceptualDistance
from envs.manifest import read_manifest, write_manifest
from envs.rng import Purpose, episode_seeds
from envs.simulators.base import Simulator
from envs.simulators.replay import replay, side_by_side
from pipeline.evaluation.fidelity.frames import by_frame, frame_errors, psnr
from pipeline.evaluation.statistics import mean
from pipeline.graph.kept import Tensors

Keep = Callable[[list[int], Callable[[], Tensors]], Tensors]
_DATA, _PLAN = "dataset", "plan.json"
_TRIES = 4  # scripted episodes for each that is wanted; physics gives some up
_END = 0.1  # share of an episode's frames that are its end
_OFFSET = 500_000  # of their seeds among those of evaluation


def _anew(places: list[int], make: Callable[[], Tensors]) -> Tensors:
    return make()


def long_episodes(cfg: Mapping[str, Any], folder: Path) -> ClipStore:
    """Scripted episodes of fidelity.long.frames, recorded once; they go on where the task succeeds by chance.

    Args:
        cfg: the resolved config, with physics.
        folder: where they are kept, each as soon as it is recorded.

    Raises:
        PoolError: if physics gives up too many.
    """
    section, chunk = cfg["fidelity"]["long"], cfg["task"]["chunk"]
    horizon = -(-section["frames"] // chunk) * chunk
    plan = {"task": dict(cfg["task"]), "long": dict(section)}
    longer = {**cfg, "task": {**cfg["task"], "horizon": horizon}}
    manifest = read_manifest(folder)
    if manifest is None or manifest["result"] != plan:
        _record(longer, folder, plan)
        write_manifest(folder, {"stage": "fidelity-long", "result": plan})
    return open_clips(longer, [folder / _DATA])


def _record(cfg: Mapping[str, Any], folder: Path, plan: Mapping[str, Any]) -> None:
    """The episodes that are not recorded yet; those of another plan are removed."""
    planned = folder / _PLAN
    if not planned.exists() or json.loads(planned.read_text()) != plan:
        shutil.rmtree(folder, ignore_errors=True)
        write_json(planned, plan)
    section, robot = cfg["fidelity"]["long"], world_spec(cfg).embodiment
    seeds = episode_seeds(cfg["seed"], Purpose.EVALUATE, _TRIES * section["episodes"], _OFFSET)
    writer = LeRobotWriter(folder / _DATA, robot)
    if writer.episodes:
        seeds = seeds[1 + seeds.index(LeRobotDataset(writer.root).seeds()[-1]) :]
    pool = build_pool(cfg)
    try:
        while seeds and (missing := section["episodes"] - writer.episodes):
            count = min(pool.slots, missing)
            for track in pool.script([(seed, section["noise_level"]) for seed in seeds[:count]], None):
                # a shard each, so that videos are the same however many were recorded side by side
                writer.write([Episode.from_track(track, "long", robot)])
            seeds = seeds[count:]
    finally:
        pool.close()


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
    keep: Keep = _anew,
) -> dict[str, Any]:
    """Error against frame number of long rollouts, and whether they collapse; frames of which no picture was
    recorded are left out.

    Args:
        keep: what is measured of the episodes at some places of `episodes`, now or at some earlier time.

    Returns:
        episodes and frames; by_frame, errors [T]; still and unrelated, the PSNR [T] of the first frame held
        and of the same moment of another episode (None of one episode), which say how much an error is;
        sharpness [T], the mean gradient of generated over that of true frames: below 1 is blur, above it
        noise; end, PSNR and sharpness over the last tenth of each episode, None where no picture was
        recorded; collapsed, whether in that tenth the error is that of an unrelated picture or more, or the
        sharpness less than half or more than twice the truth's; None where the sharpness does not say so and
        no other episode is as long.
    """
    rows, valid = store.whole(episodes)
    valid &= store.arrays["present"][rows]
    errors = _rolled_out(simulator, store, episodes, bf16, distance, keep)
    sharp, still, unrelated = (errors.pop(name) for name in ("sharp", "still", "unrelated"))
    both = valid & valid.roll(1, 0) if len(episodes) > 1 else torch.zeros_like(valid)
    number = valid.long().cumsum(1)
    ends = valid & (number > number[:, -1:] - (_END * number[:, -1:]).round().clamp(min=1))
    out: dict[str, Any] = {
        "episodes": len(episodes),
        "frames": rows.shape[1],
        "by_frame": by_frame(errors, valid),
        "sharpness": _line(sharp, valid),
        "still": _line(psnr(still), valid),
        "unrelated": _line(psnr(unrelated), both) if len(episodes) > 1 else None,
        "end": {"psnr": mean(psnr(errors["mse"])[ends]), "sharpness": mean(sharp[ends])},
        "collapsed": None,
    }
    error, sharpness = mean(errors["mse"].mean(-1)[ends]), out["end"]["sharpness"]
    if sharpness is not None and not 0.5 <= sharpness <= 2.0:
        out["collapsed"] = True
    elif error is not None and bool((both & ends).any()):
        # Episodes begin alike, and may end alike.
        out["collapsed"] = error >= max(float(unrelated[some].mean()) for some in (both, both & ends))
    return out


def _rolled_out(
    simulator: Simulator,
    store: ClipStore,
    episodes: Tensor,
    bf16: bool,
    distance: PerceptualDistance,
    keep: Keep,
) -> Tensors:
    """Of N episodes, generated as many at once as have room: frames.frame_errors, and [N, T] each sharp, the
    gradient of generated over that of true frames, and the MSE of still, the first frame held, and of
    unrelated, the episode before; 0 where an episode is over.
    """
    rows, _ = store.whole(episodes)

    def measured(some: Tensor) -> Tensors:
        made = replay(simulator, store, episodes[some], bf16=bf16).frames[:, : rows.shape[1]]
        count = made.shape[1]
        true, other = (store.frames(of[some, :count]) for of in (rows, rows.roll(1, 0)))
        first = store.frames(store.start[episodes[some]])[:, None]
        return {
            **frame_errors(made, true, distance),
            "sharp": _gradient(made) / _gradient(true).clamp(min=1e-6),
            "still": _mse(first.expand_as(true), true),
            "unrelated": _mse(other, true),
        }

    out: Tensors = {}
    for some in torch.arange(len(episodes)).split(side_by_side(store, 1 + rows.shape[1])):
        for name, values in keep(some.tolist(), partial(measured, some)).items():
            whole = out.setdefault(name, values.new_zeros(*rows.shape, *values.shape[2:]))
            whole[some, : values.shape[1]] = values
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
    return [mean(values[valid[:, t], t]) for t in range(valid.shape[1])]
