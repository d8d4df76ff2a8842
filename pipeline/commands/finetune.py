"""worldloop finetune: a simulator and its state expert trained on any LeRobot data sets of one robot, from
released or earlier weights.

Stages of the same kind as the loop's: reused when finished, resumed when interrupted.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from actors.world_config import check_state_expert
from envs.targets import ConfigError
from pipeline.acting import acting
from pipeline.graph.graph import Graph
from pipeline.outside import CHECKPOINT, KINEMATICS, STATE_CHECKPOINT, WEIGHTS, files_at, fingerprint
from pipeline.stages import finetune


def build_finetune(cfg: Mapping[str, Any], root: Path) -> Graph:
    """The graph of the stages: the tokenizer of a simulator that has one to train and begins from nothing,
    simulator, its student if distill.steps asks for one, and state.

    Raises:
        ConfigError: if finetune.data names no data sets, or the state expert cannot be their robot's.
    """
    data = [str(Path(folder).resolve()) for folder in cfg["finetune"]["data"]]
    if not data:
        raise ConfigError(
            "finetune.data names no data sets; finetune.data=[folder] (`worldloop convert` makes them of"
            " foreign recordings)"
        )
    # The robot is the one of the recordings, whatever bench the config knows.
    recorded = {**cfg, "task": {**cfg["task"], "suite": None, "data": data}}
    check_state_expert(recorded)
    graph, mark = Graph(acting(recorded), root / "finetune"), fingerprint(data, "finetune.data")
    released = files_at(cfg, CHECKPOINT, KINEMATICS, WEIGHTS)
    learning = graph.under(recorded)  # with the simulator as it is, not as it is acted in
    warm = ""
    if "codec" in cfg["simulator"] and not cfg["finetune"]["weights"]:
        warm = learning.add("tokenizer", finetune.tokenizer, fingerprint=mark, **released)
    made = learning.add("simulator", finetune.simulator, {"warm": warm}, fingerprint=mark, **released)
    if cfg["distill"]["steps"]:
        made = learning.add("student", finetune.student, {"simulator": made}, fingerprint=mark)
    files = files_at(cfg, STATE_CHECKPOINT)
    graph.add("state", finetune.state, {"simulator": made}, fingerprint=mark, **files)
    return graph
