"""Each study that configs/study offers, on the tiniest engines: it runs, goes on, and fills all its cells."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from actors.process import prepare_process
from envs.targets import ConfigError
from pipeline.study.plan import Study, plan_study
from pipeline.study.run import run_study

pytestmark = pytest.mark.slow

SOAK = ("experiment=soak", "track=disabled", "launch.workers=1", "cameras=main", "study.seeds=[0]")


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where all studies run: what they have in common is computed once."""
    return tmp_path_factory.mktemp("studies")


def planned(root: Path, words: Sequence[str]) -> Study:
    study = plan_study([*SOAK, f"runs={root}", *words])
    prepare_process(study.cfg["seed"], study.cfg["threads"])
    return study


def table_of(root: Path) -> dict[str, Any]:
    return dict(json.loads((root / "soak/study.json").read_text()))


def row(name: str, *changes: str) -> str:
    return f"study.methods.{name}.changes={list(changes)}"


WORLDS = (
    *(
        "study=worlds",
        "study.rows=[unet,tokens]",
        "study.places=[push]",
        "equal_time={seconds: 1, measured: 2}",
    ),
    *(row("unet", "simulator=unet_small"), row("tokens", "simulator=tokens_small"), "fidelity.episodes=2"),
    *("rounds.deploy=[8]", "rounds.splits.held_out=0.25"),
)


@pytest.mark.long
def test_worlds_stand_side_by_side_after_equal_time(root: Path) -> None:
    text = run_study(planned(root, WORLDS))
    assert "not run" not in text and "## Side by side" in text and "Best in push, of what was run: " in text
    table = table_of(root)
    assert [entry["title"] for entry in table["rows"]] == ["unet, push", "tokens, push"]
    study = planned(root, WORLDS)
    for entry, cells in zip(study.rows, (one["cells"] for one in table["rows"]), strict=True):
        graph = entry.made.graph
        speeds, settings = graph.result("pace"), graph.nodes["simulator-1"].settings
        steps = round(settings["seconds"] * speeds["simulator_speed"] / 2)
        assert (
            cells["training"]["simulator"]["steps"] == max(1, steps) == graph.result("simulator-1")["steps"]
        )
        assert ("tokenizer" in cells["training"]) == (entry.name == "tokens") == ("tokenizer" in graph.nodes)
        assert not (graph.folder("pace") / "trial").exists()
    stages = sorted(root.glob("soak/stages/*/manifest.json"))
    made = {path: path.stat().st_mtime_ns for path in stages}
    assert len({entry.made.graph.key("deploy-1") for entry in study.rows}) == 1  # the same data
    assert run_study(study) == text and {path: path.stat().st_mtime_ns for path in made} == made
    unet, control = planned(root, [*WORLDS, "study.rows=[unet,without_imagined]"]).rows
    graphs = (unet.made.graph, control.made.graph)
    assert [graph.cfg["rl"]["imagined"] for graph in graphs] == [1.0, 0.0]  # the world is trained once


TOKENS = (
    *("study=tokens", "study.rows=[adaln,raster]", "study.places=[]", "simulator=tokens_small"),
    *("equal_time={seconds: 1, measured: 2}", "fidelity.episodes=2", "task.horizon=8"),
)


@pytest.mark.long
def test_worlds_of_tokens_differ_in_what_their_rows_say(root: Path) -> None:
    assert "not run" not in run_study(planned(root, TOKENS))
    assert {"training", "rollout", "speed", "verdicts"} <= set(table_of(root)["rows"][0]["cells"])
    every = "study.rows=[cross,adaln,maskgit2,maskgit8,raster]"
    rows = {entry.name: entry.made.graph for entry in planned(root, [*TOKENS, every]).rows}
    sections = {name: graph.cfg["simulator"] for name, graph in rows.items()}
    told = {name: section["conditioning"]["_target_"].split(".")[-1] for name, section in sections.items()}
    assert told == {name: "AdaLN" if name == "adaln" else "CrossAttention" for name in rows}
    assert "steps" not in sections["raster"]["decoding"]
    assert [sections[name]["decoding"]["steps"] for name in ("maskgit2", "maskgit8")] == [2, 8]


STUDENTS = (
    *(
        "study=students",
        "study.rows=[teacher,one]",
        "simulator=dit_small",
        "tokenizer_fit={steps: 2, batch: 4}",
    ),
    *("distill.first.fit={steps: 5, batch: 2}", "distill.method.critic_updates=1", "fidelity.episodes=2"),
    *("task.horizon=8", "rounds.deploy=[8]", "rounds.splits.held_out=0.25", "rounds.clone=0"),
    *(
        row("teacher", "simulator.denoising.steps=2"),
        row("one", "simulator.denoising.steps=2", "distill.steps=1"),
    ),
)


@pytest.mark.long
def test_students_gain_by_the_same_rl_as_their_teacher(root: Path) -> None:
    assert "not run" not in run_study(planned(root, STUDENTS))
    cells = [entry["cells"] for entry in table_of(root)["rows"]]
    assert all({"gain", "gap", "verdicts", "speed", "rollout"} <= set(each) for each in cells)
    teacher, student = (entry.made.graph for entry in planned(root, STUDENTS).rows)
    shared = ("collect", "imitation", "tokenizer", "simulator-1")
    assert all(teacher.key(name) == student.key(name) for name in shared)
    assert teacher.key("rl-1") != student.key("rl-1")
    assert student.nodes["rl-1"].settings == teacher.nodes["rl-1"].settings


