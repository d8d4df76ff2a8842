"""report.html: what was claimed, what was measured, and how far imagination could be trusted, on one page."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
from omegaconf import OmegaConf

from pipeline.evaluation.media import inline, plot, smooth
from pipeline.evaluation.result import manifests
from pipeline.evaluation.statistics import rate
from pipeline.graph.stage import Inputs
from pipeline.track import read_metrics

_TEMPLATE = "report.html.j2"
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
    loader = PackageLoader("pipeline", "evaluation")
    page = Environment(loader=loader, autoescape=select_autoescape(["j2"]), undefined=StrictUndefined)
    page.globals["rate"] = rate
    config = {key: cfg[key] for key in cfg}
    return page.get_template(_TEMPLATE).render(
        result=result,
        controls=controls,
        videos=_videos(inputs),
        curves=_curves(inputs),
        hosts=_hosts(inputs),
        config=OmegaConf.to_yaml(OmegaConf.create(config)),
    )


def stage_folders(inputs: Inputs) -> dict[str, Path]:
    """Folders of the stages of a run, by name, in their order."""
    return dict(zip(manifests(inputs), inputs.folders("stages"), strict=True))


def _videos(inputs: Inputs) -> list[dict[str, str]]:
    """Videos in pairs, as data URLs: before and after where there are both."""
    files = sorted((inputs.folder("videos") / "media").glob("*.mp4"))
    kinds = sorted({file.stem.split("-")[0] for file in files}, reverse=True)  # before stands left of after
    ordered = [[file for file in files if file.stem.split("-")[0] == kind] for kind in kinds]
    most = max((len(some) for some in ordered), default=0)
    picked = [some[k] for k in range(most) for some in ordered if k < len(some)]
    return [{"name": file.stem, "url": inline(file.read_bytes(), "video/mp4")} for file in picked]


def _curves(inputs: Inputs) -> list[str]:
    """Plots as data URLs: imagined success over all rounds, and the losses of what learned."""
    folders = stage_folders(inputs)
    success, offset = [], 0
    for name, folder in folders.items():
        if not name.startswith("rl-"):
            continue
        rows = read_metrics(folder / "metrics.jsonl")
        steps = [offset + row["step"] for row in rows]
        success.append((name.replace("rl-", "round "), steps, [row["rl/success"] for row in rows]))
        offset += len(rows)
    urls = [plot(success, "Imagined success while learning (stochastic)", "iteration", "success")]
    for stage, figure, title in _CURVES:
        curves = []
        for name, folder in folders.items():
            rows = read_metrics(folder / "metrics.jsonl")
            values = [row[figure] for row in rows if figure in row]
            if values and name.split("-")[0] == stage:
                shown = smooth(values, 25)
                curves.append((name, list(range(len(shown))), shown))
        if curves:
            urls.append(plot(curves, title, "step", figure.split("/")[1].replace("_", " ")))
    return urls


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
        cells = [name.replace("rl-", "round "), str(ledger["asked"]), str(ledger["learned"]), dropped]
        for figure, factor, form in _HOSTS:
            values = [row[f"rl/{figure}"] for row in rows if f"rl/{figure}" in row]
            cells.append(form.format(factor * sum(values) / len(values)) if values else "-")
        out.append(cells)
    return out
