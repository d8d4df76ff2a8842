"""Stage: teach the judge on recorded and on generated frames, and set its threshold."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from envs.episodes.clips import ClipStore
from envs.judges.base import Judge, MissingFeatures, ask
from envs.judges.labels import progress_to_success, success_labels
from envs.simulators.replay import side_by_side
from envs.specs import Status
from envs.targets import ConfigError
from learners.stages.pictures import augment
from learners.stages.simulator import owners
from learners.stages.threshold import as_likely_as_not
from learners.training.fit import FitConfig, fit

_SHIFT = (
    0.06  # largest shift of what a judge learns from, of the picture's size: it learns few frames by heart
)


class JudgeData:
    """Frames with their labels, half of them positive as far as there are any.

    Args:
        store: whose recorded success labels frames; episodes that nobody labelled teach nothing.
        episodes: to learn from, int64 [N].
        hold: frames in a row that make a success; see labels.success_labels.
        discount: of the progress target, per frame.
        generated: generated_frames of generated.py, or None; labelled by what the same actions truly led to,
            they make half of each batch.
        recorded: recorded_features of generated.py of a judge that reads features; it sees no pictures.

    Attributes:
        share: fraction of the labelled frames that show success.

    Raises:
        ConfigError: if no episode is labelled.
    """

    def __init__(
        self,
        store: ClipStore,
        episodes: Tensor,
        hold: int,
        discount: float,
        generated: TensorDict | None = None,
        recorded: TensorDict | None = None,
    ):
        self.store, self.pictures = store, recorded is None
        self.labels, self.progress = frame_targets(store, hold, discount)
        rows = store.rows(episodes)
        given = TensorDict({"row": rows}, rows.shape) if recorded is None else recorded
        known = store.arrays["present"][given["row"]] & torch.isfinite(self.labels[given["row"]])
        given = given[known]
        if not len(given):
            raise ConfigError(
                "no episode of the data says whether it succeeded (next.success), so a judge"
                " cannot learn from them; label some, or use a judge that needs no labels"
            )
        when = torch.arange(len(self.labels)) - torch.repeat_interleave(store.start, store.length)
        self.pools = [_Pool(self.labels, when, given)]
        if generated is not None:
            names = ("row", "frames") if self.pictures else ("row", "features", "offset")
            labelled = generated.select(*names)[torch.isfinite(self.labels[generated["row"]])]
            if len(labelled):
                self.pools.append(_Pool(self.labels, when, labelled))

    def sample(self, count: int, generator: torch.Generator) -> TensorDict:
        """A batch [count] for Judge.loss, with uint8 frames."""
        each = [count // len(self.pools)] * len(self.pools)
        each[0] += count - sum(each)
        drawn = [pool.draw(size, generator) for pool, size in zip(self.pools, each, strict=True)]
        rows = torch.cat([some["row"] for some in drawn])
        owner = owners(self.store, rows)
        out = {"text": self.store.text[owner], "label": self.labels[rows], "progress": self.progress[rows]}
        if self.pictures:
            made = [some.get("frames", None) for some in drawn]
            frames = [
                self.store.frames(some["row"]) if own is None else own
                for some, own in zip(drawn, made, strict=True)
            ]
            out |= {"frames": torch.cat(frames), "first": self.store.frames(self.store.start[owner])}
        else:
            out |= {name: torch.cat([some[name] for some in drawn]) for name in ("features", "offset")}
        return TensorDict(out, [count])


class _Pool:
    """Frames to draw from.

    Args:
        labels: of all rows.
        when: of all rows, their number within the episode.
        given: TensorDict [N] with row, that of the recorded frame, which labels it, and what else is known.
    """

    def __init__(self, labels: Tensor, when: Tensor, given: TensorDict):
        rows = given["row"]
        self.given, self.when = given, when[rows]
        self.positive = (labels[rows] > 0.5).nonzero().flatten()
        negative = (labels[rows] <= 0.5).nonzero().flatten()
        self.negative = negative[self.when[negative].argsort(stable=True)]

    def draw(self, count: int, generator: torch.Generator) -> TensorDict:
        """Frames [count], a third of them positive whatever the data's share is.

        Another third fails at the same times as those succeed. Episodes end with success, so success has its
        usual time, and generated frames show by their faults how late it is: judges would tell by that.
        """
        wanted = count // 3 if len(self.positive) else 0
        wanted = wanted if len(self.negative) else count
        parts = [_pick(self.positive, wanted, generator)] if wanted else []
        if wanted < count:
            beside = self._alongside(parts[0], generator) if wanted else torch.zeros(0, dtype=torch.int64)
            parts += [beside, _pick(self.negative, count - wanted - len(beside), generator)]
        return self.given[torch.cat(parts)]

    def _alongside(self, positive: Tensor, generator: torch.Generator) -> Tensor:
        """A negative frame of the same time for each positive one that has any."""
        times, wanted = self.when[self.negative], self.when[positive]
        low, high = torch.searchsorted(times, wanted), torch.searchsorted(times, wanted, right=True)
        share = torch.rand(len(positive), generator=generator, dtype=torch.float64)
        at = low + (share * (high - low)).long()
        return self.negative[at[high > low]]


def _pick(pool: Tensor, count: int, generator: torch.Generator) -> Tensor:
    return pool[torch.randint(len(pool), (count,), generator=generator)]


def frame_targets(store: ClipStore, hold: int, discount: float) -> tuple[Tensor, Tensor]:
    """Success labels and progress of every row of a store, float32 [rows] each; NaN where nobody labelled."""
    labels = torch.full((len(store.arrays["present"]),), torch.nan)
    progress = labels.clone()
    if "success" not in store.arrays:
        return labels, progress
    for number in store.arrays["labelled"].nonzero().flatten().tolist():
        rows = slice(int(store.start[number]), int(store.start[number] + store.length[number]))
        labels[rows] = success_labels(store.arrays["success"][rows], hold)
        progress[rows] = progress_to_success(labels[rows], discount)
    return labels, progress


def train_judge(
    judge: Judge,
    store: ClipStore,
    episodes: Tensor,
    options: FitConfig,
    folder: Path,
    generated: TensorDict | None = None,
    recorded: TensorDict | None = None,
) -> dict[str, float]:
    """Train `judge` in place; see JudgeData.

    Raises:
        MissingFeatures: if it reads features and none are given.
    """
    if judge.reads_features and recorded is None:
        raise MissingFeatures("this judge learns from a simulator's features; give recorded_features of one")
    data = JudgeData(store, episodes, judge.hold, judge.discount, generated, recorded)

    def batch(step: int, generator: torch.Generator) -> TensorDict:
        return data.sample(options.part, generator)

    def loss(batch: TensorDict, generator: torch.Generator) -> tuple[Tensor, dict[str, Any]]:
        if not data.pictures:
            return judge.loss(batch)
        views = batch["frames"].shape[1]  # the same colours for both, as one camera would give them
        both = augment(torch.cat((batch["frames"], batch["first"]), 1), generator, _SHIFT)
        shown = batch.copy()
        shown["frames"], shown["first"] = both.split(views, 1)
        return judge.loss(shown)

    return fit("judge", judge, batch, loss, options, folder, watch="frame_accuracy")


@torch.no_grad()
def judge_recordings(
    judge: Judge, store: ClipStore, episodes: Tensor, features: Tensor | None = None
) -> Tensor:
    """Success probabilities of recorded episodes, frame by frame, float32 [N, T]; 0 where they are over or of
    which there is no picture, NaN throughout those that the judge could not judge.

    Args:
        features: of a judge that reads them, see simulators.features.features_of_episodes.
    """
    rows, valid = store.whole(episodes)
    valid = valid & store.arrays["present"][rows]
    parts = []
    for some in torch.arange(len(episodes)).split(side_by_side(store, 1 + rows.shape[1])):
        first = store.frames(store.start[episodes[some]])
        texts = [store.instructions[number] for number in episodes[some].tolist()]
        seen = () if features is None else (features[some],)
        judgement = ask(judge, store.frames(rows[some]), first, texts, *seen)
        known = (judgement.status == Status.OK.value).unsqueeze(-1)
        parts.append(torch.where(known, valid[some] * judgement.success.float(), torch.nan))
    return torch.cat(parts)


def calibrate(judge: Judge, success: Tensor, succeeded: Tensor) -> bool:
    """Set the judge's threshold where an episode is as likely to have succeeded as not.

    On recorded video, that is: on generated video the threshold would also make up for what the simulator
    gets wrong, and a judge made lenient for a pessimistic simulator is what a policy learns to exploit. And
    on video that it has not learned from, of which it is too sure.

    Args:
        success: frame probabilities [N, T] of recorded episodes that it did not learn from, 0 where they are
            over; those with NaN, which nobody could judge, are left out.
        succeeded: bool [N], whether they did.

    Returns:
        Whether it was set. It stays as it is where no episode succeeded, or none failed, or scores do not
        rise with success.
    """
    known = torch.isfinite(success).all(1)
    found = as_likely_as_not(judge.confidence(success[known].double()), succeeded[known])
    if found is not None:
        judge.threshold.fill_(found)
    return found is not None
