"""PhysicsEnv: success and horizon end episodes, chunks run to their end, contradictions are refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from envs.physics.env import PhysicsEnv
from envs.physics.pool import TaskPool
from envs.physics.suite import build_suite
from envs.specs import CHUNK, COMMAND, INSTRUCTION_UTF8, PROGRESS, SUCCESS, Rewards, WorldSpec, bytes_to_text
from tests.envs.physics.sections import task_section

PUSH = task_section("push", control_hz=5.0)
SPEC = WorldSpec(build_suite(PUSH["suite"]).embodiment, (24, 32), 4)


def env_of(batch: int, horizon: int, mode: str = "relative", suite: str = "", **changes: Any) -> PhysicsEnv:
    section = {**PUSH["suite"], "_target_": suite or PUSH["suite"]["_target_"]}
    pool = TaskPool(section, PUSH["name"], batch, horizon, 1)
    return PhysicsEnv(pool, mode=mode, rewards=Rewards(1.0, 1.0), **{"spec": SPEC, **changes})


def test_success_ends_an_episode_with_a_bonus_once() -> None:
    env = env_of(1, 8, suite="tests.envs.physics.sections.Solved", record=True)
    now = env.reset()
    assert bytes_to_text(now[INSTRUCTION_UTF8]) == env.instructions
    now[CHUNK] = torch.zeros(1, 4, SPEC.action_dim)
    after = env.step(now)["next"]
    assert bool(after[SUCCESS]) and bool(after["terminated"]) and not bool(after["truncated"])
    assert float(after["reward"]) == pytest.approx(float(after[PROGRESS] - now[PROGRESS]) + 1.0, abs=1e-6)
    assert torch.allclose(after[COMMAND], now[COMMAND], atol=1e-6)
    (track,) = env.pop_tracks()
    assert track.rows["success"] == [False, False, True, True, True] and not env.pop_tracks()
    after[CHUNK] = now[CHUNK]
    beyond = env.step(after)["next"]
    assert float(beyond["reward"]) == 0.0 and bool(beyond["done"])
    env.close()


def test_the_horizon_truncates() -> None:
    env = env_of(1, 8)
    now = env.reset()
    for done in (False, True):
        now[CHUNK] = torch.zeros(1, 4, SPEC.action_dim)
        now = env.step(now)["next"]
        assert bool(now["truncated"]) is done and not bool(now["terminated"])
    env.close()


def test_scripted_episodes_end_with_the_chunk_in_which_they_succeed() -> None:
    pool = TaskPool(PUSH["suite"], PUSH["name"], 1, 20, 1)
    tracks = pool.script([(seed, 0.0) for seed in range(6)], 4)
    early = [track for track in tracks if track.rows["success"].index(True) % 4]
    assert early and all(len(track) % 4 == 1 for track in tracks)
    for track in early:
        won = track.rows["success"]
        assert won[-1] and won == sorted(won)


def test_contradictions_are_refused() -> None:
    with pytest.raises(ValueError, match=r"task\.horizon=10 must be a multiple of task\.chunk=4"):
        env_of(1, 10)
    arm = build_suite(task_section("metaworld")["suite"]).embodiment
    with pytest.raises(ValueError, match=r"task\.mode=relative needs absolute actions"):
        env_of(1, 8, spec=WorldSpec(arm, (24, 32), 4))
    other = env_of(1, 8, spec=WorldSpec(SPEC.embodiment, (16, 16), 4))
    with pytest.raises(ValueError, match=r"image .*task\.size equal to task\.suite\.size"):
        other.reset()
    other.close()


def test_nan_actions_are_refused() -> None:
    env = env_of(1, 8)
    now = env.reset()
    now[CHUNK] = torch.full((1, 4, SPEC.action_dim), float("nan"))
    with pytest.raises(ValueError, match="NaN"):
        env.step(now)
    env.close()


def test_pictures_for_people_have_any_size() -> None:
    pool = TaskPool(PUSH["suite"], PUSH["name"], 1, 8, 1)
    assert pool.picture(3, (40, 60)).shape == (3, 3, 40, 60)
    assert np.std(pool.picture(3, (40, 60))) > 10


def test_of_an_episode_that_is_played_again_the_first_slot_comes_first() -> None:
    env = env_of(3, 4, record=True)
    env.schedule([5, 5, 5])
    now = env.reset()
    now[CHUNK] = torch.zeros(3, 4, SPEC.action_dim)
    now[CHUNK][:, :, 0] = 0.01 * torch.arange(3)[:, None]
    env.step(now)
    ends = [float(np.asarray(track.rows["commands"][-1])[0]) for track in env.pop_tracks()]
    assert ends == sorted(ends) and ends[0] < ends[1]
    env.close()
