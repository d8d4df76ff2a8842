"""Policies act in the student where there is one, and the simulator that it is made of stays what it is."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from envs.simulators.dit.engine import DiTSimulator
from envs.targets import ConfigError
from pipeline.acting import acting
from pipeline.cli.runs import stage_named
from pipeline.config import load_config
from pipeline.loop import build_loop
from pipeline.stages.world import lacking_strides

WORDS = ["experiment=smoke", "simulator=dit_small"]


def test_without_steps_the_simulator_itself_is_acted_in(tmp_path: Path) -> None:
    cfg = load_config(WORDS)
    assert acting(cfg) is cfg
    assert not [name for name in build_loop(cfg, tmp_path).nodes if name.startswith("student")]


class Careless(DiTSimulator):
    """An engine whose students would remember less than their teachers."""

    @classmethod
    def student_section(cls, section: Mapping[str, Any], steps: int) -> dict[str, Any]:
        return {**super().student_section(section, steps), "memory_frames": 1}


def test_a_student_that_lacks_strides_of_its_teacher_gives_an_alarm(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert lacking_strides("distill.first", (1, 2), "simulator_fit.first", (2, 1)) == {}
    alarm = lacking_strides("distill.first", [1], "simulator_fit.first", [1, 2, 4])["alarm"]
    assert alarm.startswith("distill.first.strides=[1] lacks [2, 4] of simulator_fit.first.strides")
    assert alarm.endswith("say distill.first.strides=[1, 2, 4]") and alarm in capsys.readouterr().out


def test_students_that_are_conditioned_otherwise_are_refused_before_any_work() -> None:
    words = [*WORDS, "distill.steps=1", f"simulator._target_={__name__}.Careless"]
    with pytest.raises(ConfigError, match=r"differently: simulator\.memory_frames: \d and 1; student"):
        load_config(words)


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
    assert stage_named("distill", list(graph.nodes)) == "student-2"
    with pytest.raises(ConfigError, match="no stage student-3; did you mean student-"):
        stage_named("student-3", list(graph.nodes))
