"""worldloop gradients: how much RL can learn from imagined decisions, beside recorded ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from envs.files import write_json
from envs.targets import ConfigError
from learners.rl.ppo import PPO
from pipeline.commands.worlds.gradient_parts import COUNTS, FEWEST, LAMBDA, PARTS, TASK, Parts, rollouts
from pipeline.commands.worlds.subject import Keep, kept_of_round, round_inputs
from pipeline.evaluation.trust.gradients import PER, Measured, alignment, plain_row, signal
from pipeline.graph.kept import Tensors
from pipeline.loop import build_loop
from pipeline.markdown import markdown_table
from pipeline.stages.rl import Imagination, begin, rl, tasks_of_starts

LAMS = (0.0, 0.5, 0.8, 0.95)  # and the one in use; the largest hardly leans on the critic
_COLUMNS = ("signal of imagined", "of recorded", "imagined along recorded")


@dataclass
class Gradients:
    """Of one policy: [P] of each imagined batch and of each part of the recorded decisions, and how many
    decisions each was of.
    """

    imagined: list[Tensor] = field(default_factory=list)
    imagined_decisions: list[int] = field(default_factory=list)
    recorded: list[Tensor] = field(default_factory=list)
    recorded_decisions: list[int] = field(default_factory=list)

    def signals(self) -> dict[str, Measured | None]:
        """Of both kinds; None of one of which too few gradients were taken."""
        return {
            "imagined": _signal(self.imagined, self.imagined_decisions),
            "recorded": _signal(self.recorded, self.recorded_decisions),
        }


@dataclass
class Found:
    """What was measured of a round.

    Args:
        by_lambda: by lambda of GAE; None is an algorithm without one.
        by_task: with the lambda in use, {} for algorithms that have none, or of a single task.
        used: the lambda in use.
    """

    by_lambda: dict[float | None, Gradients]
    by_task: dict[str, Gradients]
    used: float | None

    def add(self, side: str, parts: Tensors) -> None:
        """Add gradients of one side, "imagined" or "recorded"."""
        lambdas = {f"{LAMBDA}{lam}": mine for lam, mine in self.by_lambda.items()}
        for name, gradients in parts.items():
            if name.startswith(COUNTS):
                continue
            mine = lambdas.get(name) or self.by_task.setdefault(name.removeprefix(TASK), Gradients())
            getattr(mine, side).extend(gradients)
            getattr(mine, f"{side}_decisions").extend(parts[f"{COUNTS}{name}"].tolist())


def gradients(cfg: Mapping[str, Any], root: Path, number: int, batches: int) -> str:
    """Tables of what imagined and recorded decisions of a round tell RL, and gradients-<round>.json.

    Args:
        cfg: the resolved config.
        root: the run's folder.
        number: of the round.
        batches: rollouts of rl.envs episodes each.

    Raises:
        ConfigError: if the run has not come so far.
    """
    if batches < 3:
        raise ConfigError(f"batches={batches}: what batches share is told by 3 of them at least")
    graph = build_loop(cfg, root)
    inputs = round_inputs(graph, root, number, "rl")
    name = f"rl-{number}"
    ready = begin(rl.view(name, graph.cfg, graph.nodes[name].settings), inputs)
    keep = kept_of_round(graph, root / "gradients", number, Parts.__module__)
    found = measured(graph.cfg, ready, batches, keep)
    lambdas, tasks = rows_by_lambda(found), rows_by_task(found)
    kept = [[*map(plain_row, rows)] for rows in (lambdas, tasks)]
    about = {"round": number, "batches": batches, "lambda": found.used}
    write_json(root / f"gradients-{number}.json", {**about, "by_lambda": kept[0], "by_task": kept[1]})
    return tables(lambdas, tasks, found, batches)


def measured(cfg: Mapping[str, Any], ready: Imagination, batches: int, keep: Keep) -> Found:
    """Gradients of so many imagined batches and of all recorded decisions, none of which is a step; each
    batch's are kept.
    """
    algorithm = ready.algorithm
    used = algorithm.config.lam if isinstance(algorithm, PPO) else None
    lams = (None,) if used is None else tuple(sorted({*LAMS, used}))
    tasks = [] if used is None else tasks_of_starts(cfg, ready.store, ready.inside, ready.beyond)
    about = {"lambdas": [str(lam) for lam in lams]}
    parts = Parts(ready, lams, used, tasks if len(set(tasks)) > 1 else [])
    found = Found({lam: Gradients() for lam in lams}, {}, used)
    with rollouts(ready) as rollout:

        def once(number: int) -> Tensors:
            return parts.imagined(rollout(number))

        for number in tqdm(range(batches), desc="imagined batches", unit="batch", dynamic_ncols=True):
            made = keep(f"imagined-{number}", {**about, "batch": number}, partial(once, number))
            found.add("imagined", made)
    decisions = ready.true.decisions
    if decisions is not None and ready.rollout is not None and len(decisions) >= FEWEST * PARTS:
        found.add("recorded", keep("recorded", about, lambda: parts.recorded(cfg, decisions)))
    return found


def _signal(gradients: Sequence[Tensor], decisions: Sequence[int]) -> Measured | None:
    few = len(gradients) < 3
    return None if few else signal(torch.stack(list(gradients)), sum(decisions) / len(decisions))


def _along(one: Sequence[Tensor], other: Sequence[Tensor], apart: bool = True) -> Measured | None:
    few = min(len(one), len(other)) < 3
    return None if few else alignment(torch.stack(list(one)), torch.stack(list(other)), apart)


def rows_by_lambda(found: Found) -> list[dict[str, Any]]:
    """Signals, and cosines of the true directions with that of recorded decisions at the largest lambda."""
    last, truth = list(found.by_lambda.items())[-1]
    return [
        {
            "lambda": lam,
            **mine.signals(),
            "imagined_along_recorded": _along(mine.imagined, truth.recorded),
            "recorded_along_themselves": None
            if lam == last
            else _along(mine.recorded, truth.recorded, apart=False),
        }
        for lam, mine in found.by_lambda.items()
    ]


def rows_by_task(found: Found) -> list[dict[str, Any]]:
    """Signals, and cosines of the true directions of imagined and recorded decisions of the same task."""
    return [
        {
            "task": task,
            **mine.signals(),
            "imagined_along_recorded": _along(mine.imagined, mine.recorded),
        }
        for task, mine in sorted(found.by_task.items())
    ]


def tables(
    lambdas: Sequence[Mapping[str, Any]], tasks: Sequence[Mapping[str, Any]], found: Found, batches: int
) -> str:
    """Markdown, and what follows for the lambda in use."""
    each = round(sum(found.by_lambda[found.used].imagined_decisions) / batches)
    shown = []
    for row in lambdas:
        lam = "none" if row["lambda"] is None else f"{row['lambda']:g}"
        used = " (in use)" if found.used == row["lambda"] else ""
        shown.append([lam + used, *map(_said, list(row.values())[1:])])
    lines = [
        f"Signal per {PER} decisions, and cosines of true directions [95% interval], of {batches} batches of"
        f" {each} imagined decisions",
        "",
        markdown_table(["lambda", *_COLUMNS, "recorded along themselves"], shown),
    ]
    if tasks:
        each_task = [[row["task"], *map(_said, list(row.values())[1:])] for row in tasks]
        lines += ["", markdown_table(["task, with the lambda in use", *_COLUMNS], each_task)]
    (mine,) = (row for row in lambdas if row["lambda"] == found.used)
    return "\n".join([*lines, "", *_follows(mine, each)])


def _follows(row: Mapping[str, Any], decisions: int) -> list[str]:
    """What a row means for who sets rl.envs and rl.recorded."""
    imagined, recorded, along = (row[key] for key in ("imagined", "recorded", "imagined_along_recorded"))
    if not imagined.found:
        least = PER / max(imagined.value + 2 * imagined.error, 1e-9)
        return [
            f"No signal was found in imagined decisions: a gradient that is half signal takes {least:.0f} of"
            f" them at least, and an iteration has {decisions}. More rl.envs or rounds.iterations, or a"
            " truer world."
        ]
    lines = [
        f"A gradient that is half signal takes {PER / imagined.value:.0f} imagined decisions (the gradient"
        f" noise scale); an iteration has {decisions}."
    ]
    if recorded is not None and recorded.found and along is not None and along.value > 0:
        times = recorded.value / (imagined.value * along.value**2)
        lines.append(
            f"One recorded decision tells as much of the true direction as {times:.1f} imagined ones."
        )
    return lines


def _said(cell: Measured | None) -> str:
    return "-" if cell is None else cell.interval()
