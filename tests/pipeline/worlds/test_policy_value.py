"""Values of policies by one command: with physics and without it, resumed, and refused where it cannot be."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as parquet
import pytest
import torch

from actors.factory import build_physics, build_pool
from actors.policies.recorded import Commands, RecordedActions
from actors.rollouts.evaluate import evaluate
from envs.embodiment import Embodiment
from envs.episodes import LeRobotWriter
from envs.episodes.clips import ClipStore
from envs.targets import ConfigError
from pipeline.commands.worlds.policy_value import policy_value
from pipeline.config import load_config
from pipeline.evaluation.value.estimate import starts_of
from pipeline.evaluation.value.page import judge_lines
from pipeline.evaluation.value.trials import scripted_outcomes
from tests.embodiments import ARM_DELTAS, world_spec
from tests.moving_square import SIZE, moving_square
from tests.worlds import scripted_set, untrained_world, written

SOAK = ["experiment=soak", "track=disabled", "launch.workers=1", "cameras=main"]


def test_recorded_actions_succeed_where_they_did(tmp_path: Path) -> None:
    cfg = load_config(SOAK)
    seeds = [3, 4, 5]
    pool, physics = build_pool(cfg), build_physics(cfg, 3)
    try:
        made = scripted_outcomes(pool.script([(3, 0.0), (4, 1.0), (5, 0.0)], cfg["task"]["chunk"]))
        commands = Commands(made["commands"], made["length"])
        policy = RecordedActions(commands, physics.spec, physics.mode, lambda: physics.elapsed)
        assert evaluate(physics, policy, seeds).success.tolist() == made["success"].tolist()
    finally:
        pool.close()
        physics.close()
    assert made["success"].tolist() == [True, False, True]


def test_values_beside_true_ones_and_nothing_is_tried_twice(tmp_path: Path) -> None:
    cfg = load_config(SOAK)
    data = scripted_set(cfg, tmp_path / "set", 3)
    words = [*SOAK, *untrained_world(cfg, tmp_path), f"imagined.data=[{data}]"]
    words += [f"policy_value.policies=[{tmp_path / 'policy'}]", "policy_value.starts=3"]
    words += ["policy_value.noise=[0.5]", "policy_value.experts=[0.0,1.0]"]
    root = tmp_path / "run"
    policy_value(load_config([*words, "policy_value.repeats=1"]), root)
    said = policy_value(load_config([*words, "policy_value.repeats=2"]), root)
    assert said.endswith("9 parts were reused")  # the starts, true outcomes and the first repeat of all four
    result = json.loads(written(root, "policy-value.json").read_text())
    rows = {cell["policy"]: cell for cell in result["cells"]}
    assert list(rows) == ["policy", "policy + noise 0.5", "expert 0", "expert 1"]
    assert rows["expert 0"]["true_value"] == 1.0 and rows["expert 1"]["true_value"] == 0.0
    assert rows["policy"]["inside"] and not rows["policy + noise 0.5"]["inside"]
    assert all(row["episodes"] == 6 and row["dropped"] == 0 for row in rows.values())
    table = result["agreement"]["micro"]
    assert sum(table[name] for name in ("tp", "fp", "fn", "tn")) == 24
    assert any("open loop" in note for note in result["notes"])
    assert result["judged_by"] == {} and result["judge_cost"] == {}  # a learned judge is free
    asked = {
        "judged_by": {"metric": "NLPD", "goals_unfinished": 1},
        "judge_cost": {"calls": 2.0, "cost": 0.5},
    }
    assert judge_lines(asked) == [
        "Judged by metric: NLPD, goals unfinished: 1.",
        "Asking the judge: calls 2, cost 0.5.",
    ]
    page = written(root, "policy-value.html").read_text()
    assert page.count("<title>") == 5 and "expert 0, push: 100 -&gt; " in page
    assert not re.findall(r'(?:src|href)=(?!"#)', page)
    # Recordings without seeds say their numbers, from which physics lays out starts of its own.
    for path in (data / "data").rglob("*.parquet"):
        table = parquet.read_table(path)
        moved = pa.array([seed.as_py() + 1000 for seed in table["seed"]])
        parquet.write_table(table.set_column(table.column_names.index("seed"), "seed", moved), path)
    with pytest.raises(ConfigError, match=r"other starts than \d of \d .* seed 100\d .*imagined\.data"):
        policy_value(load_config([*words, "policy_value.repeats=1"]), tmp_path / "other")


def test_without_physics_values_are_estimated_alone(
    tmp_path: Path, tiny_data: Callable[[Embodiment], Path]
) -> None:
    words = ["experiment=smoke", "track=disabled", "task=lerobot", f"task.data=[{tiny_data(ARM_DELTAS)}]"]
    words += ["task.size=[32,32]", "task.chunk=4", "task.horizon=8", "policy_value.repeats=1"]
    words += untrained_world(load_config(words), tmp_path)
    words += [f"policy_value.policies=[{tmp_path / 'policy'}]", "policy_value.noise=[0.1,0.5]"]
    said = policy_value(load_config(words), tmp_path / "run")
    result = json.loads(written(tmp_path / "run", "policy-value.json").read_text())
    assert result["agreement"] == {} and "nobody knows" in said and "expert" not in said.split("\n\n")[1]
    assert [cell["policy"] for cell in result["cells"]] == [
        *("policy", "policy + noise 0.1", "policy + noise 0.5")
    ]
    assert all("true" not in cell for cell in result["cells"])
    assert "Fewer held-out starts than policy_value.starts=32" in said
    said = policy_value(load_config([*words, "policy_value.judged=whole"]), tmp_path / "run")
    assert "\n0 parts were reused" in said  # other judgements, kept apart
    assert json.loads(written(tmp_path / "run", "policy-value.json").read_text())["judged"] == "whole"
    other = "policy_value.others={mine: {_target_: actors.policies.vla.ChunkPolicy, nope: 1}}"
    with pytest.raises(ConfigError, match=r"policy_value\.others\.mine\.nope is not an option"):
        load_config([*words, other])
    nobody = load_config([*words, "policy_value.policies=[nobody]"])
    with pytest.raises(ConfigError, match=r"policy_value\.policies=nobody: .* does not exist"):
        policy_value(nobody, tmp_path / "run")
    with pytest.raises(ConfigError, match="at least two candidates"):
        policy_value(load_config([*words, "policy_value.noise=[]"]), tmp_path / "run")


@pytest.mark.long
def test_verdicts_of_another_goal_are_not_taken_for_this_one(
    tmp_path: Path, tiny_data: Callable[[Embodiment], Path]
) -> None:
    goal = tmp_path / "goal.png"
    assert cv2.imwrite(str(goal), np.zeros((32, 32, 3), np.uint8))
    words = ["experiment=smoke", "track=disabled", "task=lerobot", f"task.data=[{tiny_data(ARM_DELTAS)}]"]
    words += ["task.size=[32,32]", "task.chunk=4", "task.horizon=4", "judge=goal_image"]
    words += [f"judge.picture={goal}", "policy_value={repeats: 1, starts: 2, noise: [0.5]}"]
    words += untrained_world(load_config(words), tmp_path)
    words += [f"policy_value.policies=[{tmp_path / 'policy'}]"]
    reused = [policy_value(load_config(words), tmp_path / "run").splitlines()[-1] for _ in range(2)]
    assert cv2.imwrite(str(goal), np.full((32, 32, 3), 255, np.uint8))
    reused.append(policy_value(load_config(words), tmp_path / "run").splitlines()[-1])
    assert reused == ["0 parts were reused", "2 parts were reused", "0 parts were reused"]


@pytest.mark.parametrize(
    ("words", "starts", "groups"),
    [
        (1, 32, {"0": 12}),
        (3, 6, {"0": 2, "1": 2, "2": 2}),
        (12, 32, {"various instructions": 12}),
        (12, 6, {"various instructions": 6}),
    ],
)
def test_instructions_share_the_starts_and_many_are_one_group(
    words: int, starts: int, groups: dict[str, int], tmp_path: Path
) -> None:
    made = [replace(moving_square(ARM_DELTAS, n, length=3), instruction=str(n % words)) for n in range(12)]
    LeRobotWriter(tmp_path / "set", ARM_DELTAS.at(SIZE)).write(made)
    store = ClipStore([tmp_path / "set"], world_spec(ARM_DELTAS.at(SIZE), SIZE))
    cfg = {"task": {"name": "recorded"}, "policy_value": {"starts": starts}}
    found = starts_of(cfg, store, torch.arange(12))
    assert {name: len(episodes) for name, episodes in found.items()} == groups


@pytest.mark.long
def test_goals_are_counted_though_nothing_is_imagined_again(
    tmp_path: Path, tiny_data: Callable[[Embodiment], Path]
) -> None:
    words = ["experiment=smoke", "track=disabled", "task=lerobot", f"task.data=[{tiny_data(ARM_DELTAS)}]"]
    words += ["task.size=[32,32]", "task.chunk=4", "task.horizon=4", "judge=golden_goal"]
    words += ["judge.fallback=last_frame", "judge.text_world.ending={threshold: 1.0}"]
    words += ["policy_value={repeats: 2, starts: 2, noise: [0.5]}"]
    words += untrained_world(load_config(words), tmp_path)
    words += [f"policy_value.policies=[{tmp_path / 'policy'}]"]
    counted = []
    for _ in range(2):
        policy_value(load_config(words), tmp_path / "run")
        said = json.loads(written(tmp_path / "run", "policy-value.json").read_text())["judged_by"]
        counted.append((said["goals"], said["goals_unfinished"]))
    assert counted[0] == counted[1] and counted[0][0] >= 2
