"""The examples are under a hundred lines each and do what they say."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type

from envs.episodes import LeRobotDataset
from envs.physics.suite import build_suite
from envs.simulators.state_experts.head import StateHead
from envs.specs import CHUNK, LOG_PROB, Status
from envs.targets import ConfigError, build
from examples import recordings
from pipeline.config import load_config
from tests.embodiments import EMBODIMENTS, observations, world_spec
from tests.envs.simulators.clips import clip, first_of, future_of

FOLDER = Path(__file__).resolve().parents[2] / "examples"
EXAMPLES = sorted(FOLDER.glob("*.py"))
CHOICES = [f"{path.parent.name}={path.stem}" for path in sorted((FOLDER / "configs").glob("*/*.yaml"))]


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_examples_are_short(path: Path) -> None:
    assert len(path.read_text().splitlines()) < 100


@pytest.mark.parametrize("choice", CHOICES)
def test_examples_are_choices_like_any_other(choice: str) -> None:
    """Names, values and class are checked as those of configs/ are."""
    group, name = choice.split("=")
    cfg = load_config(["experiment=smoke", f"hydra.searchpath=[file://{FOLDER / 'configs'}]", choice])
    section = cfg[group].get("suite", cfg[group])
    assert section["_target_"].startswith("examples."), name


def test_the_words_decide_in_the_example_suite() -> None:
    suite = build_suite({"_target_": "examples.task_suite.DotToSquare"})
    won = 0
    for seed in range(10):
        suite.reset("reach", seed)
        expert = suite.expert(0.0, np.random.default_rng(seed))
        for _ in range(15):
            suite.step(expert())
        won += suite.observe().success
        assert suite.names[0] in suite.observe().instruction  # type: ignore[attr-defined]
    assert won == 10


@pytest.mark.parametrize("name", sorted(EMBODIMENTS))
def test_the_example_simulator_learns(name: str) -> None:
    spec = world_spec(EMBODIMENTS[name])
    section = {"_target_": "examples.simulator.ShiftingWorld", "memory_frames": 1}
    simulator = build(section, "simulator", spec=spec)
    clips = clip(spec, 4, 1)
    optimiser = torch.optim.Adam(simulator.parameters(), lr=3e-3)
    losses = []
    for _ in range(60):
        loss, _ = simulator.loss(clips, torch.Generator())
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.95 * losses[0], losses[::10]
    decoder = StateHead(simulator, 2, 16)
    state = simulator.reset(first_of(spec, clips), torch.arange(4))
    _, features, state = simulator.step(state, future_of(spec, clips))
    assert decoder.follow(state, spec.chunk, features).shape == (4, spec.chunk, spec.state_dim)


@pytest.mark.parametrize("name", sorted(EMBODIMENTS))
def test_the_example_policy_acts_and_reinforce_teaches_it(name: str) -> None:
    spec = world_spec(EMBODIMENTS[name])
    policy = build({"_target_": "examples.policy.CoarsePolicy", "width": 16, "std": 0.3}, "policy", spec=spec)
    algorithm = build(
        {"_target_": "examples.algorithm.Reinforce", "entropy": 0.01}, "algorithm", policy=policy, spec=spec
    )
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        data = policy(observations(spec, 8))
    assert data[CHUNK].shape == (8, spec.chunk, spec.action_dim) and data[LOG_PROB].shape == (8,)
    batch = data.select(*algorithm.policy.in_keys, CHUNK, LOG_PROB)
    batch["advantage"] = torch.linspace(-1, 1, 8)[:, None]
    before = policy.get_dist(data.copy()).log_prob(data[CHUNK]).detach()
    optimiser = torch.optim.Adam(algorithm.groups(1e-2))
    for _ in range(5):
        loss, _ = algorithm.loss(batch.copy())
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    change = policy.get_dist(data.copy()).log_prob(data[CHUNK]).detach() - before
    assert change[-1] > change[0]


def test_the_example_judge_knows_its_goal(tmp_path: Path) -> None:
    spec = world_spec(EMBODIMENTS["one_arm_deltas"])
    cv2.imwrite(str(tmp_path / "goal.png"), np.full((40, 40, 3), 200, np.uint8))
    section = {"_target_": "examples.judge.GoalPicture", "hold": 1, "sharpness": 30.0}
    judge = build({**section, "picture": str(tmp_path / "goal.png")}, "judge", spec=spec)
    shape = (spec.views, 3, *spec.size)
    first = torch.zeros(1, *shape, dtype=torch.uint8)
    frames = torch.stack([torch.full(shape, value, dtype=torch.uint8) for value in (0, 100, 200)])[None]
    judged = judge.score(frames, first, ["make it light"])
    assert judged.success[0].gt(0.5).tolist() == [False, False, True]
    assert judged.progress[0].diff().gt(0).all() and int(judged.status) == Status.OK.value
    with pytest.raises(ConfigError, match=r"nothing\.png"):
        build({**section, "picture": str(tmp_path / "nothing.png")}, "judge", spec=spec)


def test_the_example_recordings_are_a_data_set(tmp_path: Path) -> None:
    recordings.write(tmp_path / "data")
    found = LeRobotDataset(tmp_path / "data")
    assert len(found) == sum(recordings.SPLITS.values())
    by_source = {episode.source: [] for episode in found}
    for episode in found:
        by_source[episode.source].append(bool(episode.success.any()))
    assert all(by_source["expert"]) and not all(by_source["noisy"])
