"""Where imagination and truth disagree: episode by episode, how sure the judge of generated video is of
another outcome than the recorded one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from torch import Tensor

from envs.episodes.clips import ClipStore
from envs.judges.base import Judge
from envs.simulators.replay import Replay
from pipeline.evaluation.by_task import scenes_of_episodes, tasks_of_episodes
from pipeline.evaluation.judging import Views

_DIGITS = 3  # of what is written down


def compared(
    cfg: Mapping[str, Any], judge: Judge, store: ClipStore, episodes: Tensor, made: Replay, views: Views
) -> list[dict[str, Any]]:
    """A row for each replayed episode int64 [N]:

    episode, its number in the store; seed, source, task, scene and instruction; success as recorded, None if
    nobody labelled it; recorded and generated, the judge's confidence that the episode succeeded on either
    video; claims, its verdict on the generated one; disagreement in 0..1, how far it is on generated video
    (see `_sure`) from the recorded success, or where that is unknown from where it is on recorded video:
    above a half its verdict is another than the truth. Where the judge gave no judgement they are None, and
    disagreement 0.
    """
    over = ~made.valid
    recorded, generated = (
        _rounded(judge.confidence(scores.success.masked_fill(over, 0.0)), scores.judged) for scores in views
    )
    device, threshold = judge.threshold.device, float(judge.threshold)
    claims = judge.episode(views.generated.success.to(device), made.valid.to(device)).tolist()
    tasks, scenes = (of(cfg, store, episodes) for of in (tasks_of_episodes, scenes_of_episodes))
    rows = []
    for n, number in enumerate(episodes.tolist()):
        about = store.episodes[number]
        known = about["success"]
        truth = _sure(recorded[n], threshold) if known is None else float(known)
        rows.append(
            {
                "episode": number,
                **{key: about[key] for key in ("seed", "source", "instruction", "success")},
                "task": tasks[n],
                "scene": scenes[n],
                "recorded": recorded[n],
                "generated": generated[n],
                "claims": None if generated[n] is None else bool(claims[n]),
                "disagreement": _apart(_sure(generated[n], threshold), truth),
            }
        )
    return rows


def _rounded(confidence: Tensor, judged: Tensor) -> list[float | None]:
    """Confidences [N] as they are written down, None where they are worth nothing."""
    pairs = zip(confidence.tolist(), judged.tolist(), strict=True)
    return [round(value, _DIGITS) if known else None for value, known in pairs]


def _sure(confidence: float | None, threshold: float) -> float | None:
    """A confidence in 0..1 on a scale on which the judge's threshold, where it is as likely right as wrong,
    is a half.
    """
    if confidence is None:
        return None
    if confidence < threshold:
        return 0.5 * confidence / threshold
    return 0.5 + 0.5 * (confidence - threshold) / max(1 - threshold, 1e-6)


def _apart(one: float | None, other: float | None) -> float:
    """Distance of two confidences, 0 if one is missing."""
    return 0.0 if one is None or other is None else round(abs(one - other), _DIGITS)


def worst(rows: Sequence[Mapping[str, Any]], count: int) -> list[Mapping[str, Any]]:
    """The `count` rows of the greatest disagreement, the greatest first."""
    return sorted(rows, key=lambda row: -row["disagreement"])[:count]


def curves(views: Views, made: Replay, n: int) -> dict[str, list[float]]:
    """The judge's progress in each frame of the n-th replayed episode: recorded and generated."""
    valid = made.valid[n]
    return {
        name: [round(value, _DIGITS) for value in scores.progress[n][valid].tolist()]
        for name, scores in views._asdict().items()
    }
