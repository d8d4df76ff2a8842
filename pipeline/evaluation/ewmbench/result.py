"""From records to figures: best of the samples of each episode, means by task, and what they are to be
compared with.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch

from pipeline.evaluation.ewmbench.features import TextExtractor
from pipeline.evaluation.ewmbench.records import Record
from pipeline.evaluation.ewmbench.scene import diversity, mean_scene
from pipeline.evaluation.ewmbench.semantics import LogicalError, VideoReport, bleu, logic, step_similarity
from pipeline.evaluation.ewmbench.trajectory import Scores, best_of, mean_scores, scores

FIGURES = ("scene", "sa", "ta", "dyn", "hsd", "ndtw", "missing", "bleu", "steps", "logic", "diversity")


@dataclass(frozen=True)
class Scoring:
    """How records become figures.

    Args:
        size: (height, width) of the pictures.
        strict_parity: as the public code does; see trajectory.scores, semantics.bleu.
        texts: compares descriptions of steps.
        errors: logical errors and their penalties; () without a vision-language model.
    """

    size: tuple[int, int]
    strict_parity: bool
    texts: TextExtractor
    errors: Sequence[LogicalError]

    def episode(self, made: Sequence[Record], true: Record, instruction: str) -> dict[str, Any]:
        """Figures of one episode's samples: each of them, the best by its trajectories (the first, where they
        are not known of all), their mean, the recording's own, and those of its first frame held.
        """
        tracked = [self._tracked(record, true) for record in made]
        known = [found for found in tracked if found is not None]
        best = best_of(known) if len(known) == len(made) else 0
        judged = [self._semantics(record.report, true.report, instruction) for record in made]
        samples = [
            {**_scene(record), **_track(found), **semantics}
            for record, found, semantics in zip(made, tracked, judged, strict=True)
        ]
        varied = diversity(torch.stack([record.embedding for record in made]))
        # The public code compares feature by feature, and one that no patch shows is not like itself: what
        # a still picture gets depends on the picture.
        scene = {} if self.strict_parity else {"scene": 1.0}
        return {
            "best": best,
            "samples": samples,
            "generated": {**samples[best], "diversity": varied},
            "mean": {**_means(samples), "diversity": varied},
            "recorded": {**_scene(true), **self._semantics(true.report, true.report, instruction)},
            "still": {**scene, **_track(self._tracked(held(true), true)), "diversity": 0.0},
        }

    def _tracked(self, made: Record, true: Record) -> Scores | None:
        """Mean over cameras of the scores of one sample; None where nobody knows trajectories. The first
        frame is given, and does not count, but in the public code.
        """
        if made.tracks is None or true.tracks is None:
            return None
        given = 0 if self.strict_parity else 1
        found, wanted = made.tracks[given:].double().numpy(), true.tracks[given:].double().numpy()
        each = [
            scores(found[:, view], wanted[:, view], self.size, self.strict_parity)
            for view in range(wanted.shape[1])
        ]
        return mean_scores([one for one in each if one is not None])

    def _semantics(
        self, made: VideoReport | None, true: VideoReport | None, instruction: str
    ) -> dict[str, float | None]:
        """Semantic figures; None of what was not answered."""
        if made is None or true is None:
            return {"bleu": None, "steps": None, "logic": None}
        found: dict[str, float | None] = {"bleu": None, "steps": None, "logic": None}
        if made.caption is not None and instruction:
            found["bleu"] = bleu(made.caption, instruction, self.strict_parity)
        if made.steps is not None and true.steps is not None:
            found["steps"] = step_similarity(made.steps, true.steps, self.texts)
        if made.errors is not None:
            found["logic"] = logic(made.errors, self.errors)
        return found


def held(true: Record) -> Record:
    """The record of a video that shows the recording's first frame for ever, as far as trajectories go."""
    tracks = None if true.tracks is None else true.tracks[:1].expand_as(true.tracks)
    return Record((), true.embedding, tracks, None)


def overall(rows: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, float | None]]:
    """Means over episodes: of the best samples (generated), of all samples (mean), of recordings (recorded),
    and of first frames held (still); None of what is not known of any.
    """
    return {kind: _means([row[kind] for row in rows]) for kind in ("generated", "mean", "recorded", "still")}


def by_task(rows: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, dict[str, float | None]]]:
    """The same for each task; {} if there is one alone."""
    tasks = sorted({row["task"] for row in rows})
    if len(tasks) < 2:
        return {}
    return {task: overall([row for row in rows if row["task"] == task]) for task in tasks}


def scene_by_frame(made: Sequence[Sequence[Record]]) -> float | None:
    """Scene consistency of all samples of every episode as the public code's function returns it: each frame
    counts alike, and so a longer video more. Its table has means over videos, as `overall` has. None of no
    video.
    """
    scenes = [found for some in made for record in some if (found := mean_scene(list(record.scene)))]
    count = sum(scene.frames for scene in scenes)
    return sum(scene.score * scene.frames for scene in scenes) / count if count else None


def alike(made: Sequence[Sequence[Record]]) -> bool:
    """Whether all samples of every episode came out alike, as of a simulator that draws nothing."""
    return all(
        torch.equal(record.embedding, some[0].embedding) and _same(record.tracks, some[0].tracks)
        for some in made
        for record in some[1:]
    )


def _same(one: torch.Tensor | None, other: torch.Tensor | None) -> bool:
    if one is None or other is None:
        return one is other
    return torch.equal(one.nan_to_num(-1), other.nan_to_num(-1))


def _scene(record: Record) -> dict[str, float | None]:
    found = mean_scene(list(record.scene))
    if found is None:
        return {"scene": None, "scene_previous": None, "scene_first": None}
    return {"scene": found.score, "scene_previous": found.previous, "scene_first": found.first}


def _track(found: Scores | None) -> dict[str, float | None]:
    return dict.fromkeys(Scores.__dataclass_fields__) if found is None else found.row()


def _means(rows: Sequence[Mapping[str, float | None]]) -> dict[str, float | None]:
    out: dict[str, float | None] = {}
    for name in dict.fromkeys((*FIGURES, *(name for row in rows for name in row))):
        known = [value for row in rows if (value := row.get(name)) is not None]
        out[name] = sum(known) / len(known) if known else None
    return out
