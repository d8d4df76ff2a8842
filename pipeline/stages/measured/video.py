"""A world's video against the truth, frame by frame."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from actors.factory import build_simulator
from actors.process import prepare_process
from pipeline.evaluation.fidelity.open_loop import OpenLoop
from pipeline.evaluation.measurement import evenly, followed
from pipeline.graph.stage import Inputs, Place, stage
from pipeline.stages.given import TASK, Cfg, open_store


@stage(reads=("seed", "threads", *TASK, "simulator", "fidelity.episodes"), place=Place.EVALUATOR)
def video_errors(cfg: Cfg, folder: Path, inputs: Inputs) -> dict[str, Any]:
    """Errors of whole held-out episodes under their recorded actions, overall and by frame, and those of a
    world that shows the first frame for ever.
    """
    prepare_process(cfg["seed"], cfg["threads"])
    store = open_store(cfg, inputs)
    episodes = evenly(followed(store, store.split("held_out")), cfg["fidelity"]["episodes"])
    loop = OpenLoop(store, episodes, cfg["simulator"]["bf16"])
    simulator = build_simulator(cfg, inputs.weights("simulator")).eval()
    found = loop.measure(simulator).result(store.spec.embodiment.views, {})
    kept = ("episodes", "overall", "by_frame", "object_cm", "object_lost")
    still = loop.held_still().by_frame
    return {
        **{name: found[name] for name in kept},
        "still": still,
        "perceptual": loop.distance.name,
        "chunk": cfg["task"]["chunk"],
    }
