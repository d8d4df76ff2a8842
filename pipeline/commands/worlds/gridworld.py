"""worldloop gridworld: how to encode actions for a world (WPE, figure 3), by squares that they move."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from actors.factory import build_simulator
from envs.files import write_json
from envs.simulators.replay import replay
from envs.targets import TARGET
from pipeline.evaluation.measurement import followed
from pipeline.evaluation.squares import square_errors
from pipeline.graph.graph import Graph
from pipeline.graph.stage import WEIGHTS
from pipeline.markdown import markdown_table
from pipeline.stages import collect, world
from pipeline.stages.given import open_store
from pipeline.track import Tracker

# How actions are encoded: sections simulator.actions. Velocities are real numbers; told in whole pixels,
# squares would be 2 pixels off after 50 steps, whatever a world makes of the text.
REPRESENTATIONS = {
    "numbers": {TARGET: "envs.conditioning.ActionVector"},
    "digits": {TARGET: "envs.conditioning.ActionText", "decimals": 2},
}
STEPS = (1, 5, 10, 25, 50)


def variant(cfg: Mapping[str, Any], squares: int, representation: str) -> dict[str, Any]:
    """The config of a world of so many squares whose actions are encoded as REPRESENTATIONS names it."""
    suite, task = {**cfg["task"]["suite"], "squares": squares}, cfg["task"]
    simulator = {**cfg["simulator"], "actions": REPRESENTATIONS[representation]}
    return {**cfg, "task": {**task, "suite": suite}, "simulator": simulator}


def gridworld(cfg: Mapping[str, Any], root: Path, squares: Sequence[int], tracker: Tracker | None) -> str:
    """Train a world for each number of squares and each way to encode actions, and measure it; a table.

    Finished stages are reused, interrupted ones resume; what is measured is written to gridworld.json as soon
    as it is known.

    Args:
        cfg: the resolved config of experiment=gridworld.
        root: the run's folder.
        squares: numbers of squares.
    """
    rows: list[dict[str, Any]] = []
    for count in squares:
        for representation in REPRESENTATIONS:
            row = {
                "squares": count,
                "representation": representation,
                **_measured(variant(cfg, count, representation), root, tracker),
            }
            rows.append(row)
            write_json(root / "gridworld.json", rows)
            print(f"{count} squares, actions as {representation}: {row['errors']}", flush=True)
    return table(rows)


def _measured(cfg: Mapping[str, Any], root: Path, tracker: Tracker | None) -> dict[str, Any]:
    """Train one world, and roll it out over the held-out episodes under their true actions."""
    graph = Graph(cfg, root / "stages")
    data = [graph.add("collect", collect.collect)]
    codec = graph.add("tokenizer", world.tokenizer, {"data": data})
    name = graph.add("simulator", world.simulator, {"data": data, "warm": codec}, phase="first")
    manifests = graph.run(tracker=tracker)
    inputs = graph.inputs(name)
    store = open_store(cfg, inputs)
    held = followed(store, store.split("held_out"))
    simulator = build_simulator(cfg, graph.folder(name) / WEIGHTS)
    made = replay(simulator, store, held, bf16=cfg["simulator"]["bf16"])
    steps = tuple(step for step in STEPS if step <= made.valid.shape[1])
    return {
        "parameters": sum(p.numel() for p in simulator.parameters() if p.requires_grad),
        "training_seconds": manifests[name]["seconds"],
        "episodes": len(held),
        "errors": square_errors(store, held, made, steps),
    }


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Markdown: error in pixels of a 256 x 256 picture, median (90th percentile), lost squares."""
    steps = list(rows[0]["errors"])
    heads = [f"after {step}" for step in steps]
    title = (
        "Distance of squares from where they truly are, in pixels of a 256 x 256 picture under true actions:"
        " median (90th percentile), lost squares; at the end of a row, squares that are taken to stand still"
    )
    lines = []
    for row in rows:
        found = [row["errors"][step] for step in steps]
        still = "-" if found[-1]["still"] is None else f"{found[-1]['still']:.0f}"
        what = [f"{row['squares']}", row["representation"], f"{row['parameters'] / 1e6:.1f}"]
        lines.append([*what, *map(_cell, found), still])
    return f"{title}\n\n" + markdown_table(["squares", "actions as", "M parameters", *heads, "still"], lines)


def _cell(found: Mapping[str, Any]) -> str:
    """What `square_errors` found after some step."""
    error, lost = found["error"], found["lost"]
    if lost is None:
        return "no square to be seen"
    return "all lost" if error is None else f"{error['median']:.1f} ({error['p90']:.1f}), {100 * lost:.0f}%"
