"""worldloop cross-validate tells what is learned of recorded decisions from what is learned by heart."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from envs.rng import order_generator
from envs.specs import CHUNK
from envs.targets import ConfigError
from pipeline.commands.worlds.cross_validate import cross_validate, looks, measured, plain, tables
from pipeline.config import load_config
from pipeline.evaluation.trust.held_out import (
    folds_of,
    gains,
    joined,
    learned_without,
    mean_gain,
    packed,
    unpacked,
)
from tests.beginning import anew, begun


def test_gains_by_hand() -> None:
    ratio, advantage = torch.tensor([1.0, 2.0, 0.5, 40.0]), torch.tensor([1.0, 3.0, -1.0, 7.0])
    task, episode = torch.tensor([0, 0, 1, 1]), torch.tensor([5, 5, 9, 8])
    found, tasks = gains(ratio, advantage, task, episode)
    assert found.tolist() == [1.0, 36.0, 2.0] and tasks.tolist() == [0, 1, 1]  # episodes 5, 8, 9
    told = mean_gain(torch.tensor([1.0, 3.0]))
    assert told is not None and (told.value, told.error) == (2.0, 1.0) and mean_gain(found[:1]) is None


def test_every_own_episode_is_left_out_once() -> None:
    episode = torch.tensor([0, 0, 1, 2, 2, 3, 4, 5])
    fold = folds_of(episode, episode > 0, 2, 0)
    assert fold[:2].tolist() == [-1, -1] and fold[3] == fold[4] and {*fold[2:].tolist()} == {0, 1}
    assert torch.equal(fold, folds_of(episode, episode > 0, 2, 0))
    assert looks(64) == [2, 4, 8, 16, 32, 64] and looks(1) == [1]


@pytest.mark.long
@pytest.mark.parametrize("true", [True, False])
def test_what_is_true_holds_on_other_episodes_and_noise_does_not(tmp_path: Path, true: bool) -> None:
    _, ready = begun(tmp_path, "rl.lr=1e-3", "rl.minibatch=64", "policy.head.std=0.07")
    decisions = ready.true.decisions
    assert decisions is not None
    chunks = decisions.known[CHUNK]
    told = (chunks - chunks.mean(0)).flatten(1).sum(1)  # what is true: larger commands are better everywhere
    noise = torch.randn(len(told), generator=order_generator(3))
    decisions.known["advantage"] = (told / told.std() if true else noise)[:, None]
    episode = torch.searchsorted(ready.store.start, decisions.known["row"], right=True) - 1
    parts = (ready.algorithm, decisions, ready.settings, episode, torch.zeros_like(episode))
    fold = folds_of(episode, episode >= 0, 3, 0)
    before = {name: value.clone() for name, value in ready.algorithm.modules().state_dict().items()}
    folds = [learned_without(*parts, fold == out, [8, 48]) for out in range(3)]
    first, last = joined([unpacked(packed(moments)) for moments in folds])
    assert (first.kl, last.kl) == tuple(moment.kl for moment in joined(folds))
    after = ready.algorithm.modules().state_dict()
    assert all(torch.equal(value, before[name]) for name, value in after.items())
    assert (first.steps, last.steps) == (8, 48) and 0 < first.kl != last.kl
    assert len(last.left_out) == len(episode.unique()) and len(last.learned) == 2 * len(last.left_out)
    learned, left_out = mean_gain(last.learned), mean_gain(last.left_out)
    assert learned is not None and left_out is not None and learned.value > 2 * learned.error
    assert (left_out.value > 2 * left_out.error) == true, (learned, left_out)
    assert true or left_out.value < learned.value / 3


def test_tables_and_what_cannot_be_asked(tmp_path: Path) -> None:
    cfg, ready = begun(tmp_path, "rl.minibatch=64", "policy.head.std=0.07")
    found = measured(cfg, ready, 0, 2, anew)
    text = tables(found, 2)
    assert (
        text.count("| move the square") == 2 and "holds on episodes" in text and found.own == found.decisions
    )
    assert json.loads(json.dumps(plain(found)))["by_steps"][-1]["steps"] == found.by_steps[-1]["steps"]
    untold = tables(replace(found, by_steps=[{**found.by_steps[0], "kl": None, "left_out": None}]), 2)
    assert "| - |" in untold and "holds on episodes" not in untold
    with pytest.raises(ConfigError, match="fewer folds"):
        measured(cfg, ready, 0, 900, anew)
    with pytest.raises(ConfigError, match="2 of them at least"):
        cross_validate(load_config(["experiment=soak"]), tmp_path, 1, 1)
    with pytest.raises(ConfigError, match=r"not come to round 1 .*first `worldloop run`"):
        cross_validate(load_config(["experiment=soak"]), tmp_path, 1, 2)
