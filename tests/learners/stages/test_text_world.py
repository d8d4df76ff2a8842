"""Teaching a text world: from successes alone, the tokenizer first."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

import envs.simulators.replay as replaying
from envs.embodiment import Embodiment
from envs.episodes import LeRobotWriter
from envs.episodes.clips import ClipStore
from learners.stages.text_world import SuccessfulClips, calibrate_ending, longest_of, train_text_world
from learners.training.fit import FitConfig
from tests.embodiments import ARM_DELTAS, world_spec
from tests.envs.simulators.clips import moving_square
from tests.envs.simulators.test_text_world import TEXTS, lean, world
from tests.moving_square import INSTRUCTION, SIZE, episodes_of
from tests.moving_square import moving_square as square_episode

Stores = Callable[[Embodiment], ClipStore]


@pytest.mark.long
def test_it_learns_from_successes_and_then_goes_where_they_go(tiny_store: Stores, tmp_path: Path) -> None:
    store, model = tiny_store(ARM_DELTAS), world(window=6, ending={"max_frames": 3})
    every = torch.arange(len(store))
    short = FitConfig(30, 8, 5e-3, warmup=3, ema=0.8, bf16=False)
    stats = train_text_world(model, store, every, 2, short, tmp_path, tokenizer=short)
    assert stats["successes"] == len(store.select(succeeded=True)) < len(store)
    assert stats["tokenizer_alarm"] == "" and stats["tokenizer_perplexity"] > 1
    kept = [json.loads(line)["tokenizer/psnr"] for line in (tmp_path / "tokenizer/metrics.jsonl").open()]
    rows = [json.loads(line)["text_world/loss"] for line in (tmp_path / "metrics.jsonl").open()]
    assert sum(kept[-5:]) > sum(kept[:5]) + 10 and sum(rows[-5:]) < 0.8 * sum(rows[:5])
    first = store.frames(store.start[:2])
    golden = model.imagine(first, [INSTRUCTION] * 2, torch.arange(2))
    assert golden.frames.shape[0] == 2 and golden.frames.shape[1] <= 3


class Sees(nn.Module):
    """Stands for a text world that says of each frame how near the square has come to the corner.

    Args:
        shift: of all that it says.
    """

    def __init__(self, shift: float):
        super().__init__()
        self.register_buffer("threshold", torch.tensor(0.9))
        self.shift, self.asked = shift, list[tuple[int, ...]]()

    def done_along(self, frames: torch.Tensor, instruction: Sequence[str]) -> torch.Tensor:
        self.asked.append(tuple(frames.shape))
        light = frames[:, :, 0].float().mean(2)  # of the main view, [B, T, H, W]
        light = (light - light.amin((2, 3), keepdim=True)).square()
        down = torch.linspace(0, 1, light.shape[2])[:, None]
        return (light * down).sum((2, 3)) / light.sum((2, 3)) - self.shift


def test_a_trajectory_ends_where_recorded_frames_are_as_likely_done_as_not(tiny_store: Stores) -> None:
    store = tiny_store(ARM_DELTAS)
    every, found = torch.arange(len(store)), []
    for shift in (0.0, 0.2):
        sees = Sees(shift)
        assert calibrate_ending(sees, store, every, 2)  # type: ignore[arg-type]
        rows, valid = store.whole(every)
        right = (sees.done_along(store.frames(rows), ()) > sees.threshold) == (store.success(every, rows) > 0)
        assert float(right[valid].float().mean()) > 0.9
        found.append(float(sees.threshold))
    assert found[0] == pytest.approx(found[1] + 0.2, abs=0.05)
    sees = Sees(0.0)
    assert not calibrate_ending(sees, store, store.select(succeeded=False), 2)  # type: ignore[arg-type]
    assert float(sees.threshold) == pytest.approx(0.9)  # no frame shows success
    model = world(ending={"threshold": 0.97})
    lean(model, -3.0)  # of every frame the same, which rises with nothing
    assert not calibrate_ending(model, store, every, 2) and float(model.threshold) == pytest.approx(0.97)


def test_as_many_episodes_are_looked_at_at_once_as_have_room(
    tiny_store: Stores, monkeypatch: pytest.MonkeyPatch
) -> None:
    store, together, apart = tiny_store(ARM_DELTAS), Sees(0.0), Sees(0.0)
    every = torch.arange(len(store))
    assert calibrate_ending(together, store, every, 2)  # type: ignore[arg-type]
    (shape,) = together.asked
    maps = 2 if store.spec.pose_map else 1
    monkeypatch.setattr(replaying, "_ROOM", 3 * maps * math.prod(shape[1:]))  # of three episodes
    assert calibrate_ending(apart, store, every, 2)  # type: ignore[arg-type]
    assert [count for count, *_ in apart.asked] == [len(some) for some in every.split(3)]
    assert torch.equal(apart.threshold, together.threshold)


def test_what_is_said_along_a_video_hangs_on_the_frames_before_it() -> None:
    model = world()  # of four frames
    lean(model, 0.0, spread=30.0)
    frames = moving_square(model.video.spec, torch.linspace(0.1, 0.9, 6).expand(3, -1))
    said = model.done_along(frames, TEXTS)
    assert said.shape == (3, 6) and torch.allclose(said[:, :4], model.done(frames[:, :4], TEXTS), atol=1e-4)
    other = model.done_along(frames.flip(1)[:, 1:5], TEXTS)  # the same frame after others
    assert not torch.allclose(other[:, 3], said[:, 1], atol=1e-3)


def test_clips_rest_at_the_end_where_the_task_is_done(tiny_store: Stores) -> None:
    store = tiny_store(ARM_DELTAS)
    good = store.select(succeeded=True)
    clips = SuccessfulClips(store, good, frames=8, stride=3).sample(64, torch.Generator().manual_seed(0))
    assert clips["frames"].shape[:2] == (64, 8) and clips["valid"].all()
    assert bool((clips["success"][:, -1] == 1).all()) and bool((clips["success"][:, 0] == 0).any())
    assert torch.equal(clips["frames"][:, -1], clips["frames"][:, -2])


def test_data_without_successes_are_refused(tiny_store: Stores, tmp_path: Path) -> None:
    store = tiny_store(ARM_DELTAS)
    failed = store.select(succeeded=False)
    with pytest.raises(ValueError, match="no episode to learn from is labelled a success"):
        train_text_world(world(), store, failed, 1, FitConfig(1, 1, 1e-3), tmp_path)


def test_where_nobody_labelled_anything_demonstrations_are_done_at_their_end(tmp_path: Path) -> None:
    robot, episodes = ARM_DELTAS.at(SIZE), episodes_of(ARM_DELTAS)[:8]
    LeRobotWriter(tmp_path / "data", robot).write([replace(one, success=None) for one in episodes])
    store = ClipStore([tmp_path / "data"], world_spec(robot, SIZE))
    every, model = torch.arange(len(store)), world(window=6)
    clips = SuccessfulClips(store, every, frames=8, stride=3).sample(64, torch.Generator().manual_seed(0))
    at_rest, done = (clips["frames"] == clips["frames"][:, -1:]).flatten(2).all(2), clips["success"] == 1
    assert bool(at_rest[done].all()) and bool(done[:, -1].all()) and not done.all()
    assert longest_of(store, every, 1) == -(-5 * (int(store.length.max()) - 1) // 4)
    stats = train_text_world(model, store, every, 2, FitConfig(2, 4, 1e-3, bf16=False), tmp_path / "fit")
    assert stats["successes"] == len(store)
    assert calibrate_ending(Sees(0.0), store, every, 2)  # type: ignore[arg-type]


def test_an_instruction_that_would_be_cut_is_refused_before_training_whatever_its_split(
    tiny_data: Callable[[Embodiment], Path], tmp_path: Path
) -> None:
    robot, wordy = ARM_DELTAS.at(SIZE), "move the square " + "and move it again " * 20
    failed = square_episode(ARM_DELTAS, 1, "random")
    LeRobotWriter(tmp_path / "data", robot).write([replace(failed, instruction=wordy)])
    store = ClipStore([tiny_data(ARM_DELTAS), tmp_path / "data"], world_spec(robot, SIZE))
    learned = torch.arange(len(store) - 1)  # without it
    with pytest.raises(ValueError, match=rf"'move the square .*has {len(wordy)} bytes"):
        train_text_world(world(), store, learned, 1, FitConfig(1, 1, 1e-3), tmp_path)
    assert not (tmp_path / "metrics.jsonl").exists()


@pytest.mark.parametrize("length", [13, 80])
def test_trajectories_may_take_as_long_as_recorded_successes_do_and_a_quarter_more(
    length: int, tmp_path: Path
) -> None:
    robot = ARM_DELTAS.at(SIZE)
    some = [square_episode(ARM_DELTAS, seed, "expert" if seed % 2 else "random", length) for seed in range(6)]
    late = [
        np.arange(length) >= length - 3 + seed % 3 if seed % 2 else one.success
        for seed, one in enumerate(some)
    ]
    some = [replace(one, success=success) for one, success in zip(some, late, strict=True)]
    LeRobotWriter(tmp_path / "data", robot).write(some)
    store = ClipStore([tmp_path / "data"], world_spec(robot, SIZE))
    assert longest_of(store, store.select(succeeded=True), 2) == math.ceil((length - 1) * 1.25 / 2)
    model, short = world(ending={"max_frames": None}), FitConfig(1, 2, 1e-3, bf16=False)
    assert model.max_frames == model.window  # until it is trained
    train_text_world(model, store, torch.arange(len(store)), 2, short, tmp_path)
    lean(model, -5.0)
    again = world(ending={"max_frames": None})
    again.load_state_dict(model.state_dict())
    for made in (model, again):
        golden = made.imagine(store.frames(store.start[:1]), [INSTRUCTION], torch.arange(1))
        assert golden.frames.shape[1] == math.ceil((length - 1) * 1.25 / 2) and not golden.finished.any()
    assert world(ending={"max_frames": 5}).max_frames == 5
