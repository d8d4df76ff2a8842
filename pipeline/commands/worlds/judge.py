"""worldloop judge: what a judge says of recorded episodes, beside whether they succeeded, and what that cost.

With several choices of frames it is WPE's study of how much a judge must see: all frames, every n-th, the
first and the last alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from actors.factory import build_judge, open_clips
from envs.judges.base import Judge
from envs.judges.vlm import VLMJudge
from envs.targets import ConfigError, target
from pipeline.evaluation.judging import cost_text, facts_text, labelled
from pipeline.evaluation.measurement import followed
from pipeline.evaluation.rewards.shown import ALL, check_frames, shown_table
from pipeline.graph.stage import WEIGHTS
from pipeline.loop import build_loop, has_physics, last_round
from pipeline.stages.given import datasets, learns

_SPLITS = ("train", "held_out", "calibration")


@dataclass(frozen=True)
class Selection:
    """What is judged.

    Args:
        data: a LeRobot data set; "" for what the run has recorded (task.data, of a task without physics).
        split: train, held_out, calibration, or all.
        episodes: at most, the first ones; 0 for all.
        frames: "all", a number n for every n-th counted back from the last, or "ends" for first and last.
    """

    data: str
    split: str
    episodes: int
    frames: tuple[str, ...]

    @classmethod
    def of(cls, words: Mapping[str, str]) -> Selection:
        """From the words of the command line.

        Raises:
            ConfigError: naming the word that cannot work.
        """
        data, episodes = words.get("data", ""), words.get("episodes", "0")
        split = words.get("split", "all" if data else "held_out")
        frames = tuple(words.get("frames", "all").strip("[]").split(","))
        if split not in (*_SPLITS, "all"):
            raise ConfigError(f"split={split} should be one of {[*_SPLITS, 'all']}")
        if not episodes.isdigit():
            raise ConfigError(f"episodes={episodes} should be a whole number; 0 for all")
        for name in frames:
            check_frames(name)
        return cls(data, split, int(episodes), frames)


def judge_study(cfg: Mapping[str, Any], root: Path, selection: Selection) -> str:
    """A table with a line for each choice of frames.

    Args:
        cfg: the resolved config.
        root: the run's folder, whose last judge is asked if it learns.

    Raises:
        ConfigError: if there is nothing to judge, or no judge.
        JudgeError: if it cannot go on; what was answered is kept.
    """
    store = open_clips(cfg, _folders(cfg, root, selection))
    chosen = torch.arange(len(store)) if selection.split == "all" else store.split(selection.split)
    episodes = labelled(store, followed(store, chosen))
    if not len(episodes):
        raise ConfigError(
            f"no episode of split={selection.split} says whether it succeeded; say split=all, or other data"
        )
    episodes = episodes[: selection.episodes or None]
    judge, kind = _judge(cfg, root), target(cfg["judge"], "judge")
    if isinstance(judge, VLMJudge) and selection.frames != (ALL,):
        check_shown(cfg["judge"]["pictures"])
    name = str(cfg["judge"]["_target_"]).rpartition(".")[2]
    lines = [f"{name} on {len(episodes)} recorded episodes ({selection.split})", _line(_HEAD)]
    for frames in selection.frames:
        before = kind.spent(cfg["judge"])  # type: ignore[attr-defined]
        found = shown_table(judge, store, episodes, frames)
        after = kind.spent(cfg["judge"])  # type: ignore[attr-defined]
        spent = {key: after[key] - before[key] for key in after}
        lines.append(f"{_line([frames, *_cells(found)])}  {cost_text(spent)}")
    if facts := facts_text(judge.facts()):
        lines.append(f"Judged by {facts}")
    return "\n".join(lines)


def check_shown(pictures: Mapping[str, Any]) -> None:
    """See that a vision-language model is shown just the frames that are chosen.

    Args:
        pictures: section judge.pictures.

    Raises:
        ConfigError: if it would leave out some of these, or be asked about parts of them.
    """
    if pictures["span"] != "clip" or pictures["every"] != 1:
        raise ConfigError(
            f"judge.pictures.span={pictures['span']} and judge.pictures.every={pictures['every']} choose"
            " again among the frames that frames=[...] chooses; say judge.pictures.span=clip"
            " judge.pictures.every=1"
        )


def _cells(found: Mapping[str, Any]) -> list[Any]:
    """Cells of the table behind the name of the choice of frames."""
    counts = [found[name] for name in ("tp", "fp", "fn", "tn")]
    lost = [found[name] for name in ("abstained", "errors")]
    right = "-" if found["accuracy"] is None else f"{100 * found['accuracy']:.1f}%"
    return [f"{found['shown']:.1f}", *counts, right, *lost]


_HEAD = ("frames", "shown", "TP", "FP", "FN", "TN", "accuracy", "abstained", "errors")


def _line(cells: Any) -> str:
    return "  ".join(f"{cell!s:>9}" for cell in cells)


def _folders(cfg: Mapping[str, Any], root: Path, selection: Selection) -> list[Path]:
    """The data sets that are judged."""
    if selection.data:
        return [Path(selection.data)]
    if not has_physics(cfg):
        return [Path(folder) for folder in cfg["task"]["data"]]
    graph = build_loop(cfg, root)
    recorded = [name for name in graph.nodes if name.split("-")[0] in ("collect", "explore", "deploy")]
    found = [graph.folder(name) for name in recorded if (graph.folder(name) / "manifest.json").exists()]
    if not found:
        raise ConfigError(
            "this run has recorded nothing yet: first `worldloop stage collect` with the same options, or say"
            " data=<folder of a LeRobot data set>"
        )
    return datasets(found)


def _judge(cfg: Mapping[str, Any], root: Path) -> Judge:
    """The judge as the run's last round left it; one without weights may do without a run."""
    graph, name = build_loop(cfg, root), f"judge-{last_round(cfg)}"
    if (graph.folder(name) / "manifest.json").exists():
        return build_judge(cfg, graph.folder(name) / WEIGHTS).eval()
    judge = build_judge(cfg)
    if learns(judge):
        raise ConfigError(
            f"this judge has learned nothing yet: first `worldloop stage {name}` with the same options"
        )
    return judge.eval()
