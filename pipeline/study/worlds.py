"""What a study says of imagined worlds: how they were trained, their video, their speed, and how far they
lead policies and judges astray.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from envs.manifest import read_manifest
from envs.targets import ConfigError
from pipeline.evaluation.result import result_of
from pipeline.evaluation.statistics import balanced_accuracy, points_line, rate, rate_line, verdicts_line
from pipeline.stages import prove
from pipeline.stages.measured.video import video_errors
from pipeline.study.columns import ALL, Cell, Cfg, Column, Measured, Success, outcomes_of, together
from pipeline.study.methods import Made
from pipeline.study.table import gain_of

_PARTS = {"tokenizer": "tokenizer", "simulator-1": "simulator", "state-1": "state expert"}


class Training(Column):
    """How long, in how many steps, the parts of the first world were trained."""

    headline = "simulator"

    def add(self, cfg: Cfg, made: Made) -> Sequence[str]:
        """See Column.add."""
        return [name for name in _PARTS if name in made.graph.nodes]

    def labels(self, cfg: Cfg) -> list[str]:
        """See Column.labels."""
        tokens = "codec" in cfg["simulator"]
        return [label for name, label in _PARTS.items() if tokens or name != "tokenizer"]

    def read(self, cfg: Cfg, folders: Sequence[Path]) -> Measured:
        """See Column.read."""
        cells = {}
        for folder in folders:
            manifest = read_manifest(folder)
            assert manifest is not None, f"{folder} is finished"
            found = manifest["result"]
            spent = sum(found.get(f"{kind}_seconds", 0.0) for kind in ("data", "compute", "features"))
            cells[_PARTS[manifest["stage"]]] = {"seconds": spent, "steps": found["steps"]}
        return Measured(cells)

    def text(self, cell: Cell) -> str:
        """See Column.text."""
        return f"{cell['seconds']:.0f} s, {cell['steps']:.0f} steps"


class Rollout(Column):
    """Error of generated video over the horizon, under the recorded actions of held-out episodes."""

    headline = "last frames"
    _labels = ("first chunk", "half way", "last frames", "still picture, last frames", "better than it for")

    def add(self, cfg: Cfg, made: Made) -> Sequence[str]:
        """See Column.add."""
        return (made.add_once("video-errors", video_errors, measuring(made, "data", "simulator")),)

    def labels(self, cfg: Cfg) -> list[str]:
        """See Column.labels."""
        return [*self._labels, "object lost"]

    def read(self, cfg: Cfg, folders: Sequence[Path]) -> Measured:
        """See Column.read."""
        found = result_of(folders[0])
        both = zip(found["by_frame"]["psnr"], found["still"]["psnr"], strict=False)
        known = [pair for pair in both if None not in pair]  # none was recorded that late
        made, still = ([pair[side] for pair in known] for side in (0, 1))
        chunk, half = found["chunk"], len(made) // 2
        worse = [number for number, pair in enumerate(known) if pair[0] < pair[1]]
        parts = (made[:chunk], made[half : half + chunk], made[-chunk:], still[-chunk:])
        cells: dict[str, Cell] = {
            label: {"psnr": sum(some) / len(some)} for label, some in zip(self._labels, parts, strict=False)
        }
        cells[self._labels[-1]] = {"frames": min(worse, default=len(made)), "of": len(made)}
        return Measured({**cells, "object lost": {"share": found["object_lost"]}})

    def text(self, cell: Cell) -> str:
        """See Column.text."""
        if "frames" in cell:
            return f"{cell['frames']:.0f} of {cell['of']:.0f} frames"
        if "share" in cell:
            return "-" if cell["share"] is None else f"{100 * cell['share']:.0f}% of frames"
        return f"{cell['psnr']:.1f} dB"

    def merit(self, cell: Cell) -> float | None:
        """See Column.merit."""
        return float(cell["psnr"])


class Speed(Column):
    """Generated frames per second; all views together count as one."""

    headline = "batch 32"

    def add(self, cfg: Cfg, made: Made) -> Sequence[str]:
        """See Column.add."""
        return (_measure(made),)

    def labels(self, cfg: Cfg) -> list[str]:
        """See Column.labels."""
        return ["batch 1", "batch 32"]

    def read(self, cfg: Cfg, folders: Sequence[Path]) -> Measured:
        """See Column.read."""
        found = result_of(folders[0])["frames_per_second"]
        return Measured({label: {"frames": value} for label, value in found.items()})

    def text(self, cell: Cell) -> str:
        """See Column.text."""
        return f"{cell['frames']:.0f} frames/s"

    def merit(self, cell: Cell) -> float | None:
        """See Column.merit."""
        return float(cell["frames"])


class Verdicts(Column):
    """Verdicts of the judge that agree with recorded success, on held-out episodes of deployed policies, or
    on all where no policy was deployed.
    """

    headline = "generated"

    def add(self, cfg: Cfg, made: Made) -> Sequence[str]:
        """See Column.add."""
        return (_measure(made),)

    def labels(self, cfg: Cfg) -> list[str]:
        """See Column.labels."""
        return ["recorded", "generated"]

    def read(self, cfg: Cfg, folders: Sequence[Path]) -> Measured:
        """See Column.read."""
        groups = result_of(folders[0])["judge"]
        chosen = [groups["on-policy"]] if "on-policy" in groups else list(groups.values())
        cells = {}
        for video in self.labels(cfg):
            counts = {
                name: sum(group[video][name] for group in chosen)
                for name in ("tp", "fp", "fn", "tn", "dropped")
            }
            cells[video] = counts
        return Measured(cells)

    def text(self, cell: Cell) -> str:
        """See Column.text."""
        return verdicts_line(cell)

    def merit(self, cell: Cell) -> float | None:
        """See Column.merit. The plain share of right verdicts would praise a judge that always says no."""
        return balanced_accuracy(cell)


class Gap(Column):
    """Imagined less true success of the policies that were deployed, by round; the last one leads on."""

    headline = "last"

    def add(self, cfg: Cfg, made: Made) -> Sequence[str]:
        """See Column.add."""
        names = [name for name, node in made.graph.nodes.items() if node.stage is prove.gap]
        if not names:
            raise ConfigError("no policy is deployed in this row, so there is no gap to be seen")
        return names

    def labels(self, cfg: Cfg) -> list[str]:
        """See Column.labels."""
        return [*(f"round {number}" for number in range(1, cfg["rounds"]["count"])), self.headline]

    def read(self, cfg: Cfg, folders: Sequence[Path]) -> Measured:
        """See Column.read."""
        cells = {}
        for label, folder in zip(self.labels(cfg), folders, strict=True):
            found = result_of(folder)
            sides = {side: rate(found[side]) for side in ("true", "imagined")}
            cells[label] = {"gap": found["gap"], **sides}
        return Measured(cells)

    def text(self, cell: Cell) -> str:
        """See Column.text."""
        if cell["gap"] is None:
            return "not judged"
        sides = f"{100 * cell['imagined']:.0f}% imagined, {100 * cell['true']:.0f}% true"
        return f"{points_line(cell['gap'])} points ({sides})"

    def merit(self, cell: Cell) -> float | None:
        """See Column.merit."""
        return None if cell["gap"] is None else -abs(cell["gap"])


class Gain(Success):
    """True success of the row's policy, and its gain on the policy of imitation, on the same episodes."""

    def add(self, cfg: Cfg, made: Made) -> Sequence[str]:
        """See Column.add."""
        first = Made(made.graph, "imitation")
        return [*super().add(cfg, first), *super().add(cfg, made)]

    def read(self, cfg: Cfg, folders: Sequence[Path]) -> Measured:
        """See Column.read."""
        before, after = (outcomes_of(cfg, folder) for folder in folders)
        return _gained(before, after)

    def text(self, cell: Cell) -> str:
        """See Column.text."""
        return f"{rate_line(cell)}, {cell['gain']:+.1f}, p {cell['p']:.2g}"

    def pool(self, several: Sequence[Measured]) -> Measured:
        """See Column.pool."""
        return _gained(together([one.before for one in several]), together([one.outcomes for one in several]))

    def merit(self, cell: Cell) -> float | None:
        """See Column.merit."""
        return float(cell["gain"])


def _gained(before: dict[tuple[str, int], bool], after: dict[tuple[str, int], bool]) -> Measured:
    found = Measured.of_success(after)
    cells: dict[str, Any] = {}
    for label, cell in found.cells.items():
        same = [key for key in after if key in before and label in (key[0], ALL)]
        pairs = [before[key] for key in same], [after[key] for key in same]
        cells[label] = {**cell, **gain_of(*pairs), "episodes": cell["episodes"]}
    return Measured(cells, after, before)


def measuring(made: Made, *roles: str) -> dict[str, str | tuple[str, ...]]:
    """Inputs of whatever measures the world that is acted in."""
    inputs = made.graph.nodes[_measure(made)].inputs
    return {role: inputs[role] for role in roles}


def _measure(made: Made) -> str:
    for name, node in made.graph.nodes.items():
        if node.stage is prove.measure:
            return name
    raise ConfigError("no imagined world is measured in this row")
