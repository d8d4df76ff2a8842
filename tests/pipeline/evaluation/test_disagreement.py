"""Imagination against truth, episode by episode: confidence, verdicts, the worst first; scenes."""

from __future__ import annotations

from typing import Any

import pytest
import torch

import envs.simulators.replay as replaying
from envs.episodes.clips import ClipStore
from envs.judges.base import Judge, Judgement
from envs.judges.fitted import FittedJudge
from envs.physics.suite import scene_of
from envs.simulators.base import Simulator
from envs.simulators.replay import Replay
from pipeline.evaluation.by_task import by_scene, scenes_of_seeds
from pipeline.evaluation.disagreement import compared, curves, worst
from pipeline.evaluation.judging import judge_both, judge_frames, judge_recorded
from pipeline.evaluation.statistics import rate_entry
from tests.embodiments import ARM_DELTAS, world_spec
from tests.moving_square import SIZE
from tests.suites.counting import Counting

FRAMES = 6
NOBODY: Simulator = None  # type: ignore[assignment]  # no judge here reads its features


class Brightness(Judge):
    """Takes a frame's brightness for the probability of success."""

    def __init__(self) -> None:
        super().__init__(hold=2)

    def score(self, frames: torch.Tensor, first: torch.Tensor, instruction: list[str]) -> Judgement:
        bright = frames.float().mean((-4, -3, -2, -1)) / 255
        return Judgement(bright, bright / 2, torch.zeros(len(frames), dtype=torch.int64))


class Store:
    """Three episodes of FRAMES frames, two with bright ones; of the last nobody knows success."""

    def __init__(self) -> None:
        bright = torch.tensor(
            [[0, 0, 0, 0, 255, 255], [0] * FRAMES, [0, 0, 255, 255, 0, 0]], dtype=torch.uint8
        )
        self.pictures = bright.flatten()[:, None, None, None, None].expand(-1, 1, 3, 2, 2).clone()
        self.arrays = {"present": torch.ones(3 * FRAMES, dtype=torch.bool)}
        self.start = torch.arange(3) * FRAMES
        self.spec = world_spec(ARM_DELTAS.at(SIZE), SIZE, chunk=2)
        self.read: list[tuple[int, ...]] = []
        self.instructions = ["do a", "do b", "do a"]
        self.episodes: list[dict[str, Any]] = [
            {"seed": 10 + n, "source": "noisy", "instruction": text, "success": success}
            for n, (text, success) in enumerate(zip(self.instructions, (True, False, None), strict=True))
        ]

    def frames(self, rows: torch.Tensor) -> torch.Tensor:
        self.read.append(tuple(rows.shape))
        return self.pictures[rows]


def replayed(generated: list[list[int]], valid: int = FRAMES - 1) -> Replay:
    count = len(generated)
    frames = torch.tensor(generated, dtype=torch.uint8)[:, :, None, None, None, None].expand(
        -1, -1, 1, 3, 2, 2
    )
    rows = torch.arange(count)[:, None] * FRAMES + torch.arange(1, FRAMES)
    exists = (torch.arange(FRAMES - 1) < valid).expand(count, -1)
    return Replay(frames, rows, exists, torch.zeros(count, FRAMES - 1, 1), torch.zeros(count, 2, 3))


def test_the_surer_and_the_more_wrong_the_worse() -> None:
    store: ClipStore = Store()  # type: ignore[assignment]
    judge, episodes = Brightness(), torch.arange(3)
    made = replayed([[0, 0, 0, 51, 51], [0, 204, 204, 204, 0], [255, 255, 0, 0, 0]])
    views = judge_both(judge, NOBODY, store, episodes, made, bf16=False)
    rows = compared({"task": {"name": "any"}}, judge, store, episodes, made, views)
    assert [row["generated"] for row in rows] == [0.2, 0.8, 1.0]
    assert [row["recorded"] for row in rows] == [1.0, 0.0, 1.0]
    assert [row["claims"] for row in rows] == [False, True, True]
    assert [row["disagreement"] for row in rows] == [0.8, 0.8, 0.0]
    assert [row["task"] for row in rows] == ["do a", "do b", "do a"] and rows[2]["success"] is None
    assert [row["episode"] for row in worst(rows[::-1], 2)] == [1, 0]
    assert curves(views, made, 1)["generated"] == pytest.approx([0, 0.4, 0.4, 0.4, 0])


def test_a_verdict_that_contradicts_is_worse_than_one_that_agrees_by_whatever_threshold() -> None:
    store: ClipStore = Store()  # type: ignore[assignment]
    judge, episodes = Brightness(), torch.arange(2)
    judge.threshold.fill_(0.05)  # .1 is success: surely of the failed one, hardly of the other
    made = replayed([[0, 0, 26, 26, 26], [0, 26, 26, 26, 0]])
    views = judge_both(judge, NOBODY, store, episodes, made, bf16=False)
    rows = compared({"task": {"name": "any"}}, judge, store, episodes, made, views)
    assert [row["claims"] for row in rows] == [True, True] and rows[0]["success"]
    assert rows[0]["disagreement"] < 0.5 < rows[1]["disagreement"]
    assert worst(rows, 1)[0]["episode"] == 1


