"""What a judge says of generated video and of the same recorded frames, kept part by part."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from envs.episodes.clips import ClipStore
from envs.judges.base import Judge
from envs.simulators.replay import Replay
from pipeline.evaluation.judging import Scores, judge_frames, judge_recorded, judge_table
from pipeline.evaluation.statistics import verdicts_line


def judged(judge: Judge, store: ClipStore, episodes: Tensor, made: Replay) -> dict[str, Tensor]:
    """Scores of episodes int64 [N], as tensors by names such as generated/success. A judge that reads a
    simulator's features is shown generated frames alone: recordings have features at their own rate only.
    """
    videos = {"generated": judge_frames(judge, made.frames, made.valid, store, episodes, made.features)}
    if not judge.reads_features:
        videos["recorded"] = judge_recorded(judge, store, episodes, made.rows, made.valid)
    return {f"{name}/{field}": v for name, some in videos.items() for field, v in some._asdict().items()}


def verdict_tables(
    judge: Judge, store: ClipStore, episodes: Tensor, parts: Sequence[Mapping[str, Tensor]], valid: Tensor
) -> dict[str, dict[str, Any]]:
    """Confusion of the judge's verdicts with recorded success by video, generated and, if known, recorded;
    {} if nobody knows success.

    Args:
        parts: what `judged` says of some of the episodes, in their order.
        valid: bool [N, T], frames that exist.
    """
    out = {}
    for video in dict.fromkeys(name.partition("/")[0] for name in parts[0]):
        columns = [[part[f"{video}/{field}"] for part in parts] for field in Scores._fields]
        scores = Scores(*(torch.cat([_longer(some, valid.shape[1]) for some in each]) for each in columns))
        if found := judge_table(judge, scores, valid, store, episodes):
            out[video] = found
    return out


def verdict_text(tables: Mapping[str, Mapping[str, Any]], video: str) -> str:
    """How many verdicts on a video are right (statistics.verdicts_line); "-" where there are none."""
    found = tables.get(video)
    return "-" if found is None else verdicts_line(found)


def _longer(values: Tensor, frames: int) -> Tensor:
    """Values [N, T] with zeros up to a number of frames; those [N] of whole episodes as they are."""
    if values.ndim == 1:
        return values
    return torch.cat((values, values.new_zeros(len(values), frames - values.shape[1])), 1)
