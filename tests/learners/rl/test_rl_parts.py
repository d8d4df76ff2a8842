"""What algorithms share: masks of rollouts, and alarms."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict

from envs.specs import INVALID_ACTION, JUDGE_STATUS, LOST, SUCCESS, Status
from envs.targets import ConfigError, options
from learners.rl.alarms import Alarms
from learners.rl.algorithm import RLConfig, clip_bounds, finite, first_episode, judged, sound, whole
from learners.rl.update import outcome
from learners.training.fit import TrainingDiverged
from tests.embodiments import ARM_DELTAS, world_spec
from tests.learners.rl.test_algorithms import RL

DONE = torch.tensor([[False, True, False, True], [False, False, False, True]])


def test_an_episode_that_a_judge_a_nan_or_a_crash_spoiled_is_left_out_whole() -> None:
    assert first_episode(DONE).tolist() == [[True, True, False, False], [True] * 4]
    status = torch.full((2, 4, 1), Status.OK.value)
    status[0, 3] = Status.ERROR.value
    invalid = torch.zeros(2, 4, 1, dtype=torch.bool)
    invalid[1, 2] = True
    after = TensorDict({JUDGE_STATUS: status, "done": DONE.unsqueeze(-1)}, [2, 4])
    batch = TensorDict({"next": after, INVALID_ACTION: invalid}, [2, 4])
    assert judged(batch).tolist() == [[True, True, False, False], [True] * 4]
    assert finite(batch).tolist() == [[True] * 4, [False] * 4]
    assert sound(batch).tolist() == [[True, True, False, False], [False] * 4]
    lost = torch.zeros(2, 4, 1, dtype=torch.bool)
    lost[0, 1] = True
    batch["next", LOST] = lost
    assert whole(batch).tolist() == [[False, False, True, True], [True] * 4] and not sound(batch).any()
    batch["next"].update({"reward": torch.ones(2, 4, 1), SUCCESS: torch.ones(2, 4, 1, dtype=torch.bool)})
    told = outcome(batch)
    assert (told["dropped_by_physics"], told["dropped_nan"], told["dropped_by_judge"]) == (1.0, 1.0, 0.0)


def test_a_chunk_of_many_numbers_is_clipped_as_often_as_one_of_few_if_each_moves_as_far() -> None:
    """A step by 6% of the exploration of every number of independent normal distributions."""
    outside = []
    for actions in (1, 4, 16):
        spec = replace(world_spec(ARM_DELTAS), chunk=actions)
        numbers = actions * ARM_DELTAS.action_dim
        low, high = clip_bounds(0.2, 0.28, 8, spec)
        noise = torch.randn(4000, numbers, generator=torch.Generator().manual_seed(actions))
        ratio = (0.06 * noise - 0.06**2 / 2).sum(1).exp()
        outside.append(float(((ratio < 1 - low) | (ratio > 1 + high)).float().mean()))
        assert 0 < low < 1
    assert max(outside) - min(outside) < 0.06 and min(outside) > 0.1
    assert clip_bounds(0.2, 0.28, None, spec) == (0.2, 0.28)
    assert clip_bounds(0.2, 0.28, numbers, spec) == pytest.approx((0.2, 0.28))


def test_alarms() -> None:
    alarms = Alarms(patience=2)
    for iteration in range(2):
        alarms.check({"reward_std": 0.0, "kl": 0.0, "entropy": 1.0}, iteration)
    alarms.check({"reward_std": 1.0, "kl": 3.0, "entropy": -50.0}, 3)
    assert [text.split(" at ")[0] for text in alarms.raised] == [
        "no reward variance",
        "exploding KL",
        "collapsed entropy",
    ]
    for iteration in range(2):
        said = {"updates": 1.0, "planned_updates": 16.0, "kl_reached": 0.3, "reward_std": 1.0}
        alarms.check(said, iteration)
    assert "hardly any step at iteration 1: 1 of 16 updates" in alarms.raised[-1]
    with pytest.raises(TrainingDiverged, match="kl"):
        alarms.check({"reward_std": 1.0, "kl": float("nan")}, 4)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"schedule": "now"}, r"rl\.schedule='now' should be 'sync' or 'async'"),
        ({"shards": 3}, "must be a multiple of shards=3"),
        ({"epoch": 3}, r"rl\.epoch is not an option of RLConfig; did you mean epochs"),
    ],
)
def test_options_that_cannot_work_are_named(changes: dict[str, object], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        options(RLConfig, {**RL, **changes}, "rl")
