"""How far to trust what is imagined: picture and state error of rollouts under true actions, and speed."""

from __future__ import annotations

import time
from functools import cache
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from envs.conditioning.units import Units
from envs.episodes.clips import ClipStore
from envs.simulators.base import Simulator
from envs.simulators.replay import SIDE_BY_SIDE, Replay, replay, side_by_side
from pipeline.evaluation.objects.error import object_error
from pipeline.evaluation.statistics import mean, quantiles

_LAST = 4  # frames at the end of an episode
_CHUNKS = 10  # of an episode at most, by which speed is measured


def followed(store: ClipStore, episodes: Tensor) -> Tensor:
    """Those of episodes int64 [N] in which something follows the first frame; of the others nothing can be
    generated or judged, and how many they are is told once in a process.
    """
    more = store.length[episodes] > 1
    if not more.all():
        names = sorted({str(store.parts[store.episodes[n]["dataset"]].folder) for n in episodes[~more]})
        _say(f"{int((~more).sum())} episodes of a single frame are left out ({', '.join(names)})")
    return episodes[more]


@cache  # once in a process
def _say(text: str) -> None:
    tqdm.write(text)


def groups(store: ClipStore, episodes: Tensor) -> dict[str, Tensor]:
    """Episodes by who acted: a name for each source, "on-policy" for all deployed policies."""
    out: dict[str, list[int]] = {}
    for number in episodes.tolist():
        source = store.episodes[number]["source"] or "recorded"
        out.setdefault("on-policy" if source.startswith("policy-") else source, []).append(number)
    return {name: torch.tensor(numbers) for name, numbers in sorted(out.items())}


def evenly(episodes: Tensor, count: int) -> Tensor:
    """`count` of some episodes int64 [N] at most, evenly spread over them."""
    return episodes[torch.linspace(0, len(episodes) - 1, min(count, len(episodes))).round().long()]


def rollout_error(store: ClipStore, episodes: Tensor, made: Replay) -> dict[str, Any]:
    """Error of generated episodes against the true ones under the same actions.

    Returns:
        episodes; PSNR of the first chunk's worth of frames and of the last in dB, over all views, as far as
        pictures were recorded, else None; `state`, the absolute error of the decoded states in units of each
        number's spread over the data (median, 90th percentile), None if none of them moves; and the object's
        error where physics recorded its place (see objects/error.py).
    """
    truth, shown = store.frames(made.rows), made.pictured(store)
    count = made.valid.shape[1]
    last = shown.valid.long().cumsum(1).argmax(1)
    at = torch.arange(count)[None]
    early, late = at < store.spec.chunk, at >= last[:, None] - _LAST + 1
    error = torch.stack(
        [
            ((a.float() - b.float()) / 255).square().mean((-4, -3, -2, -1))
            for a, b in zip(made.frames, truth, strict=True)
        ]
    )
    psnr = -10 * error.clamp(min=1e-8).log10()
    states = store.arrays["states"]
    units = Units(store.spec.state_dim, store.spec.embodiment.state_rotations, least=0.0)
    units.normalise(states[store.rows(episodes)])
    moving = units.std > 1e-6 * states.abs().amax(0).clamp(min=1)
    off = units.change(made.states, states[made.rows]).abs()[..., moving]
    return {
        "episodes": len(episodes),
        "psnr_first_frames": mean(psnr[shown.valid & early]),
        "psnr_last_frames": mean(psnr[shown.valid & late]),
        "state": quantiles(off[made.valid].flatten()),
        **object_error(store, episodes, shown, truth),
    }


def speed(simulator: Simulator, store: ClipStore, batch: int, chunks: int, bf16: bool) -> float:
    """Generated frames per second (all views together count as one) at a batch size, SIDE_BY_SIDE at most:
    over the first chunks of the longest episodes that begin with a picture, and fewer of them where so many
    do not fit side by side.

    Args:
        chunks: to generate, about, in passes of ten at most.
    """
    begun = store.arrays["present"][store.start]
    longest = (store.length * begun).argsort(descending=True)
    episodes = longest[torch.arange(batch) % max(1, int(begun.sum()))]
    together, most = min(batch, SIDE_BY_SIDE), _CHUNKS
    while most > 1 and side_by_side(store, 1 + most * store.spec.chunk) < together:
        most -= 1
    replay(simulator, store, episodes[:1], bf16=bf16, most=1)  # the first call is slower than all others
    began, frames = time.perf_counter(), 0
    for _ in range(max(1, chunks // _CHUNKS)):
        frames += replay(simulator, store, episodes, bf16=bf16, most=most).frames.shape[:2].numel()
    return frames / (time.perf_counter() - began)
