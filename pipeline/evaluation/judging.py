"""A judge asked about whole episodes: its verdicts against recorded success, and its view frame by frame."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, NamedTuple

import torch
from torch import Tensor

from envs.episodes.clips import ClipStore
from envs.judges.base import Judge, ask
from envs.simulators.base import Simulator
from envs.simulators.features import features_of_episodes
from envs.simulators.replay import Replay, side_by_side
from envs.specs import Status
from pipeline.evaluation.statistics import confusion

_AT_ONCE = 16  # episodes judged in one pass, at most


class Scores(NamedTuple):
    """Probabilities of success and progress, float32 [N, T] each in 0..1, and status int64 [N]: where it is
    not OK the numbers mean nothing.
    """

    success: Tensor
    progress: Tensor
    status: Tensor

    @property
    def judged(self) -> Tensor:
        """Which episodes the judge could judge, bool [N]."""
        return self.status == Status.OK.value


def labelled(store: ClipStore, episodes: Tensor) -> Tensor:
    """Those of `episodes` [N] of which it is known whether they succeeded."""
    known = [n for n in episodes.tolist() if store.episodes[n]["success"] is not None]
    return torch.tensor(known, dtype=torch.int64)


def episode_success(store: ClipStore, episodes: Tensor) -> Tensor:
    """Recorded success bool [N] of labelled episodes."""
    return torch.tensor([bool(store.episodes[n]["success"]) for n in episodes.tolist()], dtype=torch.bool)


@contextmanager
def thinned(judge: Judge, every: int) -> Iterator[Judge]:
    """The judge of video that shows every so-manyth frame alone: so many of these stand for `hold` of all."""
    hold = judge.hold
    judge.hold = max(1, round(hold / every))
    try:
        yield judge
    finally:
        judge.hold = hold


def judge_frames(
    judge: Judge,
    frames: Tensor,
    valid: Tensor,
    store: ClipStore,
    episodes: Tensor,
    features: Tensor | None = None,
) -> Scores:
    """What the judge says of frames uint8 [N, T, V, 3, H, W] of these episodes. Past an episode's end it is
    shown the last frame again, so that what did not happen decides nothing.

    Args:
        valid: bool [N, T], frames that exist, the first ones.
        features: float32 [N, C, D] of their chunks, see Judge.score; used by a judge that reads them.
    """

    def shown(some: slice) -> Tensor:
        return until_end(frames[some], valid[some])

    return _judge(judge, shown, valid, store, episodes, features)


def until_end(values: Tensor, valid: Tensor) -> Tensor:
    """Values [N, T, ...] with the last of those that exist, bool [N, T], in place of all that follow it."""
    times = torch.arange(valid.shape[1])
    last = torch.where(valid, times, 0).amax(1, keepdim=True)
    return values[torch.arange(len(values))[:, None], torch.minimum(times, last)]


def judge_recorded(
    judge: Judge,
    store: ClipStore,
    episodes: Tensor,
    rows: Tensor,
    valid: Tensor,
    features: Tensor | None = None,
) -> Scores:
    """What the judge says of the recorded frames `rows` [N, T] of these episodes; those of which there is no
    picture show no success.

    Args:
        valid, features: as of `judge_frames`.
    """
    rows = until_end(rows, valid)
    scores = _judge(judge, lambda some: store.frames(rows[some]), valid, store, episodes, features)
    seen = store.arrays["present"][rows]
    return scores._replace(success=torch.where(seen, scores.success, 0.0))


@torch.no_grad()
def _judge(
    judge: Judge,
    shown: Callable[[slice], Tensor],
    valid: Tensor,
    store: ClipStore,
    episodes: Tensor,
    features: Tensor | None,
) -> Scores:
    """What the judge says of `shown` frames, made or read for a few episodes at a time; see judge_frames."""
    device, scores = judge.threshold.device, []
    if judge.reads_features and features is not None:
        features = until_end(features, valid[:, :: store.spec.chunk])
    size = side_by_side(store, 1 + valid.shape[1], _AT_ONCE)
    for begin in range(0, len(episodes), size):
        some = slice(begin, begin + size)
        first = store.frames(store.start[episodes[some]])
        texts = [store.instructions[n] for n in episodes[some].tolist()]
        seen = (features[some].to(device),) if judge.reads_features and features is not None else ()
        verdict = ask(judge, shown(some).to(device), first.to(device), texts, *seen)
        scores.append([value.cpu() for value in verdict])
    return Scores(*(torch.cat(parts) for parts in zip(*scores, strict=True)))


def judge_table(
    judge: Judge, scores: Scores, valid: Tensor, store: ClipStore, episodes: Tensor
) -> dict[str, Any]:
    """Confusion of the judge's episode verdicts with recorded success, and as "dropped" how many labelled
    episodes it gave none on; {} if no episode is labelled.

    Args:
        scores: of frames, recorded or generated, of the N episodes.
        valid: bool [N, T], frames that exist.
    """
    known = torch.isin(episodes, labelled(store, episodes))
    if not known.any():
        return {}
    dropped = int((known & ~scores.judged).sum())
    known &= scores.judged
    device = judge.threshold.device
    verdicts = judge.episode(scores.success[known].to(device), valid[known].to(device))
    return {**confusion(verdicts.cpu(), episode_success(store, episodes[known])), "dropped": dropped}


class Views(NamedTuple):
    """A judge's view of episodes as they were recorded and as a simulator generated them under the same
    actions.
    """

    recorded: Scores
    generated: Scores


def judge_both(
    judge: Judge, simulator: Simulator, store: ClipStore, episodes: Tensor, made: Replay, bf16: bool
) -> Views:
    """What the judge says of episodes int64 [N] that the simulator replayed, and of their recordings.

    Args:
        bf16: whether the simulator computes in bfloat16 where the device does.
    """
    known = features_of_episodes(simulator, store, episodes, bf16) if judge.reads_features else None
    return Views(
        judge_recorded(judge, store, episodes, made.rows, made.valid, known),
        judge_frames(judge, made.frames, made.valid, store, episodes, made.features),
    )


def facts_text(facts: Mapping[str, Any]) -> str:
    """Judge.facts in a line; "" if there are none."""
    return ", ".join(f"{name.replace('_', ' ')}: {value}" for name, value in facts.items())


def cost_text(cost: Mapping[str, float]) -> str:
    """What a judge was asked for and paid, in a line; also of how many answers nobody knows the cost."""
    told = {name: value for name, value in cost.items() if value and name != "uncounted"}
    parts = [f"{name.replace('_', ' ')} {value:.6g}" for name, value in told.items()]
    if uncounted := cost.get("uncounted"):
        parts.append(f"tokens of {uncounted:.6g} answers unknown (no usage told), so the cost lacks them")
    return ", ".join(parts) or ("all remembered" if cost else "free")
