"""How much a judge must see of an episode."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from actors.factory import build_judge
from actors.process import prepare_process
from envs.targets import ConfigError
from pipeline.evaluation.judging import labelled
from pipeline.evaluation.measurement import evenly, followed
from pipeline.evaluation.rewards.shown import shown_table
from pipeline.graph.stage import Inputs, Place, stage
from pipeline.stages.given import ROBOT, Cfg, open_store
from pipeline.stages.judging.cost import priced


@stage(reads=(*ROBOT, "threads", "judge"), place=Place.EVALUATOR)
@priced
def shown_frames(cfg: Cfg, folder: Path, inputs: Inputs) -> dict[str, Any]:
    """Verdicts of the role `judge` on recorded held-out episodes by what it is shown of them.

    Settings: frames, a list of choices (evaluation/rewards/shown.py); episodes, at most so many.
    """
    prepare_process(cfg["seed"], cfg["threads"])
    store, judge = open_store(cfg, inputs), build_judge(cfg, inputs.weights("judge")).eval()
    episodes = labelled(store, followed(store, store.split("held_out")))
    if not len(episodes):
        raise ConfigError("no held-out episode of the data says whether it succeeded (next.success)")
    episodes = evenly(episodes, inputs.settings["episodes"])
    tables = {frames: shown_table(judge, store, episodes, frames) for frames in inputs.settings["frames"]}
    return {"episodes": len(episodes), "frames": tables}
