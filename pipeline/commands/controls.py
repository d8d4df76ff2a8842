"""worldloop controls: whose gain is it? What the same physics episodes bring without RL in imagination.

Beside a finished run stand, on the same evaluation seeds:

- the loop without its RL iterations: deploy, refresh the world, clone what worked;
- the loop whose RL learns from the true decisions alone (rl.imagined=0): the rest is as it was; left out
  where RL learns from no true ones;
- RL in physics with as many episodes as the loop deployed and tried;
- RL in physics with as many environment steps as the loop imagined;
- filtered BC on everything that the loop recorded.

RL in physics is rewarded by the suite's own progress and success, which no robot knows, and not by a learned
judge: it is a bound on what a perfect judge would bring, and says so beside its rows.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from envs.files import write_json, write_text
from envs.targets import ConfigError, target
from pipeline.evaluation.report import build_report
from pipeline.evaluation.result import outcomes
from pipeline.evaluation.statistics import mcnemar, points_line, rate_entry, rate_line, rise
from pipeline.graph.graph import Graph
from pipeline.loop import build_loop, has_physics, last_round
from pipeline.stages import controls as only_here
from pipeline.stages import prove, rl
from pipeline.study.methods import EQUAL, Equal, Made, add_rl_in_physics, privileged_note
from pipeline.track import Tracker

Cfg = Mapping[str, Any]


@dataclass(frozen=True)
class Row:
    """A line of the table.

    Args:
        name: in controls.only; "" of the run itself.
        title: what it is.
        graph: the graph that holds its stages.
        node: the evaluation in physics that it shows.
        note: what must be known to compare it with the others; "" for nothing.
    """

    name: str
    title: str
    graph: Graph
    node: str
    note: str = ""


def run_controls(cfg: Cfg, root: Path, tracker: Tracker | None = None) -> dict[str, Any]:
    """Run the controls of a finished run, or those of controls.only; after each one controls.json and the
    run's report hold those that are finished by then.

    Returns:
        Rows by title: a rate entry, gain in points (None where no episode counts), paired (McNemar against
        the policy before), physics_episodes, and note where there is one.

    Raises:
        ConfigError: if the run is not finished, or has no physics; or if controls.only names a control that
            would learn from nothing.
    """
    if not has_physics(cfg):
        raise ConfigError("the controls are tried in physics, which this task has not (task.suite is empty)")
    loop = build_loop(cfg, root)
    if not (loop.folder("report") / "manifest.json").exists():
        raise ConfigError(
            f"{root} holds no finished run of this config (`worldloop stages` says what differs); the"
            " controls stand beside one: first `worldloop run` with the same options"
        )
    rows, only, table = control_rows(cfg, root, loop), cfg["controls"]["only"], dict[str, Any]()
    if "without_imagined" in only and not any(row.name == "without_imagined" for row in rows):
        raise ConfigError(f"controls.only=[without_imagined]: {rows[0].note}; leave it out")
    for row in (row for row in rows if not only or row.name in only):
        row.graph.run(row.node, tracker)
        table = control_table(loop, [row for row in rows if row.graph.finished(row.node)])
        write_json(root / "controls.json", table)
        result = json.loads((root / "result.json").read_text())
        page = build_report(loop.view("report"), loop.inputs("report"), result, table)
        write_text(root / "report.html", page)
    return table


def control_rows(cfg: Cfg, root: Path, loop: Graph) -> list[Row]:
    """The run itself and its controls, whose stages are added to the run's graph or have one of their own;
    the run's note says why there is no loop without imagined decisions, where there is none.
    """
    explored = ("explore",) if "explore" in loop.nodes else ()
    deploys = (*explored, *(f"deploy-{n}" for n in range(1, last_round(cfg) + 1)))
    learned = {equal: _rl_in_physics(loop, cfg, equal) for equal in EQUAL}
    note = privileged_note(cfg)
    loop.add("filtered-bc", only_here.filtered_bc, {"data": ["collect", *deploys]})
    loop.add("evaluate-filtered-bc", prove.evaluate_physics, {"policy": "filtered-bc"})
    without = build_loop(cfg, root, with_rl=False)
    why_not = _nothing_recorded(loop, cfg)
    blind = build_loop({**cfg, "rl": {**cfg["rl"], "imagined": 0.0}}, root)
    unimagined = Row("without_imagined", "loop without imagined decisions", blind, "evaluate-after")
    return [
        Row("", "loop", loop, "evaluate-after", why_not),
        Row("without_rl", "loop without RL iterations", without, "evaluate-after"),
        *([] if why_not else [unimagined]),
        *(
            Row(f"rl_equal_{equal}", f"RL in physics, equal {equal}", loop, f"evaluate-{name}", note)
            for equal, name in learned.items()
        ),
        Row("filtered_bc", "filtered BC", loop, "evaluate-filtered-bc"),
    ]


def control_table(loop: Graph, rows: list[Row]) -> dict[str, Any]:
    """Rows of controls.json by title, the policy before first."""
    before = loop.folder("evaluate-before")
    start = rate_entry(outcomes(before)[1][0])
    table: dict[str, Any] = {"before": {**start, "physics_episodes": 0, "paired": None}}
    for row in rows:
        after = row.graph.folder(row.node)
        entry = rate_entry(outcomes(after)[1][0])
        gain = rise(start, entry)
        table[row.title] = {
            **entry,
            "gain": None if gain is None else 100 * gain,
            "paired": mcnemar(*outcomes(before, after)[1]),
            "physics_episodes": Made(row.graph, row.node).physics_episodes().get("own", 0),
            **({"note": row.note} if row.note else {}),
        }
    return table


def table_text(table: Mapping[str, Any]) -> str:
    """The table for a terminal."""
    lines = []
    for title, row in table.items():
        paired = row["paired"]
        gain = ""
        if paired:
            flips = f"gained {paired['gained']} lost {paired['lost']} p {paired['p']:.2g}"
            points = points_line(None if row["gain"] is None else row["gain"] / 100)
            gain = f", {points} points, {flips}"
        note = f"  ({row['note']})" if row.get("note") else ""
        lines.append(f"{title:<30} {rate_line(row)}{gain}{note}")
    return "\n".join(lines)


def _nothing_recorded(loop: Graph, cfg: Cfg) -> str:
    """Why RL would learn from nothing but the anchor without imagined decisions; "" where recorded ones are
    learned from.
    """
    kind: Any = target(cfg["algorithm"], "algorithm")
    done = [
        loop.result(name) for name, node in loop.nodes.items() if node.stage is rl.rl and loop.finished(name)
    ]
    if not cfg["rl"]["recorded"]:
        why = "rl.recorded=0"
    elif not hasattr(kind, "warm_up"):
        why = f"{kind.__name__} has no critic, so it learns from no recorded ones"
    elif done and not any(one.get("recorded_decisions") for one in done):
        why = "this policy learns from no recorded ones"
    else:
        return ""
    return (
        f"not tried without imagined decisions: {why}, and nothing but the anchor (rl.anchor) would be left"
    )


def _rl_in_physics(loop: Graph, cfg: Cfg, equal: Equal) -> str:
    """Add RL in physics from the first policy and its evaluation; returns the former's name."""
    learned = add_rl_in_physics(loop, cfg, equal)
    loop.add(f"evaluate-{learned}", prove.evaluate_physics, {"policy": learned})
    return learned
