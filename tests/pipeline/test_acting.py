"""Policies act in the student where there is one, and the simulator that it is made of stays what it is."""

from __future__ import annotations

from pathlib import Path

from pipeline.acting import acting
from pipeline.config import load_config
from pipeline.loop import build_loop

WORDS = ["experiment=smoke", "simulator=dit_small"]


def test_without_steps_the_simulator_itself_is_acted_in(tmp_path: Path) -> None:
    cfg = load_config(WORDS)
    assert acting(cfg) is cfg
    assert not [name for name in build_loop(cfg, tmp_path).nodes if name.startswith("student")]


def test_a_student_stands_between_the_simulator_and_all_that_act_in_it(tmp_path: Path) -> None:
    plain = build_loop(load_config(WORDS), tmp_path)
    graph = build_loop(load_config([*WORDS, "distill.steps=1"]), tmp_path)
    for number in (1, 2):
        name = f"student-{number}"
        assert graph.nodes[name].inputs["simulator"] == f"simulator-{number}"
        for other in ("state", "judge", "gap", "rl"):
            node = graph.nodes[f"{other}-{number}"]
            assert node.inputs["simulator"] == name, node.inputs
            assert node.cfg["simulator"]["denoising"] == {
                **plain.cfg["simulator"]["denoising"],
                "sampler": "distilled",
                "steps": 1,
            }
    # what came before is reused, as is the next simulator, which goes on from this one and not from a student
    assert graph.key("simulator-1") == plain.key("simulator-1")
    assert graph.key("tokenizer") == plain.key("tokenizer")
    assert graph.nodes["simulator-2"].inputs["warm"] == "simulator-1"
    assert graph.nodes["student-2"].inputs["warm"] == "student-1"
    assert graph.inputs("evaluate-imagined").folder("simulator") == graph.folder("student-2")
