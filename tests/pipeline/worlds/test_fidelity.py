"""Fidelity and sweeps by one command each: pages, figures, and what is refused."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from actors.factory import open_clips
from envs.embodiment import Embodiment
from envs.episodes import LeRobotWriter
from envs.episodes.filming import BAR
from envs.episodes.splits import write_splits
from envs.specs import at_rest
from envs.targets import ConfigError
from pipeline.commands.worlds.fidelity import fidelity
from pipeline.commands.worlds.sweep import commanded, sweep
from pipeline.config import load_config
from pipeline.evaluation.fidelity.masks import part_labels
from pipeline.evaluation.joined.page import parts_of
from tests.embodiments import ARM_DELTAS, BIMANUAL_POSES, world_spec
from tests.moving_square import SIZE, moving_square
from tests.worlds import scripted_set, untrained_world, written

SOAK = ["experiment=soak", "track=disabled", "launch.workers=1", "cameras=main"]


def test_fidelity_with_masks_from_physics(tmp_path: Path) -> None:
    soak = [*SOAK, "simulator=forcing_small"]  # whose blocks can be chosen at inference
    cfg = load_config(soak)
    data = scripted_set(cfg, tmp_path / "set", 3)
    words = [*soak, *untrained_world(cfg, tmp_path), f"imagined.data=[{data}]"]
    words += ["fidelity.long={frames: 30, episodes: 1, noise_level: 1.0}", "fidelity.strides=[1,2]"]
    grid = "{simulator.context: [1, 4], simulator.horizon: [9], task.chunk: [9]}"  # more than a chunk
    tried = load_config([*words, f"fidelity.grid={grid}"])
    said = fidelity(tried, tmp_path / "run")
    result = json.loads(written(tmp_path / "run", "fidelity.json").read_text())
    assert result["masks"] == {"source": "physics", "episodes": 3}
    assert set(result["overall"]) == {
        *("mse", "psnr", "ssim", "perceptual", "arm_mse", "object_mse"),
    }
    assert None not in result["overall"].values() and set(result["groups"]) == {"noisy"}
    held, coded = (row["psnr"] for row in result["held"].values())
    assert held > coded and "the same through the autoencoder" in said  # which has learned nothing
    assert len(result["frechet"]) == 2 and "no learned weights" in result["frechet"][0]["extractor"]
    assert result["long"]["frames"] == 32 and len(result["long"]["by_frame"]["mse"]) == 32
    assert [row["settings"] for row in result["grid"]["rows"]] == [
        {"simulator.context": context, "simulator.horizon": 9, "task.chunk": 9} for context in (1, 4)
    ]
    one, two = result["strides"]
    assert (one["stride"], two["stride"], two["covers"]) == (1, 2, 2 * one["covers"]) and one["seconds"] > 0
    assert one["frames"] >= two["frames"] > one["frames"] - 2 and None not in (one["arm_mse"], two["mse"])
    for row in (one, two):
        for video in ("generated", "recorded"):
            assert sum(row["verdicts"][video][name] for name in ("tp", "fp", "fn", "tn", "dropped")) == 3
    assert "| verdicts right |" in said and "Errors are those of frames 2, 4, ..." in said
    assert result["grid"]["figure"] == "arm_mse" and "Least arm MSE: simulator.context=" in said
    lost = result["object_lost"]  # of two rows of the summary none hides the other
    rows = {row.name: row.value for row in parts_of({"fidelity": result}, {})[0].rows}
    assert "The first object " in said and rows["object lost ↓"] == f"{lost:.1%}"
    hands = result["end_effector"]
    assert hands["truth"] == "physics" and "line of sight of head" in hands["method"]
    assert hands["generated_cm"]["median"] > 0 and "End effectors lie" in said
    # nothing is done twice: neither what physics says of masks, nor the one batch, that of each setting and
    # that of long rollouts
    again = fidelity(tried, tmp_path / "run")
    assert said.endswith("0 parts were reused") and again.endswith("7 parts were reused")
    both = json.loads(written(tmp_path / "run", "fidelity.json").read_text())
    for name in ("overall", "by_frame", "frechet", "long", "strides", "end_effector", "object_cm"):
        assert both[name] == result[name]
    page = written(tmp_path / "run", "fidelity.html").read_text()
    assert (
        "Frechet distances" in page
        and "Strides at inference" in page
        and not re.findall(r'(?:src|href)=(?!"#)', page)
    )
    with pytest.raises(ConfigError, match=r"fidelity\.strides=\[30, 7\] first show the same frame after 210"):
        fidelity(load_config([*words, "fidelity.strides=[30,7]"]), tmp_path / "run")
    with pytest.raises(ConfigError, match="another architecture"):
        fidelity(load_config([*words, "fidelity.grid={simulator.net.layers: [2]}"]), tmp_path / "run")
    with pytest.raises(ConfigError, match=r"fidelity\.frames_extractor\._target_=.*single frames"):
        clips = "fidelity.frames_extractor._target_=pipeline.evaluation.fidelity.extractors.PyramidClips"
        fidelity(load_config([*words, clips]), tmp_path / "run")
    # Masks of episodes that physics cannot repeat are masks of something else.
    store = open_clips(cfg, [data])
    for row in store.episodes[1:]:
        row["seed"] += 1000
    labels = part_labels(cfg, store, torch.arange(3))
    assert (labels[0] != 255).any() and (labels[1:] == 255).all()


def test_of_episodes_of_one_frame_nothing_can_be_measured(tmp_path: Path) -> None:
    made = [moving_square(ARM_DELTAS, seed, length=1 if seed else 6) for seed in range(3)]
    LeRobotWriter(tmp_path / "set", ARM_DELTAS.at(SIZE)).write(made)
    write_splits(tmp_path / "set", {"train": 1, "held_out": 2, "calibration": 0})
    words = ["experiment=smoke", "track=disabled", "task=lerobot", f"task.data=[{tmp_path / 'set'}]"]
    words += ["task.size=[32,32]", "task.chunk=4", "task.horizon=8"]
    words += untrained_world(load_config(words), tmp_path)
    with pytest.raises(ConfigError, match=r"no held-out episode has 2 frames .*imagined\.data"):
        fidelity(load_config(words), tmp_path / "run")


def test_a_long_rollout_of_a_single_frame_is_none(tmp_path: Path) -> None:
    made = [moving_square(ARM_DELTAS, seed, length=1 if seed == 2 else 6) for seed in range(3)]
    LeRobotWriter(tmp_path / "set", ARM_DELTAS.at(SIZE)).write(made)
    write_splits(tmp_path / "set", {"train": 1, "held_out": 2, "calibration": 0})
    words = ["experiment=smoke", "track=disabled", "task=lerobot", f"task.data=[{tmp_path / 'set'}]"]
    words += ["task.size=[32,32]", "task.chunk=4", "task.horizon=8", "fidelity.long.frames=5"]
    words += untrained_world(load_config(words), tmp_path)
    fidelity(load_config(words), tmp_path / "run")
    result = json.loads(written(tmp_path / "run", "fidelity.json").read_text())
    assert result["episodes"] == result["long"]["episodes"] == 1


def test_a_judge_that_learns_nothing_is_asked_and_one_that_has_not_learned_is_not(
    tmp_path: Path, tiny_data: Callable[[Embodiment], Path]
) -> None:
    words = ["experiment=smoke", "track=disabled", "task=lerobot", f"task.data=[{tiny_data(ARM_DELTAS)}]"]
    words += ["task.size=[32,32]", "task.chunk=2", "task.horizon=8", "fidelity.strides=[1,2]"]
    words += ["fidelity.long.frames=0"]
    words += [
        word
        for word in untrained_world(load_config(words), tmp_path)
        if not word.startswith("imagined.judge")
    ]
    learned = fidelity(load_config([*words, "judge=learned"]), tmp_path / "run")
    assert cv2.imwrite(str(tmp_path / "goal.png"), np.zeros((32, 32, 3), np.uint8))
    goal = ["judge=goal_image", f"judge.picture={tmp_path / 'goal.png'}"]
    given = fidelity(load_config([*words, *goal]), tmp_path / "run")
    assert "No verdicts: the judge has learned nothing yet" in learned and "No verdicts" not in given
    rows = json.loads(written(tmp_path / "run", "fidelity.json").read_text())["strides"]
    assert all(row["verdicts"]["generated"] for row in rows)


@pytest.mark.long
def test_why_there_is_no_distance_between_clips(
    tmp_path: Path, tiny_data: Callable[[Embodiment], Path]
) -> None:
    words = ["experiment=smoke", "track=disabled", "task=lerobot", f"task.data=[{tiny_data(ARM_DELTAS)}]"]
    words += ["task.size=[32,32]", "task.chunk=2", "task.horizon=8", "fidelity.long.frames=0"]
    words += [*untrained_world(load_config(words), tmp_path), "fidelity.clip=500"]
    said = fidelity(load_config(words), tmp_path / "run")
    why = "that last 500 frames (fidelity.clip), and there is none"
    assert "clips of 500 frames: a covariance needs two samples " + why in said
    assert why in written(tmp_path / "run", "fidelity.html").read_text()
    one, two = json.loads(written(tmp_path / "run", "fidelity.json").read_text())["frechet"]
    assert one["value"] > 0 and two["value"] is None and "clips of" not in one["extractor"]


EXTRACTOR = """
import torch
from pipeline.evaluation.fidelity.extractors import Extractor


