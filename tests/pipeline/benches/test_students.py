"""The benches of students and of strides, at sizes that say nothing but that they run, and go on."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

from actors.factory import build_simulator
from envs.targets import ConfigError
from pipeline.benches import distil as students
from pipeline.benches.bench import config_of
from pipeline.benches.distil import STUDENT, TEACHER, distil, reached
from pipeline.benches.strides import strides
from pipeline.config import load_config
from tests.learners.models import stepwise_engines
from tests.sampling import every

TINY = (
    *("experiment=soak", "task.horizon=8", "policy.width=64", "track=disabled", "threads=1"),
    *("task.suite.cameras=[head]", "launch.workers=1", "collect.episodes.held_out=1", "name=bench"),
)
RECORDED = ("experiment=soak", "task=lerobot", "task.size=[32,32]", "task.horizon=8", "threads=1")
STUDENTS = (
    *("simulator=dit_small", "distill.steps=2", "tokenizer_fit={steps: 2, batch: 4}"),
    *("distill.first.fit={steps: 4, batch: 2}", "distill.method.critic_updates=1"),
    "state_fit.first.fit={steps: 2, batch: 4}",
)


@pytest.mark.long
def test_students_and_teacher_stand_in_one_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(students, "TEACHER", (2,))
    monkeypatch.setattr(students, "STUDENT", (2, 1))
    cfg = load_config([*TINY, *STUDENTS, f"runs={tmp_path}"])
    found = distil(cfg)
    few = ["not distilled", "DMD2", "TrajectoryRegression"]
    titles = ["teacher, 2", *(f"{name}, {steps}" for name in few for steps in (2, 1))]
    assert list(found) == titles
    assert all(math.isfinite(value) for row in found.values() for value in row.values())
    assert json.loads((tmp_path / "bench/distil.json").read_text()) == found
    said = capsys.readouterr().out
    assert said.count("\n| ") == 2 + len(titles)
    for row in found.values():
        assert sum(row[f"judge_{name}"] for name in ("tp", "fp", "fn", "tn")) > 0
    assert said.count("TrajectoryRegression, 1: m") == 1 and "teacher, 2: m" not in said
    assert "not distilled, 1: m" not in said
    graph, *_ = students.build_table(cfg, tmp_path)
    for steps in (2, 1):
        made = [graph.nodes[f"student-{name}-{steps}"].cfg["distill"] for name in few[1:]]
        assert [own["steps"] for own in made] == [steps, steps]
        # two updates of the student, and two of DMD2's critic
        assert [own["first"]["fit"]["steps"] for own in made] == [4, 2]
    assert distil(cfg) == found and "is finished, reused" in capsys.readouterr().out


@pytest.mark.parametrize("engine", every(3, stepwise_engines()))
def test_every_row_can_be_built_of_every_engine_before_any_work(engine: str, tmp_path: Path) -> None:
    words = [f"simulator={engine}", "task.chunk=5", "task.horizon=20", "task.suite.cameras=[head,hand_left]"]
    graph, rows, left = students.build_table(config_of("distil", words), tmp_path)
    names = ("not distilled", "DMD2", "TrajectoryRegression")
    titles = [f"teacher, {n}" for n in TEACHER] + [f"{name}, {n}" for name in names for n in STUDENT]
    assert [title for title in titles if title not in left] == list(rows)
    assert left.keys() <= {"teacher, 1"}  # of which no step would have a length
    for title, name in rows.items():
        sampler = build_simulator(graph.nodes[name].cfg).sampler
        assert title.endswith(f", {sampler.evaluations}") and sampler.jumps != title.startswith("teacher")
    teacher = graph.nodes["simulator"].cfg["simulator"]
    assert build_simulator({**graph.cfg, "simulator": teacher}).sampler.evaluations == 15
    key = "sampling" if "sampling" in teacher else "denoising"
    fewer = config_of("distil", [*words, f"simulator.{key}.steps=6"])["simulator"]
    assert fewer == {**teacher, key: {**teacher[key], "steps": 6}}


@pytest.mark.parametrize("bench", ["distil", "strides"])
@pytest.mark.long
def test_what_a_bench_says_of_its_own_task_is_not_said_of_another(bench: str) -> None:
    assert config_of(bench, [])["task"]["suite"]["cameras"] == ["head"]
    for words in (["task=lerobot", "task.data=[somewhere]"], ["task=metaworld"]):
        chosen = config_of(bench, words)["task"]
        assert (chosen["horizon"], chosen["size"]) == ({"distil": 64, "strides": 48}[bench], [32, 32])
        assert chosen["suite"] is None or "head" not in chosen["suite"]["cameras"]
    assert (
        "width"
        not in config_of(bench, ["simulator=gesim_tiny", "task.chunk=5", "task.horizon=60"])["simulator"]
    )


def test_a_student_meets_all_that_it_should_or_it_is_said_what_it_missed() -> None:
    def row(evaluations: int, *figures: float | None) -> dict[str, float | None]:
        names = ("speed_1", "speed_32", "rollout_psnr", "rollout_detail", "judge_gap")
        return {"evaluations": evaluations, **dict(zip(names, figures, strict=True))}

    teacher = row(0, 10.0, 20.0, 25.0, 0.9, -4.0)
    rows = {
        "DMD2, 3": row(3, 41.0, 80.0, 24.5, 0.75, 4.0),
        "DMD2, 8": row(8, 41.0, 79.0, 24.4, 0.75, 4.1),
        "mean picture": row(1, 90.0, 90.0, 26.0, 0.5, 0.0),
        "nobody judged": row(3, 41.0, 80.0, 24.5, 0.75, None),
    }
    met, missed, mean, unknown = reached({"teacher, 15": teacher, "not distilled, 1": teacher, **rows})
    assert met.startswith("DMD2, 3: met (4.1 and 4.0 times the frames/s of teacher, 15 at 1 and 32, 0.50 dB")
    assert missed.startswith("DMD2, 8: missed by 8 evaluations, frames/s, PSNR, gap to truth (")
    assert mean.startswith("mean picture: missed by detail (") and "56% of its detail" in mean
    assert unknown.startswith("nobody judged: missed by gap to truth (")
    assert unknown.endswith("imagined less true success unknown and -4.0 points)")


@pytest.mark.long
def test_strides_reach_as_many_times_further(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = [*TINY, "simulator_fit.first.strides=[1,2]", f"runs={tmp_path}"]
    found = strides(load_config(words))
    assert list(found) == [1, 2] and found[2]["covers"] == 2 * found[1]["covers"]
    for row in found.values():
        verdicts = row.pop("verdicts")
        assert all(math.isfinite(value) for value in row.values())
        assert verdicts.keys() == {"generated", "recorded"}
    assert "| verdicts right |" in capsys.readouterr().out
    (recorded,) = tmp_path.glob("bench/strides/collect-*/dataset")
    own = [*RECORDED, f"task.data=[{recorded}]", f"runs={tmp_path}"]
    cfg = load_config([*own, "simulator_fit.first.strides=[1,2]", "name=recorded"])
    for row in strides(cfg).values():
        assert math.isfinite(row["psnr"]) and row["verdicts"]
    graph, rows, _ = students.build_table(load_config([*own, *STUDENTS, "name=few"]), tmp_path / "few")
    assert "recordings" in graph.needs(list(rows.values())) and "collect" not in graph.nodes
    info = recorded / "meta/info.json"  # as of a set that says nothing of success
    told = json.loads(info.read_text())
    told["features"] = {name: value for name, value in told["features"].items() if "success" not in name}
    info.write_text(json.dumps(told))
    cfg = load_config([*own, "simulator_fit.first.strides=[1,2]", "name=unlabelled"])
    assert all(row["verdicts"] == {} for row in strides(cfg).values())
    graph, rows, _ = students.build_table(load_config([*own, *STUDENTS, "name=few"]), tmp_path / "none")
    assert not any(name.startswith("judge") for name in graph.needs(list(rows.values())))


def test_benches_say_what_they_cannot_do() -> None:
    with pytest.raises(ConfigError, match=r"distill\.steps=0 is without a student"):
        distil(load_config([*TINY, "simulator=dit_small"]))
    with pytest.raises(ConfigError, match="UNetSimulator does not denoise in steps; choose simulator=dit"):
        config_of("distil", ["simulator=unet_small"])
