"""How much a judge must see (WPE): its verdicts on whole episodes of which it is shown all frames, every
n-th, or the first and the last alone.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from envs.episodes.clips import ClipStore
from envs.judges.base import Judge
from envs.specs import Status
from envs.targets import ConfigError
from pipeline.evaluation.judging import Scores, judge_recorded, judge_table, thinned

ALL, ENDS = "all", "ends"
_BATCH = 16  # episodes judged at once


def check_frames(frames: str) -> None:
    """Refuse what is no choice of frames.

    Raises:
        ConfigError: for anything but "all", "ends" (first and last) and a number n (every n-th, counted back
            from the last).
    """
    if frames not in (ALL, ENDS) and not (frames.isdigit() and int(frames)):
        raise ConfigError(f"frames={frames} should be all, ends, or a number n for every n-th frame")


def shown_table(judge: Judge, store: ClipStore, episodes: Tensor, frames: str) -> dict[str, Any]:
    """A judge's verdicts on labelled episodes int64 [N] of which it is shown some frames.

    Returns:
        shown, how many frames of an episode in the mean; abstained and errors, in episodes; and what
        judge_table says.
    """
    rows, valid = shown_rows(store, episodes, frames)
    parts, every = [], {ALL: 1, ENDS: judge.hold}.get(frames) or int(frames)
    with thinned(judge, every):
        for some in tqdm(torch.arange(len(episodes)).split(_BATCH), desc=f"judge {frames}", leave=False):
            parts.append(judge_recorded(judge, store, episodes[some], rows[some], valid[some]))
        scores = Scores(*(torch.cat(values) for values in zip(*parts, strict=True)))
        table = judge_table(judge, scores, valid, store, episodes)
    lost = {
        name: int((scores.status == status.value).sum())
        for name, status in (("abstained", Status.ABSTAIN), ("errors", Status.ERROR))
    }
    return {"shown": 1 + float(valid.sum(1).float().mean()), **table, **lost}


def shown_rows(store: ClipStore, episodes: Tensor, frames: str) -> tuple[Tensor, Tensor]:
    """Some rows of each episode but its first, int64 [N, T], the last repeated up to the longest, and which
    are no repeats, bool [N, T]; see check_frames.
    """
    length = store.length[episodes] - 1
    every = {ALL: 1, ENDS: int(length.max())}.get(frames) or int(frames)
    count = -(-length // every)
    behind = (count[:, None] - 1 - torch.arange(int(count.max()))).clamp(min=0) * every
    valid = torch.arange(int(count.max())) < count[:, None]
    return store.start[episodes][:, None] + length[:, None] - behind, valid