def test_students_stand_beside_a_baseline_and_a_teacher_of_as_few_steps(root: Path) -> None:
    words = ["study=students", "simulator=dit_small"]
    rows = {entry.name: entry.made.graph for entry in planned(root, words).rows}
    control = rows.pop("without_imagined")  # the teacher's world, out of which nothing is learned
    assert control.cfg["rl"]["imagined"] == 0.0
    assert control.key("simulator-1") == rows["teacher"].key("simulator-1")
    assert list(rows) == ["teacher", "undistilled", "four", "two", "one", "trajectory"]
    assert [name for name, graph in rows.items() if "student-1" not in graph.nodes] == list(rows)[:2]
    taken = {name: graph.cfg["simulator"]["denoising"]["steps"] for name, graph in rows.items()}
    assert list(taken.values()) == [15, 4, 4, 2, 1, 4]
    made = {name: graph.nodes["student-1"].cfg["distill"] for name, graph in list(rows.items())[2:]}
    kinds = {name: section["method"]["_target_"].rpartition(".")[2] for name, section in made.items()}
    assert kinds == {name: "TrajectoryRegression" if name == "trajectory" else "DMD2" for name in made}
    # of DMD2's steps so many are the student's
    share = made["four"]["method"]["critic_updates"] + 1
    for phase in ("first", "refresh"):
        steps = {name: section[phase]["fit"]["steps"] for name, section in made.items()}
        assert steps["four"] == share * steps["trajectory"]


ROBOSCAPE = (
    *("study=roboscape", "task=tabletop", "task.horizon=32", "task.suite.cameras=[head]"),
    *("judge=golden_goal", "simulator=tokens_small", "study.places=[two_tasks]"),
    *("judge.fallback=last_frame", "rounds.clone=0"),
    *("evaluate.episodes=4", "evaluate.envs=4", "extra_starts.variants=[out_of_domain]"),
    *("extra_starts.episodes=2", "rl.envs=4"),
)


@pytest.mark.long
def test_roboscapes_table_has_both_tasks_in_and_out_of_domain(root: Path) -> None:
    assert "not run" not in run_study(planned(root, ROBOSCAPE))
    table = table_of(root)
    assert [entry["row"] for entry in table["rows"]] == ["supervised", "physics", "world"]
    for column in ("success", "out_of_domain"):
        assert table["columns"][column]["labels"] == ["pick_place", "move_to_aim", "all"]
        assert all(entry["cells"][column]["all"]["episodes"] == 4 for entry in table["rows"])
    assert {entry["other"] for entry in table["comparisons"]} == {"supervised", "physics"}


CURVES = (
    *("study=reward_curves", "study.rows=[rule,proxy,golden_goal]", "rl.evaluate_every=2"),
    *("rl.evaluate_episodes=2", "rounds.clone=0", "task.horizon=8"),
)


@pytest.mark.long
def test_success_is_drawn_against_training_time_under_each_reward(root: Path) -> None:
    assert "not run" not in run_study(planned(root, CURVES))
    page = (root / "soak/study.html").read_text()
    assert page.count('<path class="line') == 3 and "seconds of rollouts and updates" in page
    study = planned(root, CURVES)
    for entry in study.rows:
        found = study.read(entry, "curve")
        assert found is not None
        seconds = [x for x, _ in found.curve]
        assert len(seconds) >= 2 and seconds == sorted(set(seconds)) and seconds[0] == 0.0
    assert len({entry.made.graph.key("simulator-1") for entry in study.rows}) == 1  # the same world
    with pytest.raises(ConfigError, match=r"study\.measures\.curve in the row rule: rl\.evaluate_every=0"):
        planned(root, [*CURVES, "rl.evaluate_every=0"])


DATA = (
    *("study=data_size", "study.rows=[quarter,whole]", "study.places=[]", "fidelity.episodes=2"),
    *("policy_value={noise: [0.5], experts: [0.0, 1.0], starts: 2, repeats: 2}", "simulator=forcing_small"),
    *("task.horizon=8", "judge_fit.first.imagined=2"),
)


@pytest.mark.long
def test_worlds_of_fewer_episodes_are_tried_on_the_same_ones(root: Path) -> None:
    assert "not run" not in run_study(planned(root, DATA))
    quarter, whole = planned(root, DATA).rows
    graphs = quarter.made.graph, whole.made.graph
    assert graphs[0].result("fewer") == {"train": 2, "held_out": 2, "calibration": 1}
    shared = ("collect", "imitation", "true-values")
    assert all(graphs[0].key(name) == graphs[1].key(name) for name in shared)
    assert graphs[0].key("simulator-1") != graphs[1].key("simulator-1")
    counts = [graph.result("estimated-values")["micro"] for graph in graphs]
    # four candidates from two starts, twice each
    assert all(sum(count[name] for name in ("tp", "fp", "fn", "tn")) == 16 for count in counts)


JUDGES = (
    "study=judges",
    "study.rows=[proxy,golden_goal]",
    "task.horizon=8",
    "study.measures.frames.episodes=2",
)


@pytest.mark.long
def test_judges_are_shown_more_and_fewer_frames(root: Path) -> None:
    text = run_study(planned(root, JUDGES))
    assert "not run" not in text and "first and last" in text and "(2 frames)" in text
    with pytest.raises(
        ConfigError, match=r"in the row proxy: judge=.*Embedding.* reads a simulator's features"
    ):
        planned(root, [*JUDGES, row("proxy", "judge=embedding")])
