"""Judges that know a goal: progress towards it, and what the golden goal does where there is none."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from envs.judges.goal import Goals
from envs.judges.goal_image import GoalImageJudge
from envs.judges.golden_goal import GoldenGoalJudge
from envs.specs import Status
from envs.targets import ConfigError, build
from tests.embodiments import ARM_DELTAS, world_spec
from tests.envs.judges.test_conformance import TINY_TEXT_WORLD
from tests.envs.nearing import nearing
from tests.moving_square import SIZE, picture
from tests.sections import merged, section

TEXTS = ["to the corner", "to the middle"]
METRIC = {"_target_": "envs.judges.perceptual.PerceptualDistance"}
SPEC = world_spec(ARM_DELTAS.at(SIZE), SIZE)


def shown(*places: tuple[float, float]) -> torch.Tensor:
    """Frames uint8 [1, T, V, 3, H, W] of the moving square at some places in 0..1."""
    return torch.from_numpy(np.stack([picture(np.array(place), SPEC.views) for place in places]))[None]


def test_progress_rises_towards_a_given_picture(tmp_path: Path) -> None:
    goal = shown((0.9, 0.9))[0, 0, SPEC.embodiment.main_view]
    cv2.imwrite(str(tmp_path / "goal.png"), goal.permute(1, 2, 0).numpy()[..., ::-1])
    judge = GoalImageJudge(SPEC, 1, 0.9, METRIC, str(tmp_path / "goal.png"))
    frames = shown((0.1, 0.1), (0.8, 0.8), (0.9, 0.9))
    judged = judge.score(frames, frames[:, 0], ["to the corner"])
    start, near, there = judged.progress[0].tolist()
    assert start == 0.0 and 0.05 < near < there and there == pytest.approx(1.0, abs=1e-3)
    assert torch.equal(judged.success, judged.progress)
    assert judge.facts() == {"metric": "NLPD (normalised Laplacian pyramid)"}
    with pytest.raises(ValueError, match="no picture that OpenCV reads"):
        GoalImageJudge(SPEC, 1, 0.9, METRIC, None)


def test_what_is_missing_is_said_before_anything_is_learned() -> None:
    lpips = {"_target_": "envs.judges.lpips.LPIPS", "network": "nowhere.pth", "linear": "nowhere.pth"}
    with pytest.raises(ConfigError, match=r"judge\.picture=goal\.png is no picture"):
        GoalImageJudge.check({"metric": METRIC, "picture": "goal.png"})
    with pytest.raises(ConfigError, match=r"judge\.metric .*network=nowhere\.pth does not exist"):
        GoldenGoalJudge.check(section("judge/golden_goal", metric=lpips))
    words = {"_target_": "envs.simulators.tokens.words.T5Words", "folder": "nowhere", "max_tokens": 8}
    with pytest.raises(ConfigError, match=r"judge\.text_world\.words .*nowhere"):
        GoldenGoalJudge.check(section("judge/golden_goal", text_world={"words": words}))
    GoldenGoalJudge.check(section("judge/golden_goal"))


def golden(fallback: str = "drop", threshold: float = 0.0, cache: int = 8) -> GoldenGoalJudge:
    """With a text world of random weights, which ends as soon as it says more than `threshold`."""
    torch.manual_seed(0)
    world = merged(TINY_TEXT_WORLD, {"ending": {"threshold": threshold}})
    options = section("judge/golden_goal", text_world=world, fallback=fallback, cache=cache)
    options.pop("rewards")
    return build(options, "judge", spec=SPEC).eval()  # type: ignore[no-any-return]


def episodes() -> tuple[torch.Tensor, torch.Tensor]:
    frames = torch.cat([shown((0.1, 0.1), (0.4, 0.4), (0.9, 0.9)), shown((0.5, 0.2), (0.3, 0.3), (0.2, 0.6))])
    return frames, frames[:, 0]


def test_goals_are_imagined_once_for_each_first_frame_and_instruction() -> None:
    judge, (frames, first) = golden(), episodes()
    whole = judge.score(frames, first, TEXTS)
    parts = [judge.score(frames[:, t : t + 1], first, TEXTS) for t in range(3)]
    assert torch.allclose(torch.cat([part.progress for part in parts], 1), whole.progress, atol=1e-5)
    assert torch.allclose(torch.cat([part.success for part in parts], 1), whole.success, atol=1e-5)
    assert judge.facts() == {
        "metric": "NLPD (normalised Laplacian pyramid)",
        **{
            "success_by": "done",
            "fallback": "drop",
            "ending_threshold": 0.0,
            "goals": 2,
            "goals_unfinished": 0,
        },
    }
    judge.score(frames, first, TEXTS[::-1])  # other words are other goals
    assert judge.imagined == 4
    few = golden(cache=1)
    for _ in range(2):
        again = few.score(frames, first, TEXTS)
        assert torch.allclose(again.progress, whole.progress, atol=1e-5)  # the same goals
    assert few.imagined == 3 and len(few._known) == 1


class Reached(GoldenGoalJudge):
    """Its goals are what its text world draws of given frames."""

    ends: torch.Tensor

    def goals(self, first: torch.Tensor, instruction: list[str]) -> Goals:
        known = torch.ones(len(first), dtype=torch.bool)
        return Goals(self.text_world.redraw(self.ends[:, None])[:, 0], known)


@pytest.mark.parametrize("cameras", ["all", "main"])
def test_what_shows_the_goal_is_all_the_way_there_however_coarse_the_tokenizer_is(cameras: str) -> None:
    torch.manual_seed(0)
    target = f"{Reached.__module__}.{Reached.__name__}"
    options = section("judge/golden_goal", text_world=TINY_TEXT_WORLD, _target_=target, cameras=cameras)
    options.pop("rewards")
    judge: Reached = build(options, "judge", spec=SPEC).eval()
    frames, first = episodes()
    judge.ends = frames[:, -1]
    assert float((judge.as_goals(frames) - frames.float()).abs().mean()) > 5  # it keeps little of a frame
    progress = judge.score(frames, first, TEXTS).progress
    assert torch.equal(progress[:, 0], torch.zeros(2)) and torch.equal(progress[:, -1], torch.ones(2))
    one = judge.score(frames[:, -1:], first, TEXTS).progress
    assert torch.allclose(one, progress[:, -1:], atol=1e-5)


def test_frames_are_compared_with_a_given_picture_as_they_are(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "goal.png"), np.zeros((8, 8, 3), np.uint8))
    judge, (frames, _) = GoalImageJudge(SPEC, 1, 0.9, METRIC, str(tmp_path / "goal.png")), episodes()
    assert judge.as_goals(frames) is frames


def test_away_is_the_mean_distance_of_the_cameras_that_are_compared() -> None:
    judge, (frames, _) = golden(), episodes()
    seen = judge.as_goals(frames)
    goals = seen[:, 0]
    each = torch.stack([judge.metric(seen[:, 1, view], goals[:, view]) for view in judge.chosen], 1)
    found = judge.away(frames[:, :2], goals)
    assert torch.allclose(found, torch.stack((torch.zeros(2), each.mean(1)), 1), atol=1e-6)
    assert (found[:, 1] > 0).all()


def test_other_weights_imagine_other_goals() -> None:
    judge, (_, first) = golden(), episodes()
    before = judge.goals(first, TEXTS).frames
    weights = {name: value + 0.1 for name, value in judge.text_world.state_dict().items()}
    judge.text_world.load_state_dict(weights)
    assert not torch.equal(judge.goals(first, TEXTS).frames, before)
    assert judge.imagined == 4 and not any(p.requires_grad for p in judge.parameters())
    assert not judge.train().text_world.training


@pytest.mark.parametrize("fallback", ["drop", "last_frame", "progress_only"])
def test_a_text_world_that_never_says_done_is_counted_and_handled_as_asked(fallback: str) -> None:
    judge, shape = golden(fallback, threshold=1.0), episodes()[1].shape
    first = torch.randint(0, 256, shape, dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    judged = judge.score(nearing(judge, first, TEXTS)[:, None], first, TEXTS)
    assert judge.facts()["goals_unfinished"] == judge.facts()["goals"] == 2
    status = Status.ABSTAIN if fallback == "drop" else Status.OK
    assert judged.status.tolist() == [status.value] * 2
    assert bool((judged.success == 0).all()) == (fallback == "progress_only")
    assert bool(judged.progress.any())
    advice = type(judge).remedy({"text_world": {}, "fallback": fallback})
    assert ("or set judge.fallback=" in advice) == (fallback == "drop")  # which the others have done


def test_a_fallback_that_nobody_knows_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"judge\.fallback='hope' should"):
        golden("hope")
