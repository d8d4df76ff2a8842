"""A small study from nothing to its table, and what is wrong with a plan."""

from __future__ import annotations

import json
import time
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
import torch

from envs.targets import ConfigError
from learners.training.interrupt import clean_ending
from pipeline.evaluation.statistics import mcnemar, rate_entry
from pipeline.study.deadline import deadline
from pipeline.study.plan import plan_study
from tests.commands import worldloop

ROWS = ("imitation", "filtered_bc", "ppo", "physics_episodes")
SMALL = (
    *("experiment=soak", "track=disabled", "task=tabletop", "task.name=[push,pull]", "task.horizon=20"),
    *("task.suite.cameras=[head]", "study.columns=[success,out_of_domain]", f"study.rows=[{','.join(ROWS)}]"),
    *("evaluate.episodes=4", "evaluate.envs=4", "rounds.trial=3", "extra_starts.variants=[out_of_domain]"),
    *("extra_starts.episodes=4", "policy.instruction_keypoints=2", "judge.instruction_keypoints=2"),
)


@pytest.mark.long
@pytest.mark.slow
def test_a_study_runs_what_is_missing_and_says_what_is_not_run(tmp_path: Path) -> None:
    words = ("study", *SMALL, f"runs={tmp_path}")
    nothing = worldloop(tmp_path / "logs", *words, "study.minutes=0")
    assert nothing.status == 0, nothing.output[-3000:]
    root = tmp_path / "soak"
    assert all(cell is None for row in table_of(root)["rows"] for cell in row["cells"]["success"].values())
    assert (root / "study.md").read_text().count("not run") == len(ROWS) * (2 * 3 + 2 * 2 + 2)
    assert "8 cells were not run" in nothing.output

    first = worldloop(tmp_path / "logs", *words, "study.only=[imitation]")
    assert first.status == 0, first.output[-3000:]
    done = {row["row"] for row in table_of(root)["rows"] if row["cells"]["success"]["all"]}
    assert done == {"imitation"}

    rest = worldloop(tmp_path / "logs", *words)
    assert rest.status == 0, rest.output[-3000:]
    assert "not run" not in (root / "study.md").read_text()
    assert_each_shared_stage_ran_once(root)
    assert_cells_are_what_the_evaluations_left(words[1:], table_of(root))
    spent = {row["row"]: row["physics_episodes"] for row in table_of(root)["rows"]}
    assert spent["imitation"] == {"scripted": 12}
    explored = json.loads(next(root.glob("stages/explore-*/manifest.json")).read_text())["result"]["episodes"]
    own = {"scripted": 12, "own": explored + 10}  # all rows begin with what was found by exploring
    assert explored in (2, 4) and spent["filtered_bc"] == spent["physics_episodes"] == own
    assert spent["ppo"] == {**own, "first frames": 4}

    again = worldloop(tmp_path / "logs", *words)
    assert again.status == 0 and "took" not in again.output
    page = (root / "study.html").read_text()
    assert "against imitation on the same episodes" in page and "privileged" in page


def table_of(root: Path) -> dict[str, Any]:
    return dict(json.loads((root / "study.json").read_text()))


def assert_each_shared_stage_ran_once(root: Path) -> None:
    """Rows share all stages up to the first in which they differ."""
    folders = Counter(path.name.rpartition("-")[0] for path in (root / "stages").iterdir())
    once = ("collect", "imitation", "deploy-1", "simulator-1", "clone-1", "evaluate-before", "rl-1")
    assert {name: folders[name] for name in once} == dict.fromkeys(once, 1)
    # with RL and without, of one policy each; a policy that was kept is evaluated as the first row's
    assert folders["trial-2"] == folders["evaluate-after"] == 2


def assert_cells_are_what_the_evaluations_left(words: tuple[str, ...], table: dict[str, Any]) -> None:
    study = plan_study(words)
    kept = {
        (row.name, column): torch.load(row.made.graph.folder(node) / "outcomes.pt", weights_only=True)
        for row in study.rows
        for column, (node,) in row.nodes.items()
    }
    for row in table["rows"]:
        for column, cells in row["cells"].items():
            won, seeds = (kept[row["row"], column][key] for key in ("success", "seeds"))
            assert cells["all"] == rate_entry(won)
            assert cells["push"] == rate_entry(won[seeds % 2 == 0])
    assert len({tuple(outcome["seeds"].tolist()) for outcome in kept.values()}) == 1
    found = {(e["row"], e["other"], e["column"]): e["cells"]["all"] for e in table["comparisons"]}
    assert len(found) == 2 * (3 + 2 + 1)
    for (name, other, column), cell in found.items():
        mine, theirs = kept[name, column]["success"], kept[other, column]["success"]
        assert cell == {"gain": pytest.approx(cell["gain"]), "episodes": 4, **mcnemar(theirs, mine)}


def test_rows_over_seeds_share_evaluation_episodes_and_only_as_many_seeds_as_asked(tmp_path: Path) -> None:
    words = (*SMALL, f"runs={tmp_path}", "study.seeds=[3,5]", "study.methods.ppo.seeds=1")
    study = plan_study(words)
    assert [(row.name, row.seed) for row in study.rows][-3:] == [
        *(("imitation", 5), ("filtered_bc", 5), ("physics_episodes", 5)),
    ]
    graphs = [row.made.graph for row in study.rows if row.name == "imitation"]
    assert graphs[0].key("collect") != graphs[1].key("collect")


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["seed=1"], "say study.seeds=[1]"),
        (["study.rows=[imitation,pp]"], "study.rows holds 'pp'"),
        (["study.only=[grpo]"], "study.only holds 'grpo', which study.rows has not"),
        (["study.minutes=-1"], "study.minutes=-1 should be greater than or equal to 0"),
        (
            ["study.rows=[ppo]", "study.methods.ppo.changes=['rl.epoch=2']"],
            "study.methods.ppo.changes=['rl.epoch=2']: rl.epoch",
        ),
        (
            ["study.measures.out_of_domain.variant=elsewhere"],
            "study.measures.out_of_domain in the row imitation",
        ),
        (
            ["study.rows=[ppo]", "study.methods.ppo.policy._target_=pathlib.Path"],
            "which is no pipeline.study.methods.Method",
        ),
        (
            ["study.rows=[physics_episodes]", "study.methods.physics_episodes.policy.equal=hours"],
            "policy.equal='hours' should be",
        ),
        (["study.places=[moon]"], "study.places holds 'moon', which study.across has not"),
        (
            ["study.rows=[filtered_bc]", "+study.methods.filtered_bc.policy.kept=false"],
            "rl=false leaves no policy of RL's to take",
        ),
        (
            ["+study.across={moon: ['task.gravity=1']}", "study.places=[moon]"],
            "study.methods.imitation.changes=['task.gravity=1'] in study.across.moon: task.gravity",
        ),
    ],
)
def test_what_is_wrong_with_a_plan_is_told_by_key(words: list[str], told: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as error:
        plan_study([*SMALL, "study.rows=[imitation]", "study.against=[]", f"runs={tmp_path}", *words])
    assert told in str(error.value)


def test_work_ends_at_its_deadline_and_errors_before_it_are_told() -> None:
    began = time.monotonic()
    with clean_ending(), deadline(0.002) as clock:
        time.sleep(20)
    assert clock.over and time.monotonic() - began < 10
    with pytest.raises(ZeroDivisionError), deadline(1.0) as clock:
        _ = 1 / 0
    with pytest.raises(SystemExit), deadline(None):
        raise SystemExit(143)
    assert not clock.over
