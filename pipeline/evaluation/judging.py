"""A judge asked about whole episodes, and its verdicts against recorded success."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from envs.episodes.clips import ClipStore
from envs.judges.base import Judge
from pipeline.evaluation.statistics import confusion


def labelled(store: ClipStore, episodes: Tensor) -> Tensor:
    """Those of `episodes` [N] of which it is known whether they succeeded."""
    known = [n for n in episodes.tolist() if store.episodes[n]["success"] is not None]
    return torch.tensor(known, dtype=torch.int64)


def episode_success(store: ClipStore, episodes: Tensor) -> Tensor:
    """Recorded success bool [N] of labelled episodes."""
    return torch.tensor([bool(store.episodes[n]["success"]) for n in episodes.tolist()], dtype=torch.bool)


@torch.no_grad()
def judge_frames(judge: Judge, frames: Tensor, store: ClipStore, episodes: Tensor, batch: int = 16) -> Tensor:
    """Success probabilities [N, T] of frames uint8 [N, T, V, 3, H, W] of these episodes."""
    device = judge.threshold.device
    scores = []
    for begin in range(0, len(episodes), batch):
        some = slice(begin, begin + batch)
        first = store.frames(store.start[episodes[some]])
        texts = [store.instructions[n] for n in episodes[some].tolist()]
        scores.append(judge.score(frames[some].to(device), first.to(device), texts).success.cpu())
    return torch.cat(scores)


def judge_table(
    judge: Judge, frames: Tensor, valid: Tensor, store: ClipStore, episodes: Tensor
) -> dict[str, Any]:
    """Confusion of the judge's episode verdicts with recorded success; {} if no episode is labelled.

    Args:
        frames: uint8 [N, T, V, 3, H, W], recorded or generated, of the N episodes.
        valid: bool [N, T], frames that exist.
    """
    known = torch.isin(episodes, labelled(store, episodes))
    if not known.any():
        return {}
    score = judge_frames(judge, frames[known], store, episodes[known])
    verdicts = judge.episode(score.to(judge.threshold.device), valid[known].to(judge.threshold.device))
    return confusion(verdicts.cpu(), episode_success(store, episodes[known]))
