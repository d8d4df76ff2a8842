"""Rewards against the truth: figures that know good rewards from bad ones, and the command on recordings."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from actors.factory import open_clips
from envs.episodes import Episode, LeRobotWriter
from envs.episodes.clips import ClipStore
from envs.episodes.privileged import read_privileged
from envs.judges import RuleJudge
from envs.physics.suite import build_suite, scene_of
from envs.specs import Status
from envs.targets import ConfigError
from pipeline.cli import worlds
from pipeline.commands.worlds import rewards
from pipeline.commands.worlds.rewards import Plan, compare_rewards
from pipeline.config import load_config
from pipeline.evaluation.judging import Scores
from pipeline.evaluation.rewards.figures import BY_PHYSICS, BY_TIME, Truth, auc, by_rule, figures, truth_of
from pipeline.evaluation.rewards.page import lines_of
from pipeline.graph.graph import Graph
from pipeline.stages.variant import variant_episodes
from tests.commands import worldloop
from tests.embodiments import ARM_DELTAS, world_spec
from tests.moving_square import SIZE, episodes_of, moving_square


def truth(count: int = 40, frames: int = 12) -> Truth:
    generator = torch.Generator().manual_seed(0)
    pace = torch.rand(count, 1, generator=generator)
    progress = (pace * torch.linspace(0, 1.5, frames)).clamp(max=1)
    valid = torch.ones(count, frames, dtype=torch.bool)
    valid[::3, -2:] = False
    return Truth(progress, pace[:, 0] > 0.7, valid, BY_PHYSICS)


def test_the_truth_follows_itself_and_its_reverse_does_not() -> None:
    true = truth()
    mine = figures(RuleJudge(hold=1), by_rule(true), true, seed=0)
    assert mine["within"][0] == pytest.approx(1.0) and mine["pooled"] == pytest.approx(1.0)
    assert mine["auc"] == [1.0, 1.0, 1.0]
    turned = Scores(1 - by_rule(true).success, 1 - true.progress, by_rule(true).status)
    worst = figures(RuleJudge(hold=12), turned, true, seed=0)
    assert worst["within"][0] == pytest.approx(-1.0) and worst["pooled"] == pytest.approx(-1.0)


def test_a_reward_that_says_nothing_is_chance() -> None:
    true, generator = truth(200), torch.Generator().manual_seed(1)
    noise = Scores(*torch.rand(2, *true.progress.shape, generator=generator), by_rule(true).status)
    found = figures(RuleJudge(hold=2), noise, true, seed=0)
    for name, chance in (("within", 0.0), ("auc", 0.5)):
        value, low, high = found[name]
        assert low < chance < high and low < value < high
    constant = Scores(
        torch.zeros_like(true.progress), torch.full_like(true.progress, 0.4), by_rule(true).status
    )
    still = figures(RuleJudge(hold=2), constant, true, seed=0)
    assert still == {"within": [0.0, 0.0, 0.0], "pooled": None, "auc": [0.5, 0.5, 0.5], "dropped": 0}


def test_what_could_not_be_judged_is_counted_and_left_out() -> None:
    true = truth()
    scores = by_rule(true)
    status = scores.status.clone()
    status[0] = Status.ABSTAIN.value
    wild = scores.progress.clone()
    wild[0] = torch.rand(wild.shape[1], generator=torch.Generator().manual_seed(2))
    found = figures(RuleJudge(1), Scores(scores.success, wild, status), true, 0)
    assert found["dropped"] == 1 and found["within"][0] == pytest.approx(1.0)
    row = {"facts": {}, "figures": {"recorded": found}}
    ((*_, dropped),) = lines_of({"rewards": {"mine": row}})
    assert dropped == "1"


def test_what_is_past_an_episodes_end_does_not_count() -> None:
    true = truth()
    scores = by_rule(true)
    spoilt = Scores(scores.success.clone(), scores.progress.clone(), scores.status)
    for part in (spoilt.success, spoilt.progress):
        part[~true.valid] = 0.77
    assert figures(RuleJudge(1), spoilt, true, 0) == figures(RuleJudge(1), scores, true, 0)


def test_area_under_the_curve_counts_pairs() -> None:
    assert auc([0.1, 0.4, 0.4, 0.9], [False, False, True, True]) == pytest.approx(3.5 / 4)
    assert auc([0.1, 0.4], [True, True]) != auc([0.1, 0.4], [True, True])  # not a number


def test_truth_is_physics_own_where_it_was_recorded(tmp_path: Path) -> None:
    robot = ARM_DELTAS.at(SIZE)
    for name in ("physics", "bare"):
        made = [moving_square(ARM_DELTAS, seed, "expert" if seed % 2 else "random") for seed in range(4)]
        if name == "physics":
            made = [with_progress(episode) for episode in made]
        LeRobotWriter(tmp_path / name, robot).write(made)
    stores = {name: ClipStore([tmp_path / name], world_spec(robot, SIZE)) for name in ("physics", "bare")}
    some = torch.tensor([1, 2])
    known, guessed = (truth_of(stores[name], some) for name in ("physics", "bare"))
    assert (known.source, guessed.source) == (BY_PHYSICS, BY_TIME)
    rows, _ = stores["physics"].whole(some)
    column = read_privileged(stores["physics"], "progress")
    assert column is not None and torch.equal(known.progress, column.reshape(-1)[rows])
    assert known.success.tolist() == guessed.success.tolist() == [True, False]
    assert not bool(guessed.progress[1].any()) and float(guessed.progress[0].max()) == 1.0


def with_progress(episode: Episode) -> Episode:
    place = episode.privileged["object_pose"]
    return replace(episode, privileged={"progress": place.mean(1)})


def test_the_command_compares_judges_on_recordings(tmp_path: Path) -> None:
    robot = ARM_DELTAS.at(SIZE)
    LeRobotWriter(tmp_path / "set", robot).write(episodes_of(ARM_DELTAS))
    steps = [f"{section}.fit.steps=2" for section in ("simulator_fit.first", "judge_fit.first")]
    words = ("experiment=smoke", "track=disabled", f"runs={tmp_path}", "task=lerobot", "task.chunk=4")
    data = (f"task.data=[{tmp_path / 'set'}]", "task.size=[32,32]", "task.horizon=12", *steps)
    out = worldloop(tmp_path, "rewards", "rewards=[proxy,embedding]", "episodes=4", *words, *data)
    assert out.status == 0, out.output[-3000:]
    result = json.loads((tmp_path / "smoke/rewards.json").read_text())
    seen = result["domains"]["seen"]
    assert list(result["domains"]) == ["seen"] and seen["truth"] == BY_TIME
    assert set(seen["rewards"]) == {"proxy", "embedding"}
    for row in seen["rewards"].values():
        assert set(row["figures"]) == {"recorded", "generated"}
    drawn = seen["drawn"][0]["curves"]
    assert {"true", "proxy", "embedding"} == set(drawn["progress"])
    assert {"proxy", "embedding"} == set(drawn["success"])
    assert (
        "<svg" in (tmp_path / "smoke/rewards.html").read_text() and "| embedding | generated |" in out.output
    )
    (replayed,) = (tmp_path / "smoke/rewards").iterdir()
    made = replayed.stat().st_mtime_ns
    proxy = {"proxy": load_config([*words, *data, "judge=proxy"])}
    compare_rewards(load_config([*words, *data]), tmp_path / "smoke", Plan(proxy, 4, ()))
    assert replayed.stat().st_mtime_ns == made and len(list(replayed.parent.iterdir())) == 1  # nothing twice
    cfg = load_config([*words, *data])
    with pytest.raises(ConfigError, match="asks physics"):  # before anything is fitted
        compare_rewards(cfg, tmp_path / "new", Plan({**proxy, "rule": cfg}, 4, ()))
    assert [path.name.split("-")[0] for path in (tmp_path / "new/stages").iterdir()] == ["recordings"]
    with pytest.raises(ConfigError, match=r"variants=\['moon'\]"):
        compare_rewards(cfg, tmp_path / "smoke", Plan({"rule": cfg}, 4, ("moon",)))


@pytest.mark.long
def test_a_row_is_measured_by_the_judge_that_it_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plans: list[Plan] = []
    monkeypatch.setattr(rewards, "compare_rewards", lambda cfg, root, plan, tracker: plans.append(plan))
    words = ["experiment=smoke", "track=disabled", f"runs={tmp_path}", "judge=golden_goal_full"]
    worlds.rewards(
        ["rewards=[golden_goal,golden_goal_full,rule]", *words, "judge.threshold=0.7", "variants=[x]"]
    )
    judges = {name: cfg["judge"] for name, cfg in plans[0].configs.items()}
    chosen = load_config(["experiment=smoke", "judge=golden_goal"])["judge"]  # of the same class
    assert judges["golden_goal"] == chosen
    assert judges["golden_goal_full"] == judges["rule"]
    assert judges["rule"] == load_config(["judge=golden_goal_full", "judge.threshold=0.7"])["judge"]


@pytest.mark.long
def test_without_physics_nobody_asks_it_unless_told_to(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, dataset: Path
) -> None:
    plans: list[Plan] = []
    monkeypatch.setattr(rewards, "compare_rewards", lambda cfg, root, plan, tracker: plans.append(plan))
    smoke = ["experiment=smoke", "track=disabled", f"runs={tmp_path}"]
    recorded = [*smoke, "task=lerobot", f"task.data=[{dataset}]", "task.size=[32,32]"]
    for words in (smoke, recorded, [*recorded, "rewards=[proxy,rule]"]):
        worlds.rewards(words)
    learned = ["learned", "proxy", "embedding", "golden_goal"]
    assert [list(plan.configs) for plan in plans] == [[*learned, "rule"], learned, ["proxy", "rule"]]


def test_a_judge_that_cannot_be_asked_is_told_before_anything_runs(tmp_path: Path) -> None:
    smoke = ["experiment=smoke", "track=disabled", f"runs={tmp_path}"]
    with pytest.raises(ConfigError, match=r"judge\.chat\.model is empty"):
        worlds.rewards([*smoke, "rewards=[learned,vlm]"])
    assert not (tmp_path / "smoke/stages").exists()


@pytest.mark.long
def test_episodes_of_unseen_scenes(tmp_path: Path) -> None:
    cfg = load_config(["experiment=smoke", "task=tabletop", "task.name=push", "task.size=[32,32]"])
    graph = Graph(cfg, tmp_path)
    node = graph.add("variant", variant_episodes, variant="out_of_domain", episodes=2)
    assert graph.run(node)[node]["result"]["episodes"] == 2
    suite = cfg["task"]["suite"]
    store = open_clips(cfg, [graph.folder(node) / "dataset"])
    scenes = build_suite({**suite, "scenes": "out_of_domain"}).scenes
    assert {scene_of(scenes, row["seed"]) for row in store.episodes} <= set(suite["domains"]["out_of_domain"])