class Own(Extractor):
    name, clips = "our own", False

    def __call__(self, pictures: torch.Tensor) -> torch.Tensor:
        return {scale} * pictures.float().mean((-2, -1))
"""


@pytest.mark.long
def test_extractors_of_one_name_and_different_code_are_told_apart(
    tmp_path: Path, tiny_data: Callable[[Embodiment], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    words = ["experiment=smoke", "track=disabled", "task=lerobot", f"task.data=[{tiny_data(ARM_DELTAS)}]"]
    words += ["task.size=[32,32]", "task.chunk=2", "task.horizon=8", "fidelity.long.frames=0"]
    words += untrained_world(load_config(words), tmp_path)
    distances = []
    for scale in (1, 5):
        (tmp_path / f"own_{scale}.py").write_text(EXTRACTOR.format(scale=scale))
        fidelity(
            load_config([*words, f"fidelity.frames_extractor._target_=own_{scale}.Own"]), tmp_path / "run"
        )
        distances.append(
            json.loads(written(tmp_path / "run", "fidelity.json").read_text())["frechet"][0]["value"]
        )
    assert distances[1] > 5 * distances[0] > 0


@pytest.mark.parametrize("robot", [ARM_DELTAS, BIMANUAL_POSES], ids=lambda robot: robot.robot)
def test_a_contact_sheet_for_each_number_of_any_robot(
    robot: Embodiment, tmp_path: Path, tiny_data: Callable[[Embodiment], Path]
) -> None:
    words = ["experiment=smoke", "track=disabled", "task=lerobot", f"task.data=[{tiny_data(robot)}]"]
    words += ["task.size=[32,32]", "task.chunk=4", "task.horizon=8", "sweep.chunks=1", "sweep.pictures=3"]
    words += [*untrained_world(load_config(words), tmp_path), "sweep.levels=[-1.0,1.0]"]
    sheets = sweep(load_config(words), tmp_path / "run")
    assert [path.stem for path in sheets] == [f"{n:02d}-{name}" for n, name in enumerate(robot.action_names)]
    wide = 3 * (4 * 32 * len(robot.cameras) + 4)
    assert cv2.imread(str(sheets[0])).shape == (3 * (BAR + 4 * 32), wide, 3)
    rows = json.loads(written(tmp_path / "run", "sweep/sweep.json").read_text())["numbers"]
    assert all(row["changed"][0] == 0.0 for row in rows) and any(row["changed"][1] > 0 for row in rows)
    with pytest.raises(ConfigError, match=r"sweep\.episode=99: there are 20"):
        sweep(load_config([*words, "sweep.episode=99"]), tmp_path / "run")


@pytest.mark.long
def test_contact_sheets_ask_no_judge(tmp_path: Path, tiny_data: Callable[[Embodiment], Path]) -> None:
    words = ["experiment=smoke", "track=disabled", "task=lerobot", f"task.data=[{tiny_data(ARM_DELTAS)}]"]
    words += ["task.size=[32,32]", "task.chunk=4", "task.horizon=8", "sweep.chunks=1", "sweep.levels=[1.0]"]
    words += untrained_world(load_config(words), tmp_path)[:2]  # not its judge
    nobody_there = ["judge=vlm", "judge.chat.url=http://127.0.0.1:9/v1", "judge.chat.model=any"]
    for judge in ([], nobody_there):  # one that has not learned yet, and one that cannot be reached
        assert len(sweep(load_config([*words, *judge]), tmp_path / "run")) == ARM_DELTAS.action_dim


def test_deltas_are_repeated_and_absolute_numbers_go_there() -> None:
    start, travel = torch.ones(1, 4), torch.tensor([[0.0, 0.4, 0.0, 0.0]])
    assert commanded(world_spec(ARM_DELTAS), start, travel, 4)[0, :, 1].tolist() == pytest.approx([0.4] * 4)
    grip = torch.tensor([[0.3, 0.0, 0.0, 0.8]])  # the last command: a change, and where the gripper is
    still = commanded(world_spec(ARM_DELTAS), grip, torch.zeros(1, 4), 4)
    assert torch.equal(still, at_rest(grip, ARM_DELTAS)[:, None].expand(1, 4, 4))
    shut = commanded(world_spec(ARM_DELTAS), grip, torch.tensor([[0.0, 0.0, 0.0, -0.4]]), 4)[0]
    assert shut[:, 3].tolist() == pytest.approx([0.7, 0.6, 0.5, 0.4]) and not shut[:, :3].any()
    poses = torch.zeros(1, 14)
    poses[0, 1] = 0.4
    path = commanded(world_spec(BIMANUAL_POSES), torch.ones(1, 14), poses, 4)
    assert path[0, :, 1].tolist() == pytest.approx([1.1, 1.2, 1.3, 1.4]) and bool((path[0, :, 0] == 1).all())
