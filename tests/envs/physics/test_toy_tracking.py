"""TorchRL's toy tracking task as one of our worlds."""

from __future__ import annotations

import pytest
import torch
from torchrl.envs.utils import check_env_specs

from envs.physics.toy_tracking import ToyTrackingEnv
from envs.specs import CHUNK, STATE, SUCCESS


def test_specs_and_targets_of_seeds() -> None:
    env = ToyTrackingEnv(6, starts=4)
    check_env_specs(env)
    env.schedule([1, 5, 2, 9, 3, 0])  # 1, 5 and 9 are the same start
    state = env.reset()[STATE]
    assert (
        torch.equal(state[0], state[1])
        and torch.equal(state[0], state[3])
        and not torch.equal(state[0], state[2])
    )
    assert not torch.equal(ToyTrackingEnv(1, targets=1).targets, ToyTrackingEnv(1).targets)


def test_an_oracle_wins_a_coward_does_not() -> None:
    env = ToyTrackingEnv(4)
    env.schedule(range(4))
    now = env.reset()
    now[CHUNK] = now[STATE][:, None, 2:].expand(-1, 4, -1).clone()
    now[CHUNK][2:] = -1.0
    after = env.step(now)["next"]
    assert (
        after[SUCCESS].squeeze(-1).tolist()
        == [True, True, False, False]
        == after["reward"].squeeze(-1).bool().tolist()
    )
    for _ in range(4):
        after[CHUNK] = torch.full((4, 4, 2), -1.0)
        after = env.step(after)["next"]
    assert not bool(after["truncated"][2:].any())
    after[CHUNK] = torch.full((4, 4, 2), -1.0)
    assert bool(env.step(after)["next", "truncated"][2:].all())


def test_words_of_a_suite_that_are_cut_are_told_once(caplog: pytest.LogCaptureFixture) -> None:
    env = ToyTrackingEnv(2)
    for name in ("first", "second", "first"):
        env.toy.instruction = f"follow the {name} of all the targets " + "that move about " * 20
        env.reset()
    said = [entry.getMessage() for entry in caplog.records if "256 bytes" in entry.getMessage()]
    assert len(said) == 2 and "'follow the first of" in said[0] and "'follow the second of" in said[1]