def test_frames_that_do_not_exist_count_for_nothing() -> None:
    store: ClipStore = Store()  # type: ignore[assignment]
    judge, made = Brightness(), replayed([[0, 0, 255, 255, 255]], valid=3)
    views = judge_both(judge, NOBODY, store, torch.tensor([0]), made, bf16=False)
    (row,) = compared({"task": {"name": "any"}}, judge, store, torch.tensor([0]), made, views)
    assert row["generated"] == 0.0 and not row["claims"] and len(curves(views, made, 0)["recorded"]) == 3


class Doubtful(FittedJudge):
    """Takes a frame's brightness for the logit of success, from -8 to 8."""

    reads_features = True

    def __init__(self) -> None:
        super().__init__(hold=2, margin=0.3, discount=1.0)
        self.read = torch.zeros(0)

    def score(
        self,
        frames: torch.Tensor,
        first: torch.Tensor,
        instruction: list[str],
        features: torch.Tensor | None = None,
    ) -> Judgement:
        assert features is not None
        self.read = features
        bright = frames.float().mean((-4, -3, -2, -1)) / 255
        return self.judgement((16 * bright - 8).unsqueeze(-1).expand(*bright.shape, 2))


def test_a_judge_is_shown_nothing_past_an_episodes_end() -> None:
    """It would abstain for what did not happen, and a model asked about a clip would look at its last
    picture.
    """
    store: ClipStore = Store()  # type: ignore[assignment]
    judge, made = Doubtful(), replayed([[0, 0, 128, 128, 128], [0, 0, 0, 255, 128]])
    valid = torch.arange(5) < torch.tensor([[2], [4]])
    features = torch.arange(6.0).reshape(2, 3, 1)
    scores = judge_frames(judge, made.frames, valid, store, torch.arange(2), features)
    assert scores.judged.tolist() == [True, True]
    assert scores.success.round().tolist() == [[0] * 5, [0, 0, 0, 1, 1]]
    assert judge.read.squeeze(-1).tolist() == [[0, 0, 0], [3, 4, 4]]
    whole = judge_frames(judge, made.frames, torch.ones_like(valid), store, torch.arange(2), features)
    assert whole.judged.tolist() == [False, True]
    rows = torch.arange(2)[:, None] * FRAMES + torch.arange(1, FRAMES)  # as long strides show an end
    dark = judge_recorded(judge, store, torch.arange(2), rows, torch.arange(5).expand(2, -1) < 3, features)
    assert dark.success.round().sum() == 0


def test_as_many_recorded_episodes_are_read_at_once_as_have_room(monkeypatch: pytest.MonkeyPatch) -> None:
    store: ClipStore = Store()  # type: ignore[assignment]
    every, rows = torch.arange(3), torch.arange(3)[:, None] * FRAMES + torch.arange(1, FRAMES)
    given = (Brightness(), store, every, rows, torch.ones(3, FRAMES - 1) > 0)
    together = judge_recorded(*given)
    monkeypatch.setattr(replaying, "_ROOM", 1)
    store.read.clear()  # type: ignore[attr-defined]
    for one, other in zip(judge_recorded(*given), together, strict=True):
        assert torch.equal(one, other)
    assert store.read == [(1,), (1, FRAMES - 1)] * 3  # type: ignore[attr-defined]


def test_recorded_frames_without_a_picture_show_no_success() -> None:
    store: ClipStore = Store()  # type: ignore[assignment]
    store.pictures[:] = 255  # type: ignore[attr-defined]
    rows = torch.arange(1, FRAMES)[None]
    for dark, found in ((FRAMES, 1.0), (2, 0.0)):
        store.arrays["present"][dark::2] = False
        scores = judge_recorded(Brightness(), store, torch.tensor([0]), rows, torch.ones(1, 5) > 0)
        assert Brightness().confidence(scores.success).tolist() == [found]


def test_confidence_is_the_highest_threshold_that_still_says_success() -> None:
    judge, success = Brightness(), torch.tensor([[0.9, 0.1, 0.6, 0.7], [0.2, 0.3, 0.1, 0.1]])
    confidence = judge.confidence(success)
    assert confidence.tolist() == pytest.approx([0.6, 0.2])
    for shift, wanted in ((-1e-4, True), (1e-4, False)):
        for row in range(2):
            judge.threshold.fill_(float(confidence[row]) + shift)
            assert bool(judge.episode(success, torch.ones(2, 4, dtype=torch.bool))[row]) is wanted
    assert judge.confidence(success[:, :1]).tolist() == [0.0, 0.0]  # too short to hold


class Rooms(Counting):
    """A suite with scenes."""

    scenes = ("oak", "pine")


def test_scenes_are_what_the_suite_says_they_are() -> None:
    section = {"_target_": f"{Rooms.__module__}.Rooms", "fault": ""}
    scenes = scenes_of_seeds({"task": {"suite": section}}, range(20))
    assert scenes == [scene_of(Rooms.scenes, seed) for seed in range(20)] and set(scenes) == {"oak", "pine"}
    plain = {"_target_": f"{Counting.__module__}.Counting", "fault": ""}
    assert scenes_of_seeds({"task": {"suite": plain}}, range(2)) == ["", ""]
    won = torch.tensor([True, False, True, True])
    cells = by_scene(["a", "b", "a", "b"], ["x", "x", "y", "x"], rate_entry, won)
    found = [(cell["task"], cell["scene"], cell["successes"], cell["episodes"]) for cell in cells]
    assert found == [("a", "x", 1, 1), ("a", "y", 1, 1), ("b", "x", 1, 2)]
    assert by_scene(["a"] * 4, [""] * 4, rate_entry, won) == []
