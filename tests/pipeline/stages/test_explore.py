"""How widely the first policy explores is what physics lets it, and its trials are data like any."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file

from actors.factory import open_clips
from envs.physics.pool import Track
from pipeline.config import load_config
from pipeline.evaluation.statistics import rate_entry
from pipeline.loop import build_loop
from pipeline.stages.collect import run_recorded
from pipeline.stages.measured.explore import Level, find_level, kept
from pipeline.study.methods import add_rl_in_physics
from tests.sampling import every

WORDS = ["experiment=soak", "track=disabled", "explore.levels=[[1.0,1.0],[0.5,0.5]]", "explore.episodes=3"]
_LUCK = ([30] * 5, [9, 9, 9, 9, 90])  # successes in 100 of five tasks
LEVELS: list[Level] = [(1.0, 1.0), (1.0, 0.5), (0.5, 0.5)]


@pytest.mark.parametrize(
    ("successes", "tried"),  # of 100 each, by level; None is the mode
    [
        ({None: 40, (1.0, 1.0): 30}, 1),
        ({None: 40, (1.0, 1.0): 8, (1.0, 0.5): 20, (0.5, 0.5): 24}, 3),
        ({None: 40, (1.0, 1.0): 2, (1.0, 0.5): 4, (0.5, 0.5): 8}, 3),  # none keeps enough
    ],
)
def test_the_first_level_that_keeps_enough_of_the_modes_successes(
    successes: dict[Level | None, int], tried: int
) -> None:
    def trial(level: Level | None) -> dict[str, Any]:
        return {"": rate_entry(torch.arange(100) < successes[level])}

    found, mode, seen = find_level(LEVELS, 0.6, trial)
    assert found == LEVELS[tried - 1] and list(seen) == LEVELS[:tried] and mode[""]["successes"] == 40


def test_of_a_mode_that_never_succeeds_nothing_can_be_told() -> None:
    found, _, seen = find_level(LEVELS, 0.6, lambda level: {"": rate_entry(torch.zeros(100) > 0)})
    assert found == LEVELS[0] and not seen


def test_easy_tasks_do_not_make_up_for_hard_ones() -> None:
    def rates(push: int, grasp: int, never: int = 0) -> dict[str, dict[str, Any]]:
        won = {"push": push, "grasp": grasp, "never": never}
        return {task: rate_entry(torch.arange(100) < count) for task, count in won.items()}

    mode = rates(90, 10)
    assert kept(rates(90, 1), mode) == pytest.approx((1 + 1.5 / 10.5) / 2)  # .57, with 91 of 100 successes
    assert kept(rates(45, 9), mode) == pytest.approx(0.7, abs=0.005)
    assert kept(rates(99, 10, 5), mode) == 1.0  # more than the mode is no more than all
    even, lucky = (
        {str(n): rate_entry(torch.arange(100) < won) for n, won in enumerate(some)} for some in _LUCK
    )
    assert kept(lucky, even) < 0.6  # with 126 of 150 successes


def test_a_task_all_of_whose_episodes_were_dropped_says_nothing() -> None:
    won, lost = rate_entry(torch.ones(2) > 0), rate_entry(torch.zeros(2) > 0)
    assert kept({"push": won}, {"push": won, "grasp": won}) == 1.0
    assert kept({"push": won, "grasp": lost}, {"push": won}) == 1.0
    assert kept({"push": lost}, {"push": lost, "grasp": won}) == 0.0  # what it keeps is not known


@pytest.mark.parametrize(
    ("rate", "share", "least", "most"),
    every(
        5,
        [
            (0.05, 1.0, 0.85, 1.0),  # .45 where the mode's lucky tasks alone were looked at
            (0.1, 1.0, 0.9, 1.0),
            (0.5, 1.0, 0.99, 1.0),
            (0.1, 0.2, 0.0, 0.2),
            (0.5, 0.4, 0.0, 0.1),
        ],
    ),
)
def test_a_level_that_loses_nothing_is_kept_however_rare_success_is(
    rate: float, share: float, least: float, most: float
) -> None:
    """Five tasks of twenty episodes each, 400 times; a level that loses most of them is not."""
    generator = torch.Generator().manual_seed(0)

    def trial(chance: float) -> dict[str, dict[str, Any]]:
        draws = torch.rand(5, 20, generator=generator) < chance
        return {str(task): rate_entry(row) for task, row in enumerate(draws)}

    pairs = [(trial(rate * share), trial(rate)) for _ in range(400)]
    known = [(some, mode) for some, mode in pairs if any(one["successes"] for one in mode.values())]
    passed = sum(kept(some, mode) >= 0.6 for some, mode in known) / len(known)
    assert least <= passed <= most


def test_trials_are_recorded_and_the_policy_goes_on_with_what_was_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def losing(*args: Any, stochastic: bool) -> Iterator[list[Track]]:
        """Without the first episode of the mode, as if physics had crashed in it."""
        for tracks in run_recorded(*args, stochastic=stochastic):
            yield tracks if stochastic else tracks[1:]

    monkeypatch.setattr("pipeline.stages.measured.explore.run_recorded", losing)
    cfg = load_config(WORDS)
    graph = build_loop(cfg, tmp_path)
    made = graph.run("explore")["explore"]["result"]
    store = open_clips(cfg, [graph.folder("explore") / "dataset"])
    assert len(store) == made["episodes"] == 3 * (1 + len(made["levels"])) - 1
    assert made["dropped"] == 1 and made["mode"]["episodes"] == 2
    assert len(store.select(["policy-0"])) == len(store.split("train")) == len(store)
    assert ("alarm" in made) is (made["mode"]["successes"] == 0 or made["level"]["width"] == 0.5)
    before, after = (
        load_file(graph.folder(name) / "weights.safetensors") for name in ("imitation", "explore")
    )
    moved = {key for key, value in before.items() if not torch.equal(value, after[key])}
    assert moved <= {key for key in before if key.endswith(("log_std", "share"))}
    assert graph.nodes["deploy-1"].inputs["policy"] == "explore"
    assert graph.nodes[add_rl_in_physics(graph, cfg, "steps")].inputs["policy"] == "explore"
    assert "explore" in graph.nodes["simulator-1"].inputs["data"]
    assert graph.nodes["evaluate-before"].inputs["policy"] == "imitation"


@pytest.mark.parametrize("words", [["explore.levels=[]"], ["policy=tiny_vla"]])
def test_without_levels_or_a_way_to_scale_there_is_no_such_stage(words: list[str], tmp_path: Path) -> None:
    graph = build_loop(load_config([*WORDS, *words]), tmp_path)
    assert "explore" not in graph.nodes and graph.nodes["deploy-1"].inputs["policy"] == "imitation"
