"""The golden goal whose success is the action world's word."""

from __future__ import annotations

import pytest
import torch

from envs.judges.base import Judge
from envs.simulators.inputs import build_inputs
from envs.simulators.tokens.engine import TokensSimulator
from envs.targets import ConfigError, build
from pipeline.config import load_config
from tests.embodiments import ARM_DELTAS, world_spec
from tests.envs.judges.test_conformance import TINY_TEXT_WORLD
from tests.envs.simulators.clips import clip
from tests.envs.simulators.test_engines import build_engine
from tests.sections import section

SPEC = world_spec(ARM_DELTAS, (32, 32))


def judge_of(feature_shape: tuple[int, ...]) -> Judge:
    options = section("judge/golden_goal_action", text_world=TINY_TEXT_WORLD, fallback="last_frame")
    options.pop("rewards")
    return build(options, "judge", spec=SPEC, feature_shape=feature_shape).eval()  # type: ignore[no-any-return]


def test_success_is_what_the_simulator_says_of_its_frames() -> None:
    world, _ = build_engine("tokens_small", SPEC)
    assert isinstance(world, TokensSimulator) and world.says_done
    judge = judge_of(world.feature_shape)
    judge.attach(world)
    clips = clip(SPEC, 2, world.memory_frames)
    with torch.no_grad():
        frames, features = world.eval().predict(build_inputs(SPEC, clips, 0))
        said = world.done_head()(features)
    found = judge.score(frames, frames[:, 0], ["push", "pull"], features[:, None])
    assert torch.allclose(found.success, said) and said.shape == (2, SPEC.chunk)
    with torch.no_grad():
        world.video.done_head[-1].bias.add_(3.0)
    judge.attach(world)  # as after the simulator has learned more
    assert bool((judge.score(frames, frames[:, 0], ["push", "pull"], features[:, None]).success > said).all())
    assert judge.facts()["success_by"] == "done of the simulator"


def test_a_simulator_that_says_nothing_is_refused_before_anything_runs() -> None:
    with pytest.raises(ConfigError, match=r"UNetSimulator says nothing; choose simulator=tokens"):
        load_config(["experiment=smoke", "judge=golden_goal_action"])
    load_config(["experiment=smoke", "judge=golden_goal_action", "simulator=tokens_small"])
    other, _ = build_engine("unet_small", SPEC)
    with pytest.raises(ValueError, match="does not say whether a task is done"):
        other.done_head()
    with pytest.raises(ConfigError, match="are not those of simulator=tokens"):
        judge_of((SPEC.chunk + SPEC.views + 1,))
