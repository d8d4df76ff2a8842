"""A policy whose mode got worse is left behind; one that had bad luck is not."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from envs.rng import Purpose, episode_seeds
from pipeline.config import load_config
from pipeline.evaluation.result import OUTCOMES, outcomes
from pipeline.graph.graph import Graph
from pipeline.graph.stage import Inputs, stage
from pipeline.graph.view import ConfigView
from pipeline.loop import build_loop
from pipeline.stages.keep import got_worse, keep

EPISODES = 100


def won(first: int, last: int) -> Tensor:
    """Success in the episodes from `first` to before `last`, bool [EPISODES]."""
    number = torch.arange(EPISODES)
    return (number >= first) & (number < last)


@stage(reads=())
def tried(cfg: ConfigView, folder: Path, inputs: Inputs) -> dict[str, Any]:
    """A policy and its trial. Settings: first, last (see won), round, uncounted."""
    given = dict(inputs.settings)
    (folder / "weights.safetensors").write_text(f"round {given['round']}")
    counted = torch.arange(EPISODES) >= given["uncounted"]
    success = won(given["first"], given["last"])
    kept = {"success": success, "counted": counted, "seeds": torch.arange(EPISODES)}
    torch.save(kept, folder / OUTCOMES)
    return {"round": given["round"]}


@pytest.mark.parametrize(
    ("before", "after", "worse"),
    [
        (won(0, 40), won(5, 40), True),  # five lost and none gained: more than twice the root of five
        (won(0, 40), won(4, 40), False),
        (won(0, 40), won(20, 50), False),  # 20 lost, 10 gained; by two standard errors chance takes eleven
        (won(0, 40), won(20, 47), True),
        (won(0, 40), won(20, 80), False),
        (won(0, 0), won(0, 0), False),
        (won(0, 100), won(0, 100), False),
    ],
)
def test_only_what_chance_does_not_explain_is_worse(before: Tensor, after: Tensor, worse: bool) -> None:
    assert got_worse(before, after) is worse


def test_the_stage_hands_on_the_policy_and_the_best_trial(tmp_path: Path) -> None:
    graph = Graph(load_config(["task.name=[push,pull]", "task=tabletop"]), tmp_path)
    rounds = {1: (0, 60), 2: (8, 64), 3: (14, 64), 4: (0, 70)}
    names = {
        number: graph.add(f"trial-{number}", tried, first=first, last=last, round=number, uncounted=0)
        for number, (first, last) in rounds.items()
    }
    best = known = names[1]
    for number in (2, 3, 4):
        one = names[number]
        best = known = graph.add(
            f"keep-{number}", keep, {"candidate": one, "tried": one, "incumbent": best, "best": known}
        )
    found = {name: row["result"] for name, row in graph.run().items() if name.startswith("keep")}
    folder = {number: graph.folder(f"keep-{number}") for number in (2, 3, 4)}
    assert [one["kept"] for one in found.values()] == [True, False, True]
    assert (found["keep-2"]["gained"], found["keep-2"]["lost"]) == (4, 8)
    # against the best, of round 1; round 2, which was kept, had lost some, too
    assert (found["keep-3"]["gained"], found["keep-3"]["lost"]) == (4, 14)
    weights = [(folder[number] / "weights.safetensors").read_text() for number in (2, 3, 4)]
    assert weights == ["round 2", "round 2", "round 4"]
    # whose episodes RL goes on with, and what the next one is held against
    assert [one["round"] for one in found.values()] == [2, 2, 4]
    held = [outcomes(folder[number])[1][0].sum().item() for number in (2, 3, 4)]
    assert held == [60, 60, 70]
    tasks = found["keep-4"]["tasks"]
    assert set(tasks) == {"push", "pull"}
    assert sum(part["gained"] for part in tasks.values()) == found["keep-4"]["gained"] == 10


def test_a_task_that_pays_for_the_others_is_told(tmp_path: Path) -> None:
    """Odd episodes are of one task, all of which is lost while the others are gained."""

    @stage(reads=())
    def by_turns(cfg: ConfigView, folder: Path, inputs: Inputs) -> dict[str, Any]:
        """A trial in which one task alone succeeds. Settings: turn, 0 or 1."""
        (folder / "weights.safetensors").write_text("policy")
        number = torch.arange(EPISODES)
        success = number % 2 == inputs.settings["turn"]
        counted = torch.ones(EPISODES, dtype=torch.bool)
        torch.save({"success": success, "counted": counted, "seeds": number}, folder / OUTCOMES)
        return {"round": 1}

    graph = Graph(load_config(["task.name=[push,pull]", "task=tabletop"]), tmp_path)
    old, new = (graph.add(f"trial-{turn}", by_turns, turn=turn) for turn in (0, 1))
    graph.add("keep-2", keep, {"candidate": new, "tried": new, "incumbent": old, "best": old})
    found = graph.run()["keep-2"]["result"]
    assert found["kept"]
    (alarm,) = found["alarms"]
    assert "lost 50 and gained 0 of 50 episodes" in alarm and "explore.keep" in alarm


def test_episodes_that_do_not_count_on_either_side_say_nothing(tmp_path: Path) -> None:
    graph = Graph(load_config(["experiment=soak"]), tmp_path)
    old = graph.add("old", tried, first=0, last=40, round=1, uncounted=0)
    new = graph.add("new", tried, first=40, last=41, round=2, uncounted=40)
    graph.add("keep-2", keep, {"candidate": new, "tried": new, "incumbent": old, "best": old})
    found = graph.run()["keep-2"]["result"]
    assert found["kept"] and found["best"]["episodes"] == 60 and found["lost"] == 0


@pytest.mark.slow
def test_trials_have_starts_of_their_own_and_the_first_rl_does_not_wait_for_them(tmp_path: Path) -> None:
    cfg = load_config(["experiment=soak", "track=disabled", "explore.levels=[]"])
    graph = build_loop(cfg, tmp_path)
    made = graph.run("trial-1")["trial-1"]["result"]
    one = torch.load(graph.folder("trial-1") / OUTCOMES, weights_only=True)
    asked = episode_seeds(cfg["seed"], Purpose.TRIAL, cfg["rounds"]["trial"])
    assert one["seeds"].tolist() == asked and made["physics_episodes"] == {"own": len(asked)}
    # what they decide is the choice alone
    assert graph.nodes["rl-1"].inputs["known"] == "deploy-1" and "trial-1" not in graph.needs("rl-1")


def test_a_policy_that_nothing_has_changed_is_not_tried_again(tmp_path: Path) -> None:
    cfg = load_config(["experiment=smoke", "rounds.count=3", "rounds.clone=0"])
    graph = build_loop(cfg, tmp_path, with_rl=False)
    assert [name for name in graph.nodes if name.startswith(("trial", "keep"))] == ["trial-1"]
    assert graph.nodes["evaluate-after"].inputs["policy"] == "explore"
