"""The study of how actions are told: squares are found in pictures, and the whole of it runs and goes on."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from actors.factory import open_clips
from envs.files import write_json
from envs.physics.gridworld import EDGE, Gridworld
from envs.rng import Stream, episode_rng
from envs.simulators.replay import Replay
from envs.targets import ConfigError, build
from pipeline.commands.worlds.gridworld import gridworld, table, variant
from pipeline.config import load_config
from pipeline.evaluation.squares import find_squares, square_errors
from tests.pipeline.commands.test_cli import worldloop

TINY = [
    *("experiment=gridworld", "task.horizon=3", "launch.workers=1"),
    *("collect.episodes.train=3", "collect.episodes.held_out=2", "collect.episodes.calibration=1"),
    *("tokenizer_fit.steps=2", "tokenizer_fit.batch=4"),
    *("simulator_fit.first.fit.steps=2", "simulator_fit.first.fit.batch=2"),
    *("simulator.net.layers=1", "simulator.net.heads=1", "simulator.codec.width=8"),
]


def suite(squares: int = 3, size: tuple[int, int] = (32, 32)) -> Gridworld:
    return Gridworld(squares, size, ["above"], 10, 0.3)


def spoken(text: str) -> list[float]:
    """The numbers that a text says."""
    words = text.replace("minus", ",-").replace("plus", ",").replace("point", ".").replace(" ", "")
    return [float(number) for number in words.split(",")[1:]]


def test_squares_are_found_to_a_part_of_a_pixel_and_hidden_ones_are_not() -> None:
    world, found = suite(), 0
    for seed in range(20):
        world.reset("centre", seed)
        places, seen = find_squares(torch.from_numpy(world.render()[0]), 3)
        true = torch.from_numpy(world.privileged()["object_poses"][:, :2] * EDGE).float()
        apart = (true[:, None] - true).abs().amax(-1) > 64
        clear = [k for k in range(3) if apart[k, torch.arange(3) != k].all()]
        assert seen[clear].all() and ((places - true)[clear].norm(dim=-1) < 3.0).all()
        found += len(clear)
    assert found > 20
    world._at[:] = EDGE / 2
    assert find_squares(torch.from_numpy(world.render()[0]), 3)[1].tolist() == [False, False, True]


def test_squares_move_by_the_action_and_stay_in_the_picture() -> None:
    world = suite(2)
    world.reset("centre", 3)
    before = world.observe().state
    action = np.array([10.0, -5.0, 3.0, 400.0]) * np.where(before > 128, -1, 1)
    world.step(action)
    moved = world.observe().state - before
    assert np.allclose(moved[:3], action[:3]) and abs(moved[3]) == 64.0
    for _ in range(9):
        world.step(np.array([64.0, 64.0, -64.0, -64.0]))
    assert world.observe().state.tolist() == [224.0, 224.0, 32.0, 32.0]
    with pytest.raises(ConfigError, match=r"task\.suite\.squares=4"):
        suite(4)


@pytest.mark.long
def test_the_study_runs_and_goes_on_where_it_was(tmp_path: Path) -> None:
    cfg = load_config(TINY)
    told = variant(cfg, 3, "digits")
    assert told["task"]["suite"]["squares"] == 3 and "ActionText" in told["simulator"]["actions"]["_target_"]
    drawn = episode_rng(0, Stream.START).uniform(-64, 64, (50, 6))  # two velocities of each of three squares
    text = build(told["simulator"]["actions"], "simulator.actions", embodiment=suite().embodiment)
    said = [spoken(text.describe(row)) for row in drawn.tolist()]
    assert abs(np.sum(said, 0) - np.sum(drawn, 0)).max() < 0.1  # where squares are after 50 steps
    assert "ActionVector" in cfg["simulator"]["actions"]["_target_"]
    out = gridworld(cfg, tmp_path, [1], None)
    rows = json.loads((tmp_path / "gridworld.json").read_text())
    assert [row["representation"] for row in rows] == ["numbers", "digits"]
    assert list(rows[0]["errors"]) == ["1"] and rows[0]["errors"]["1"]["finder"] < 3.0
    assert "| 1 | numbers |" in out and "| 1 | digits |" in out
    made = {path: path.stat().st_mtime_ns for path in tmp_path.glob("stages/*/weights.safetensors")}
    assert len(made) == 4 and len(list(tmp_path.glob("stages/collect-*"))) == 1
    assert gridworld(cfg, tmp_path, [1], None) == out
    assert {path: path.stat().st_mtime_ns for path in made} == made
    nothing_is_seen(variant(cfg, 1, "numbers"), tmp_path, rows[0])


def nothing_is_seen(cfg: dict[str, Any], root: Path, row: dict[str, Any]) -> None:
    """Lost squares, and those that are in no true picture, have no errors, and the table says so."""
    store = open_clips(cfg, list(root.glob("stages/collect-*/dataset")))
    episodes = store.split("held_out")
    rows, valid = store.whole(episodes)
    dark = torch.zeros_like(store.frames(rows))
    made = Replay(dark, rows, valid, torch.zeros(0), torch.zeros(0))
    lost = square_errors(store, episodes, made, (1,))
    none = square_errors(store, episodes, made._replace(valid=torch.zeros_like(valid)), (1,))
    assert lost["1"]["error"] is None and lost["1"]["lost"] == 1.0 and lost["1"]["still"] > 0
    assert set(none["1"].values()) == {None}
    write_json(root / "lost.json", [lost, none])  # which refuses NaN
    said = table([{**row, "errors": lost}, {**row, "errors": none}]).splitlines()[-2:]
    assert "| all lost |" in said[0] and said[1].endswith("| no square to be seen | - |")


def test_numbers_of_squares_are_checked() -> None:
    done = worldloop("gridworld", "squares=one")
    assert done.returncode == 1 and "squares=one: say whole numbers" in done.stderr
