"""The stage that measures what imagined returns are worth, on held-out episodes of deployed policies."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from actors.factory import build_judge, build_pool, open_clips
from actors.world_config import world_spec
from envs.episodes import Episode, LeRobotWriter
from envs.episodes.splits import write_splits
from envs.initial_states import DecisionPoints
from learners.rl.recorded.worth import Estimate, Returns, Worth
from pipeline.config import load_config
from pipeline.graph.artefact import save_weights
from pipeline.graph.stage import Inputs
from pipeline.loop import build_loop
from pipeline.stages.measured import worth
from tests.worlds import untrained_world

WORDS = ["experiment=smoke", "task.size=[32,32]", "judge=learned", "worth.moments=14", "launch.device=cpu"]


@pytest.fixture(scope="module")
def cfg() -> dict[str, object]:
    return load_config(WORDS)


@pytest.fixture(scope="module")
def inputs(cfg: dict[str, object], tmp_path_factory: pytest.TempPathFactory) -> Inputs:
    """An untrained world, and episodes of a deployed policy, the first two for learning."""
    root = tmp_path_factory.mktemp("run")
    untrained_world(cfg, root)
    judge = build_judge(cfg)
    judge.threshold.fill_(2.0)  # untrained it sees success everywhere
    save_weights(judge, root / "judge")
    robot, pool = world_spec(cfg).embodiment, build_pool(cfg)
    try:
        tracks = pool.script([(seed, 0.6) for seed in range(6)], cfg["task"]["chunk"])
    finally:
        pool.close()
    LeRobotWriter(root / "deployed/dataset", robot).write(
        [Episode.from_track(track, "policy-1", robot) for track in tracks]
    )
    write_splits(root / "deployed/dataset", {"train": 2, "held_out": 4, "calibration": 0})
    roles = {name: root / name for name in ("simulator", "state", "judge", "policy")}
    return Inputs({"data": (root / "deployed",), **roles}, {"number": 1})


def test_it_is_measured_on_held_out_moments_of_each_task(
    cfg: dict[str, object], inputs: Inputs, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    seen: list[Returns] = []
    told = worth.worth_by_task

    def noting(returns: Returns, tasks: list[str], earlier: dict[str, Estimate]) -> dict[str, Worth]:
        seen.append(returns)
        return told(returns, tasks, earlier)

    monkeypatch.setattr(worth, "worth_by_task", noting)
    view = worth.worth.view("worth-1", cfg, {"number": 1})
    made = [worth.worth.run(view, tmp_path, inputs) for _ in range(2)]
    assert made[0] == made[1]
    (found,) = made[0]["worth"].values()
    assert found["moments"] == 14 and 0.0 <= found["value"] <= 1.0
    assert set(seen[0].episode.tolist()) == {2, 3, 4, 5}
    assert float((seen[0].imagined - seen[0].others).abs().max()) > 1e-4


def test_recorded_returns_are_those_of_the_chunks_that_follow(cfg: dict[str, object], inputs: Inputs) -> None:
    view = worth.worth.view("worth-1", cfg, {"number": 1})
    store, held = open_clips(view, [inputs.folders("data")[0] / "dataset"]), torch.tensor([3, 5])
    points, chunk = DecisionPoints(store, held), int(view["task"]["chunk"])
    every = torch.arange(len(points))
    whole, begun = worth._true_returns(view, inputs, store, held, points, every, 99)
    one, _ = worth._true_returns(view, inputs, store, held, points, every, 1)
    for episode in held.tolist():
        mine = points.episode == episode
        assert torch.allclose(whole[mine], one[mine].flip(0).cumsum(0).flip(0), atol=1e-5)
        success, first = bool(store.episodes[episode]["success"]), mine.nonzero()[0]
        rewards = view["judge"]["rewards"]
        if success:  # progress telescopes to 1
            paid = rewards["progress"] * (1 - begun[first]) + rewards["success"]
            assert float(whole[first]) == pytest.approx(float(paid), abs=1e-4)
        assert int(mine.sum()) == (int(store.length[episode]) - 2) // chunk + 1


def test_it_is_asked_of_each_world_that_rl_imagines(tmp_path: Path) -> None:
    nodes = build_loop(load_config(["experiment=smoke"]), tmp_path).nodes
    for number in (1, 2):
        asked = nodes[f"worth-{number}"].parents
        assert {f"simulator-{number}", f"state-{number}", f"judge-{number}"} < set(asked)
        assert f"worth-{number}" in nodes[f"rl-{number}"].parents
    assert "worth-1" in nodes["worth-2"].parents
    for word in ("rl.imagined=0", "worth.moments=0"):
        without = build_loop(load_config(["experiment=smoke", word]), tmp_path).nodes
        assert not [name for name in without if name.startswith("worth")]


def test_moments_are_shared_out_over_tasks() -> None:
    tasks = ["a"] * 50 + ["b"] * 3 + ["c"] * 20
    chosen = worth._shared_out(tasks, 21, 0)
    counts = {task: sum(tasks[n] == task for n in chosen.tolist()) for task in "abc"}
    assert counts == {"a": 9, "b": 3, "c": 9} and len(chosen.unique()) == 21
    assert len(worth._shared_out(tasks, 0, 0)) == 0 and len(worth._shared_out(tasks, 999, 0)) == 73


def test_a_task_in_which_imagination_is_worth_nothing_is_told() -> None:
    found = {
        "push": Worth(0.3, (0.3, 0.1), (0.3, 0.1), 90),
        "grasp": Worth(0.0, (-0.1, 0.1), (-0.1, 0.1), 90),
    }
    (alarm,) = worth.worth_little(found)
    assert "in grasp," in alarm and "simulator_fit" in alarm and not worth.worth_little({"a": found["push"]})
