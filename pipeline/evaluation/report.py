"""report.html: what was claimed, what was measured, and how far imagination could be trusted, on one page."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
from markupsafe import Markup
from omegaconf import OmegaConf

from pipeline.evaluation.charts import Curve, line_chart, progress_chart
from pipeline.evaluation.heat import heat_maps
from pipeline.evaluation.judging import cost_text
from pipeline.evaluation.media import inline, smooth
from pipeline.evaluation.result import manifests
from pipeline.evaluation.statistics import percent_line, points_line, psnr_line, rate, rise
from pipeline.graph.stage import Inputs
from pipeline.track import read_metrics

VIDEOS = "videos.json"  # what the stage that made the videos says of each, see pipeline/stages/show.py
# Curves beside those of RL: stages, the figure that they log, and the plot's title.
_CURVES = (
    ("simulator", "simulator/loss", "Simulator loss"),
    ("judge", "judge/frame_accuracy", "Judge frame accuracy"),
    ("imitation", "imitation/loss", "Imitation loss"),
)
# Columns of the table of hosts: a figure of the RL loop's metrics, its factor and its form.
_HOSTS = (
    ("time/rollout", 1.0, "{:.1f} s"),
    ("time/update", 1.0, "{:.1f} s"),
    ("time/actors_idle_share", 100.0, "{:.0f}%"),
    ("time/forward_share", 100.0, "{:.0f}%"),
    ("time/sync_ms", 1.0, "{:.1f} ms"),
    ("wire_bytes", 2.0**-20, "{:.1f} MiB"),
    ("policy_lag", 1.0, "{:.1f}"),
)


def build_report(
    cfg: Mapping[str, Any],
    inputs: Inputs,
    result: Mapping[str, Any],
    controls: Mapping[str, Any] | None = None,
) -> str:
    """One self-contained HTML page.

    Args:
        cfg: the config to show.
        inputs: roles stages and videos.
        result: see result.py.
        controls: rows of controls.json, None before `worldloop controls` has run.
    """
    worst, tasks = _videos(inputs)
    return (
        templates()
        .get_template("report.html.j2")
        .render(
            result=result,
            heat=heat_maps(result["scenes"]),
            controls=controls,
            worst=worst,
            tasks=tasks,
            curves=_curves(inputs),
            hosts=_hosts(inputs),
            config=OmegaConf.to_yaml(OmegaConf.create({key: cfg[key] for key in cfg})),
        )
    )


def templates() -> Environment:
    """The templates of evaluation/page, with what their macros call."""
    page = Environment(
        loader=PackageLoader("pipeline", "evaluation/page"),
        autoescape=select_autoescape(["j2"]),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    page.globals |= {
        "rate": rate,
        "rise": rise,
        "percent": percent_line,
        "psnr": psnr_line,
        "points": points_line,
        "progress_chart": progress_chart,
        "cost": cost_text,
    }
    return page


def stage_folders(inputs: Inputs) -> dict[str, Path]:
    """Folders of the stages of a run, by name, in their order."""
    return dict(zip(manifests(inputs), inputs.folders("stages"), strict=True))


def _videos(inputs: Inputs) -> tuple[list[dict[str, Any]], dict[str, list[dict[str, Any]]]]:
    """Videos of the worst disagreements, and those of each task, each with its data URL and the worst first;
    of equal ones before stands left of after.
    """
    folder = inputs.folder("videos")
    worst: list[dict[str, Any]] = []
    tasks: dict[str, list[dict[str, Any]]] = {}
    for row in json.loads((folder / VIDEOS).read_text()):
        video = {**row, "url": inline((folder / "media" / row["file"]).read_bytes(), "video/mp4")}
        if row["label"] == "worst":
            worst.append(video)
        else:
            tasks.setdefault(row["task"], []).append(video)
    for videos in tasks.values():
        hardest = {row["seed"]: 0.0 for row in videos}
        for row in videos:
            hardest[row["seed"]] = max(hardest[row["seed"]], row["disagreement"])
        videos.sort(key=lambda row: row["label"], reverse=True)
        videos.sort(key=lambda row: (-hardest[row["seed"]], row["seed"]))
    return worst, dict(sorted(tasks.items()))


def _curves(inputs: Inputs) -> list[Markup]:
    """Charts of imagined success over all rounds, and of the losses of what learned."""
    folders = stage_folders(inputs)
    success, offset = [], 0
    for name, folder in folders.items():
        if not name.startswith("rl-"):
            continue
        rows = read_metrics(folder / "metrics.jsonl")
        steps = [offset + row["step"] for row in rows]
        success.append(Curve(name.replace("rl-", "round "), steps, [row["rl/success"] for row in rows]))
        offset += len(rows)
    charts = [line_chart(success, "Imagined success while learning (stochastic)", "iteration", "success")]
    for stage, figure, title in _CURVES:
        curves = []
        for name, folder in folders.items():
            rows = read_metrics(folder / "metrics.jsonl")
            values = [row[figure] for row in rows if figure in row]
            if values and name.split("-")[0] == stage:
                shown = smooth(values, 25)
                curves.append(Curve(name, list(range(len(shown))), shown))
        charts.append(line_chart(curves, title, "step", figure.split("/")[1].replace("_", " ")))
    return [chart for chart in charts if chart]


def _hosts(inputs: Inputs) -> list[list[str]]:
    """Rows of the table of hosts, one for each round of RL."""
    out = []
    finished = manifests(inputs)
    for name, folder in stage_folders(inputs).items():
        rows = read_metrics(folder / "metrics.jsonl") if name.startswith("rl-") else []
        if not rows:
            continue
        ledger = finished[name]["result"]["ledger"]
        dropped = ", ".join(f"{count} {reason}" for reason, count in ledger["dropped"].items()) or "none"
        cells = [name.replace("rl-", "round "), str(ledger["requested"]), str(ledger["learned"]), dropped]
        for figure, factor, form in _HOSTS:
            values = [row[f"rl/{figure}"] for row in rows if f"rl/{figure}" in row]
            cells.append(form.format(factor * sum(values) / len(values)) if values else "-")
        out.append(cells)
    return out
