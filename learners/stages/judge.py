"""Stage: teach the judge on real frames, and how things look on generated ones."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from tensordict import TensorDict
from torch import Tensor

from envs.encoders import to_signed
from envs.episodes.clips import ClipStore
from envs.judges.base import Judge, frame_labels
from envs.judges.learned import LearnedJudge
from learners.fit import FitConfig, fit
from learners.stages.pictures import augment, sights, survey


def episode_labels(store: ClipStore, hold: int) -> Tensor:
    """Frame targets of every row of a store, float32 [rows]; see judges.base.frame_labels."""
    out = torch.zeros(len(store.arrays["success"]))
    for start, length in zip(store.start.tolist(), store.length.tolist(), strict=True):
        out[start : start + length] = frame_labels(store.arrays["success"][None, start : start + length].float(), hold)[0]
    return out


def unseen_by_judge(store: ClipStore) -> Tensor:
    """Every eighth episode of any behaviour, on which judges are calibrated, and from which none learns, int64 [N]."""
    return torch.tensor([number for number, row in enumerate(store.episodes) if row["seed"] % 8 == 4], dtype=torch.int64)


def train_judge(
    judge: LearnedJudge, store: ClipStore, episodes: Tensor, options: FitConfig, folder: Path, imagined: TensorDict | None = None
) -> dict[str, float]:
    """Train `judge` in place.

    Args:
        imagined: frames of generated.py; half of each batch. Where the simulator knows its objects they teach how these look
            when drawn; where it does not, they are labelled by physics under the same actions.
    """
    if imagined is not None and not len(imagined):
        imagined = None  # a simulator so bad that every frame went astray
    labels = episode_labels(store, judge.hold)
    rows = store.rows(episodes)
    begin = torch.repeat_interleave(store.start, store.length)
    owner = torch.repeat_interleave(torch.arange(len(store)), store.length)
    seen = sights(store, store.arrays["objects"], torch.arange(len(labels)), judge.aims)
    survey(judge.main, store, rows)
    if imagined is not None:
        drawn = torch.isfinite(imagined["places"][..., :2]).all(-1).any(-1)
        # Half a centimetre off its true place a thing is drawn as surely as elsewhere, and decides otherwise.
        known = {"label": labels[imagined["row"]].where(~drawn, torch.nan), "progress": imagined["progress"].where(~drawn, torch.nan)}
        imagined = imagined.clone(recurse=False).update({**known, "where": sights(store, imagined["places"], imagined["row"], judge.aims)}).exclude("places", "row")
    share = float(labels[rows].mean().clamp(0.02, 0.98))
    positive, negative = rows[labels[rows] > 0.5], rows[labels[rows] <= 0.5]

    def batch(step: int, generator: torch.Generator) -> TensorDict:
        real = options.part if imagined is None else options.part // 2
        # A third of the batch is positive whatever the data's share is, so that no batch is without a success.
        wanted = real // 3 if len(positive) else 0
        at = [negative[torch.randint(len(negative), (real - wanted,), generator=generator)]]
        if wanted:
            at.append(positive[torch.randint(len(positive), (wanted,), generator=generator)])
        chosen = torch.cat(at)
        known = {"tokens": store.tokens[owner[chosen]], "label": labels[chosen], "progress": store.arrays["progress"][chosen].float(), "where": seen[chosen]}
        out = TensorDict({"frames": store.frames(chosen), "begin": begin[chosen], **known}, [len(chosen)])
        if imagined is not None:
            out = torch.cat([out, imagined[torch.randint(len(imagined), (options.part - real,), generator=generator)]])
        out["first"] = store.frames(out["begin"])[:, :1]
        drill = rows[torch.randint(len(rows), (len(out),), generator=generator)]
        out["drill"] = torch.stack((store.frames(drill)[:, 0], store.frames(begin[drill])[:, 0]), 1)
        out["drilled"] = seen[drill]
        return out

    def loss(data: TensorDict, generator: torch.Generator) -> tuple[Tensor, dict[str, Any]]:
        views = data["frames"].shape[1]  # the same colours for both, as one camera would give them
        pictures, first, drill = augment(to_signed(torch.cat((data["frames"], data["first"], data["drill"]), 1)), generator).split((views, 1, 2), 1)
        return judge.loss(data.clone(recurse=False).update({"frames": pictures, "first": first, "drill": drill}), max(share, 0.3), generator)

    return fit("judge", judge, batch, loss, options, folder, watch="frame_accuracy")


def calibrate(judge: Judge, success: Tensor, truth: Tensor) -> None:
    """Set the judge's threshold where an episode is as likely to have failed as to have succeeded (Platt 1999).

    On real video, that is: on generated video the threshold would also make up for what the simulator gets wrong, and
    a judge made lenient for a pessimistic simulator is what a policy learns to exploit. And on video that it has not
    learned from, of which it is too sure. A line through all those episodes moves less with any of them than a
    threshold of best accuracy does. Where all of them ended alike, or where the judge knows nothing, it stays as it is.

    Args:
        success: frame probabilities [N, T] of real episodes that it did not learn from, 0 where they are over; truth: bool [N].
    """
    won, lost = int(truth.sum()), int((~truth).sum())
    if not won or not lost:
        return
    # An episode succeeds if its best run of `hold` frames lies above the threshold throughout.
    best = success.unfold(1, judge.hold, 1).amin(-1).amax(1).double().clamp(1e-6, 1 - 1e-6).logit()
    goal = torch.where(truth, (won + 1) / (won + 2), 1 / (lost + 2)).double()  # Platt's, that keep a line through separable data from growing steep without end
    middle, spread = best.mean(), best.std().clamp(min=1e-6)
    line = torch.zeros(2, dtype=torch.float64, requires_grad=True)
    solver = torch.optim.LBFGS([line], max_iter=100, line_search_fn="strong_wolfe")

    def closure() -> Tensor:
        solver.zero_grad()
        error = F.binary_cross_entropy_with_logits(line[0] * (best - middle) / spread + line[1], goal)
        error.backward()
        return error

    solver.step(closure)
    slope, offset = line.detach()
    if slope > 0:
        judge.threshold.fill_(float((middle - spread * offset / slope).sigmoid().clamp(0.02, 0.98)))
