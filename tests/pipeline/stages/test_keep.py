"""A policy that got worse is left behind; one that had bad luck is not."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from pipeline.graph.graph import Graph
from pipeline.graph.stage import Inputs, stage
from pipeline.graph.view import ConfigView
from pipeline.stages.keep import got_worse, keep


@stage(reads=())
def deployed(cfg: ConfigView, folder: Path, inputs: Inputs) -> dict[str, Any]:
    """A policy that was deployed. Settings: success, episodes, round."""
    (folder / "weights.safetensors").write_text(str(inputs.settings["success"]))
    return dict(inputs.settings)


@pytest.mark.parametrize(
    ("tried", "known", "worse"),
    [
        ((0.42, 400), (0.44, 800), False),  # two points, where a standard error is three
        ((0.36, 400), (0.44, 800), True),
        ((0.5, 400), (0.44, 800), False),
        ((0.0, 40), (0.0, 40), False),
        ((1.0, 40), (1.0, 40), False),
        ((0.0, 0), (0.4, 40), True),  # nothing is known of it
        ((0.1, 40), (0.0, 0), False),
    ],
)
def test_only_what_chance_does_not_explain_is_worse(
    tried: tuple[float, int], known: tuple[float, int], worse: bool
) -> None:
    assert got_worse(tried, known) is worse


@pytest.mark.parametrize(("success", "kept"), [(0.42, True), (0.3, False)])
def test_the_stage_hands_on_the_policy_and_what_is_known_of_it(
    success: float, kept: bool, tmp_path: Path
) -> None:
    graph = Graph({"launch": {}}, tmp_path)
    new = graph.add("new", deployed, success=success, episodes=400, round=2)
    old = graph.add("old", deployed, success=0.44, episodes=800, round=1)
    roles = {"candidate": new, "tried": new, "incumbent": old, "known": old}
    first = graph.add("keep-2", keep, roles)
    # What was kept is known by the deployment that it had.
    graph.add("keep-3", keep, {"candidate": old, "tried": old, "incumbent": first, "known": first})
    results = {name: row["result"] for name, row in graph.run().items()}
    assert results["keep-2"] == {
        "kept": kept,
        "success": success if kept else 0.44,
        "episodes": 400 if kept else 800,
        "candidate": success,
        "round": 2 if kept else 1,  # whose episodes RL goes on with
    }
    assert results["keep-3"]["kept"] and results["keep-3"]["round"] == 1
    chosen = (graph.folder(first) / "weights.safetensors").read_text()
    assert chosen == str(success if kept else 0.44)
