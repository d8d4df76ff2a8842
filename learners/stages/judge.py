"""Stage: teach the judge on real frames, and how things look on generated ones."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from envs.encoders import to_signed
from envs.episodes.clips import ClipStore
from envs.judges.base import Judge, frame_labels
from envs.judges.learned import LearnedJudge
from learners.stages.pictures import augment, sights, survey
from learners.training.fit import FitConfig, fit


def episode_labels(store: ClipStore, hold: int) -> Tensor:
    """Frame targets of every row of a store, float32 [rows]; see judges.base.frame_labels."""
    out = torch.zeros(len(store.arrays["success"]))
    for start, length in zip(store.start.tolist(), store.length.tolist(), strict=True):
        out[start : start + length] = frame_labels(
            store.arrays["success"][None, start : start + length].float(), hold
        )[0]
    return out


def unseen_by_judge(store: ClipStore) -> Tensor:
    """Every fourth episode of any behaviour, on which judges are calibrated, and from which none learns,
    int64 [N].

    The threshold strays with the episodes that are asked, so these must be many.
    """
    return torch.tensor(
        [number for number, row in enumerate(store.episodes) if row["seed"] % 4 == 2], dtype=torch.int64
    )


def close_calls(labels: Tensor, progress: Tensor, rows: Tensor) -> Tensor:
    """Those of `rows` [N] whose progress is within a tenth of where successes begin: there it matters most
    what is seen, and things hide each other.
    """
    begins = rows[(labels[rows] > 0.5) & (labels[(rows - 1).clamp(min=0)] <= 0.5)]
    return rows[(progress[rows] - progress[begins].median()).abs() < 0.1] if len(begins) else begins


def train_judge(
    judge: LearnedJudge,
    store: ClipStore,
    episodes: Tensor,
    options: FitConfig,
    folder: Path,
    imagined: TensorDict | None = None,
) -> dict[str, float]:
    """Train `judge` in place.

    Args:
        imagined: frames of generated.py; half of each batch. Where the simulator knows its objects they teach
            how these look
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
        known = {
            "label": labels[imagined["row"]].where(~drawn, torch.nan),
            "progress": imagined["progress"].where(~drawn, torch.nan),
        }
        imagined = (
            imagined.clone(recurse=False)
            .update({**known, "where": sights(store, imagined["places"], imagined["row"], judge.aims)})
            .exclude("places", "row")
        )
    share = float(labels[rows].mean().clamp(0.02, 0.98))
    positive, negative = rows[labels[rows] > 0.5], rows[labels[rows] <= 0.5]
    close = close_calls(labels, store.arrays["progress"].float(), rows)

    def batch(step: int, generator: torch.Generator) -> TensorDict:
        real = options.part if imagined is None else options.part // 2
        # A third of the batch is positive whatever the data's share is, so that no batch is without a
        # success.
        wanted = real // 3 if len(positive) else 0
        at = [negative[torch.randint(len(negative), (real - wanted,), generator=generator)]]
        if wanted:
            at.append(positive[torch.randint(len(positive), (wanted,), generator=generator)])
        chosen = torch.cat(at)
        known = {
            "tokens": store.tokens[owner[chosen]],
            "label": labels[chosen],
            "progress": store.arrays["progress"][chosen].float(),
            "where": seen[chosen],
        }
        out = TensorDict({"frames": store.frames(chosen), "begin": begin[chosen], **known}, [len(chosen)])
        if imagined is not None:
            out = torch.cat(
                [out, imagined[torch.randint(len(imagined), (options.part - real,), generator=generator)]]
            )
        out["first"] = store.frames(out["begin"])[:, :1]
        some = 3 * len(out) // 4 if len(close) else 0
        drill = torch.cat(
            [
                pool[torch.randint(len(pool), (count,), generator=generator)]
                for pool, count in ((close, some), (rows, len(out) - some))
                if count
            ]
        )
        out["drill"] = torch.stack((store.frames(drill)[:, 0], store.frames(begin[drill])[:, 0]), 1)
        out["drilled"] = seen[drill]
        return out

    def loss(data: TensorDict, generator: torch.Generator) -> tuple[Tensor, dict[str, Any]]:
        views = data["frames"].shape[1]  # the same colours for both, as one camera would give them
        pictures, first, drill = augment(
            to_signed(torch.cat((data["frames"], data["first"], data["drill"]), 1)), generator
        ).split((views, 1, 2), 1)
        return judge.loss(
            data.clone(recurse=False).update({"frames": pictures, "first": first, "drill": drill}),
            max(share, 0.3),
            generator,
        )

    return fit("judge", judge, batch, loss, options, folder, watch="frame_accuracy")


def calibrate(judge: Judge, success: Tensor, succeeded: Tensor) -> bool:
    """Set the judge's threshold where an episode is as likely to have succeeded as not.

    On real video, that is: on generated video the threshold would also make up for what the simulator gets
    wrong, and
    a judge made lenient for a pessimistic simulator is what a policy learns to exploit. And on video that it
    has not
    learned from, of which it is too sure. The likelihood is logistic in the logit of an episode's score
    (Platt, 1999,
    with his targets, which keep it finite where scores part the outcomes): it uses all those episodes, where
    a
    threshold of best accuracy jumps with a few of them, and asks more of those near the threshold than of the
    rest.

    Args:
        success: frame probabilities [N, T] of real episodes that it did not learn from, 0 where they are
            over;
        succeeded: bool [N], whether they did.

    Returns:
        Whether it was set. It stays as it is where no episode succeeded, or none failed, or scores do not
        rise with success.
    """
    # An episode succeeds if its best run of `hold` frames lies above the threshold throughout.
    score = torch.logit(success.double().unfold(1, judge.hold, 1).amin(-1).amax(1).clamp(0.01, 0.99))
    hits = float(succeeded.sum())
    if hits in (0.0, float(len(succeeded))):
        return False
    targets = torch.where(succeeded, (hits + 1) / (hits + 2), 1 / (len(succeeded) - hits + 2)).double()
    line = torch.zeros(2, dtype=torch.float64, requires_grad=True)
    solver = torch.optim.LBFGS([line], max_iter=200, line_search_fn="strong_wolfe")

    def objective() -> Tensor:
        solver.zero_grad()
        misfit = nn.functional.binary_cross_entropy_with_logits(line[0] * score + line[1], targets)
        misfit.backward()
        return misfit

    solver.step(objective)
    slope, offset = line.tolist()
    if not slope > 0:  # or NaN
        return False
    judge.threshold.fill_(float(torch.tensor(-offset / slope).sigmoid().clamp(0.02, 0.98)))
    return True
