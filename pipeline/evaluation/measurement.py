"""How far to trust what was imagined: rollout error against physics, state error, speed, and the judge's
tables.
"""

from __future__ import annotations

import time
from typing import Any

import torch
from torch import Tensor

from envs.episodes.clips import ClipStore
from envs.geometry.cameras import on_plane, project
from envs.judges import LearnedJudge
from envs.simulators.base import Simulator
from envs.simulators.replay import Replay, replay
from pipeline.evaluation.object_locator import locate
from pipeline.evaluation.statistics import confusion


def rollout_error(store: ClipStore, episodes: Tensor, made: Replay) -> dict[str, Any]:
    """Error of generated episodes against the true ones under the same actions.

    Returns:
        Object position error in pixels and centimetres (median, 90th percentile; over all frames, and at the
        last),
        the error of the place where the simulator itself has the object, share of frames in which the object
        is lost, PSNR of the first chunk's and the last frames in dB, joint
        state error in rad, and the error of the measuring stick itself on true video.
    """
    start = store.start[episodes]
    first = store.frames(start)[:, 0]
    intrinsic, c2w = store.intrinsic[episodes][:, 0], store.arrays["c2w"][start][:, 0]
    objects = store.arrays["objects"]
    block = objects[start][:, 0, :3]
    truth = store.frames(made.rows)
    said, lost = locate(made.frames[:, :, 0], first, block, intrinsic, c2w)
    seen, hidden = locate(truth[:, :, 0], first, block, intrinsic, c2w)
    where, _ = project(objects[made.rows][:, :, 0, :3], intrinsic, c2w)
    height = block[:, None, None, 2].expand(-1, said.shape[1], 1)
    metres = (on_plane(said, height, intrinsic, c2w) - objects[made.rows][:, :, 0, :3])[..., :2].norm(dim=-1)
    pixels = (said - where).norm(dim=-1)
    count = made.valid.shape[1]
    last = made.valid.long().cumsum(1).argmax(1)
    ends = torch.zeros_like(made.valid)
    ends[torch.arange(len(ends)), last] = True
    use = made.valid & ~hidden  # where the stick fails on true video it says nothing of generated video
    error = ((made.frames.float() - truth.float()) / 255).square().mean((-4, -3, -2, -1))
    psnr = -10 * error.clamp(min=1e-8).log10()
    early, late = torch.arange(count)[None] < 4, torch.arange(count)[None] >= last[:, None] - 3
    arms = [k for k in range(16) if k not in (7, 15)]
    states = (made.states - store.arrays["states"][made.rows]).abs()[..., arms]
    return {
        "episodes": len(episodes),
        "object_px": quantiles(pixels[use & ~lost]),
        "object_cm": quantiles(metres[use & ~lost] * 100),
        "object_px_at_end": quantiles(pixels[use & ~lost & ends]),
        "object_cm_at_end": quantiles(metres[use & ~lost & ends] * 100),
        "place_cm": quantiles(
            100 * (made.places[:, :, 0, :2] - objects[made.rows][:, :, 0, :2]).norm(dim=-1)[made.valid]
        ),
        "object_lost": share(lost[use]),
        "psnr_first_frames": float(psnr[made.valid & early].mean()),
        "psnr_last_frames": float(psnr[made.valid & late].mean()),
        "state_rad": quantiles(states[made.valid].flatten()),
        "stick_px": quantiles((seen - where).norm(dim=-1)[use]),
    }


def quantiles(values: Tensor) -> dict[str, float]:
    """{"median", "p90"}, NaN where there is nothing."""
    values = values[torch.isfinite(values)]
    if not len(values):
        return {"median": float("nan"), "p90": float("nan")}
    if len(values) > 1_000_000:  # torch.quantile's limit is 16 M; a million says the same
        values = values[:: len(values) // 1_000_000 + 1]
    return {"median": float(values.median()), "p90": float(values.quantile(0.9))}


def share(flags: Tensor) -> float:
    """Fraction of True, NaN without any."""
    return float(flags.float().mean()) if len(flags) else float("nan")


@torch.no_grad()
def judge_frames(
    judge: LearnedJudge, frames: Tensor, store: ClipStore, episodes: Tensor, batch: int = 16
) -> Tensor:
    """Success probabilities [N, T] of frames uint8 [N, T, V, 3, H, W] of these episodes."""
    device = next(judge.parameters()).device
    tokens = store.tokens[episodes]
    first = store.frames(store.start[episodes])
    pieces = zip(frames.split(batch), first.split(batch), tokens.split(batch), strict=True)
    return torch.cat([judge.score(*(value.to(device) for value in piece)).success.cpu() for piece in pieces])


def judge_table(
    judge: LearnedJudge, frames: Tensor, valid: Tensor, store: ClipStore, episodes: Tensor
) -> dict[str, Any]:
    """Confusion of the judge's episode verdicts with physics."""
    success = judge_frames(judge, frames, store, episodes)
    truth = torch.tensor([store.episodes[n]["success"] for n in episodes.tolist()])
    return confusion(judge.episode(success, valid), truth)


def speed(simulator: Simulator, store: ClipStore, batch: int, chunks: int) -> float:
    """Generated frames per second (all views together count as one) at a batch size, after one warm-up."""
    episodes = store.length.argsort(descending=True)[torch.arange(batch) % len(store)]
    replay(simulator, store, episodes[:1], batch=1)
    began, frames = time.perf_counter(), 0
    for _ in range(max(1, chunks // 10)):
        frames += replay(simulator, store, episodes, batch=batch).frames.shape[:2].numel()
    return frames / (time.perf_counter() - began)
