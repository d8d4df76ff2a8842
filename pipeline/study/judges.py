"""How much a judge must see (WPE): its verdicts by which frames of an episode it is shown."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

from annotated_types import MinLen

from envs.ranges import Count
from envs.targets import ConfigError, target
from pipeline.evaluation.result import result_of
from pipeline.evaluation.rewards.shown import check_frames
from pipeline.evaluation.statistics import balanced_accuracy, verdicts_line
from pipeline.stages.measured.frames import shown_frames
from pipeline.study.columns import Cell, Cfg, Column, Measured
from pipeline.study.methods import Made
from pipeline.study.worlds import measuring


class FramesShown(Column):
    """Verdicts on recorded held-out episodes that agree with true success, by what is shown.

    Args:
        title: see Column.
        frames: choices: "all", "ends" for first and last, or a number n for every n-th.
        episodes: at most, evenly spread.
    """

    def __init__(self, title: str, frames: Annotated[Sequence[str | int], MinLen(1)], episodes: Count):
        super().__init__(title)
        self.frames, self.episodes = [str(name) for name in frames], episodes
        for name in self.frames:
            check_frames(name)
        self.headline = _label(self.frames[0])

    def add(self, cfg: Cfg, made: Made) -> Sequence[str]:
        """See Column.add."""
        kind: Any = target(cfg["judge"], "judge")
        if kind.reads_features:
            raise ConfigError(
                f"judge={cfg['judge']['_target_']} reads a simulator's features of whole chunks, of which"
                " no frame can be left out; leave the row out"
            )
        inputs = measuring(made, "data", "judge")
        settings = {"frames": self.frames, "episodes": self.episodes}
        return (made.add_once("shown-frames", shown_frames, inputs, **settings),)

    def labels(self, cfg: Cfg) -> list[str]:
        """See Column.labels."""
        return [_label(name) for name in self.frames]

    def read(self, cfg: Cfg, folders: Sequence[Path]) -> Measured:
        """See Column.read."""
        found = result_of(folders[0])["frames"]
        return Measured({_label(name): found[name] for name in self.frames})

    def text(self, cell: Cell) -> str:
        """See Column.text."""
        lost = f", {cell['dropped']:.0f} not judged" if cell["dropped"] else ""
        return f"{verdicts_line(cell)}{lost} ({cell['shown']:.0f} frames)"

    def merit(self, cell: Cell) -> float | None:
        """See Column.merit."""
        return balanced_accuracy(cell)


def _label(frames: str) -> str:
    return {"all": "all frames", "ends": "first and last"}.get(frames, f"every {frames}th")
