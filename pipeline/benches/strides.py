"""worldloop bench strides: one world that shows every, every second or every fourth frame: how far a chunk
reaches, what a rollout costs, how well it agrees with the truth at the frames that all of them show, and how
many verdicts of the judge are right.

Open loop, under recorded actions. Every part is a stage of a graph of its own, so the bench goes on where it
was stopped.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from actors.factory import build_judge, build_simulator
from actors.process import prepare_process
from envs.files import write_json
from envs.simulators.replay import replay
from pipeline.acting import acting
from pipeline.cli.words import root_of
from pipeline.evaluation.fidelity.strides import VERDICTS, common_stride
from pipeline.evaluation.fidelity.verdicts import judged, verdict_tables, verdict_text
from pipeline.evaluation.judging import thinned
from pipeline.evaluation.statistics import mean
from pipeline.graph.graph import Graph
from pipeline.graph.stage import Inputs, Place, stage
from pipeline.loop import World, add_episodes, add_world, can_be_taught
from pipeline.markdown import markdown_table
from pipeline.stages.given import WORLD, Cfg, open_store
from pipeline.stages.judging.cost import priced

_EPISODES = 48  # held-out ones that are measured
_HEADINGS = (
    *("stride", "a chunk covers", "seconds per episode", "PSNR, all shown", "PSNR, frames shown by all"),
    *VERDICTS,
)


def strides(cfg: dict[str, Any]) -> dict[int, dict[str, Any]]:
    """Print the table, and leave it in strides.json of the run's folder; returns the figures by stride."""
    prepare_process(cfg["seed"], cfg["threads"])
    root = root_of(cfg)
    graph, rows = build_table(cfg, root / "strides")
    graph.run(list(rows.values()))
    found = {number: graph.result(name) for number, name in rows.items()}
    write_json(root / "strides.json", found)
    lines = []
    for number, row in found.items():
        decibels = ("-" if (value := row[key]) is None else f"{value:.2f}" for key in ("psnr", "psnr_common"))
        verdicts = (verdict_text(row["verdicts"], video) for video in ("generated", "recorded"))
        lines.append([f"{number}", f"{row['covers']:.1f} s", f"{row['seconds']:.3f}", *decibels, *verdicts])
    print(markdown_table(_HEADINGS, lines))
    return found


def build_table(cfg: Mapping[str, Any], root: Path) -> tuple[Graph, dict[int, str]]:
    """The stages, and the names of those that measure, by stride: simulator_fit.first.strides."""
    graph = Graph(acting(cfg), root)
    data = add_episodes(graph, cfg)
    made, numbers = add_world(graph, cfg, data, World(), 1), sorted(cfg["simulator_fit"]["first"]["strides"])
    judge, common = made.judge if can_be_taught(cfg) else "", common_stride(numbers)
    roles = {"data": data, "simulator": made.simulator, "judge": judge}
    return graph, {n: graph.add(f"stride-{n}", measure, roles, stride=n, common=common) for n in numbers}


@stage(reads=WORLD, place=Place.EVALUATOR)
@priced
def measure(cfg: Cfg, folder: Path, inputs: Inputs) -> dict[str, Any]:
    """Rollouts of held-out episodes, and what the judge, if there is one, says of them and of the same
    recorded frames.

    Settings: stride, and common, a multiple of it, at whose frames strides are compared.
    """
    stride, common = inputs.settings["stride"], inputs.settings["common"]
    prepare_process(cfg["seed"], cfg["threads"])
    simulator, store = build_simulator(cfg, inputs.weights("simulator")), open_store(cfg, inputs)
    held, bf16 = store.split("held_out")[:_EPISODES], cfg["simulator"]["bf16"]
    replay(simulator, store, held[:1], bf16=bf16, stride=stride)  # a warm-up
    began = time.perf_counter()
    made = replay(simulator, store, held, bf16=bf16, stride=stride)
    seconds = (time.perf_counter() - began) / len(held)
    true = store.frames(made.rows)
    error = torch.stack(
        [
            ((a.float() - b.float()) / 255).square().mean((-4, -3, -2, -1))
            for a, b in zip(made.frames, true, strict=True)
        ]
    )
    psnr = -10 * error.clamp(min=1e-8).log10()
    shown = stride * torch.arange(1, psnr.shape[1] + 1)
    seen = made.pictured(store).valid
    alike = seen & (shown % common == 0)
    verdicts: dict[str, Any] = {}
    if "judge" in inputs.found:
        with thinned(build_judge(cfg, inputs.weights("judge")).eval(), stride) as judge:
            verdicts = verdict_tables(judge, store, held, [judged(judge, store, held, made)], made.valid)
    return {
        "covers": stride * store.spec.chunk / store.fps,
        "seconds": seconds,
        "psnr": mean(psnr[seen]),
        "psnr_common": mean(psnr[alike]),
        "verdicts": verdicts,
    }
