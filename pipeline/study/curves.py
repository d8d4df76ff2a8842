"""Success of a policy against the time in which it learned (RoboScape-R, figure 2)."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import torch
from markupsafe import Markup

from envs.ranges import NonNegative
from envs.targets import ConfigError
from pipeline.evaluation.charts import Curve, line_chart
from pipeline.evaluation.result import result_of
from pipeline.evaluation.statistics import rate, rate_entry, rate_line
from pipeline.stages import prove, rl
from pipeline.study.columns import Cell, Cfg, Column, Measured, outcomes_of
from pipeline.study.methods import Made

_LEARNING = (rl.rl, rl.rl_in_physics)
Points = Sequence[tuple[float, float]]


class SuccessOverTime(Column):
    """True success of the policy while RL trains it, tried every rl.evaluate_every iterations on the first
    rl.evaluate_episodes evaluation seeds, against the seconds of rollouts and updates so far. It begins with
    the policy of imitation; trials do not count as time.

    Args:
        title: see Column.
        level: points above the first policy's success; the time after which they were reached is told.
    """

    headline = "last"

    def __init__(self, title: str, level: NonNegative):
        super().__init__(title)
        self.level = level

    def add(self, cfg: Cfg, made: Made) -> Sequence[str]:
        """See Column.add."""
        nodes, behind = made.graph.nodes, made.graph.needs(made.policy)
        learning = [name for name in nodes if name in behind and nodes[name].stage in _LEARNING]
        if not learning:
            raise ConfigError("no RL stands behind this row's policy, so there is nothing to draw")
        if not cfg["rl"]["evaluate_every"]:
            raise ConfigError("rl.evaluate_every=0 never tries the policy while it learns; say 1 or more")
        trial, before = cfg["rl"]["evaluate_episodes"], cfg["evaluate"]["episodes"]
        if before < trial:
            raise ConfigError(
                f"rl.evaluate_episodes={trial} are more than evaluate.episodes={before}, on which the policy"
                " is tried before RL; a curve has to be of the same episodes"
            )
        first = made.add_once("evaluate-before", prove.evaluate_physics, {"policy": "imitation"})
        return [first, *learning]

    def labels(self, cfg: Cfg) -> list[str]:
        """See Column.labels."""
        return ["first", "best", self.headline, f"+{self.level:g} points after", "learned for"]

    def read(self, cfg: Cfg, folders: Sequence[Path]) -> Measured:
        """See Column.read."""
        before = list(outcomes_of(cfg, folders[0]).values())[: cfg["rl"]["evaluate_episodes"]]
        points, spent = [(0.0, sum(before) / len(before))], 0.0
        for folder in folders[1:]:
            points += [(spent + seconds, success) for seconds, success in _trials(folder)]
            result = result_of(folder)
            spent += result["rollout_seconds"] + result["update_seconds"]
        return self._measured(points, len(before), spent)

    def text(self, cell: Cell) -> str:
        """See Column.text."""
        if "seconds" not in cell:
            return rate_line(cell)
        return "not reached" if cell["seconds"] is None else f"{cell['seconds']:.0f} s"

    def pool(self, several: Sequence[Measured]) -> Measured:
        """The mean curve of all seeds of training, trial by trial.

        Where RL ended after fewer trials, as it may in physics, whose iterations hold more or fewer episodes,
        that seed's last trial stands for all later ones: its policy stays what it is. So every point is of
        all seeds, and the last one of the policies that each of them ended with; a mean of those seeds alone
        that went on would change with who is in it, and to stop with the first would leave their ends out.
        """
        longest = max(len(one.curve) for one in several)
        trials = [[one.curve[min(n, len(one.curve) - 1)] for one in several] for n in range(longest)]
        points = [(_mean([x for x, _ in some]), _mean([y for _, y in some])) for some in trials]
        episodes = sum(one.cells["first"]["episodes"] for one in several)
        spent = _mean([one.cells["learned for"]["seconds"] for one in several])
        return self._measured(points, episodes, spent)

    def merit(self, cell: Cell) -> float | None:
        """See Column.merit."""
        return rate(cell)

    def chart(self, found: Mapping[str, Measured]) -> Markup:
        """See Column.chart."""
        curves = [
            Curve(title, [x for x, _ in one.curve], [100 * y for _, y in one.curve])
            for title, one in found.items()
        ]
        return line_chart(curves, self.title, "seconds of rollouts and updates", "success, %")

    def _measured(self, points: Points, episodes: int, spent: float) -> Measured:
        """The cells of a curve.

        Args:
            episodes: of each trial.
            spent: seconds in all.
        """
        (_, first), *later = points
        reached = [seconds for seconds, success in later if success >= first + self.level / 100]
        rates = (first, max(success for _, success in later), later[-1][1])
        cells = [rate_entry(torch.arange(episodes) < round(success * episodes)) for success in rates]
        cells += [{"seconds": min(reached, default=None)}, {"seconds": spent}]
        return Measured(dict(zip(self.labels({}), cells, strict=True)), curve=points)


def _trials(folder: Path) -> Iterator[tuple[float, float]]:
    """Seconds so far and true success of each trial that a stage of RL logged."""
    for line in (folder / "metrics.jsonl").read_text().splitlines():
        row = json.loads(line)
        if "rl/true_success" in row:
            yield row["rl/time/learning"], row["rl/true_success"]


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values)
