"""The true world: same seed same episode, the expert succeeds, specs hold, cameras see what they should."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torchrl.envs.utils import check_env_specs

from envs.geometry.cameras import project
from envs.physics.env import PhysicsEnv
from envs.physics.pool import BenchPool
from envs.physics.tabletop.bench import Bench, BenchConfig
from envs.physics.tabletop.experts import Behaviour
from envs.specs import CHUNK, COMMAND, EPISODE, IMAGE, STATE, SUCCESS


def test_same_seed_same_episode_whatever_the_workers() -> None:
    jobs = [(seed, 0.5) for seed in range(4)]
    results = []
    for slots, workers in ((1, 1), (4, 2)):
        pool = BenchPool(BenchConfig(), slots, 12, workers)
        results.append(pool.script(jobs))
        pool.close()
    for one, two in zip(*results, strict=True):
        for name in one.rows:
            assert np.array_equal(np.stack(one.rows[name]), np.stack(two.rows[name]), equal_nan=True), name


@pytest.mark.parametrize("control_hz", [10.0, 5.0])
def test_expert_succeeds_on_unseen_seeds(control_hz: float) -> None:
    pool = BenchPool(BenchConfig(control_hz=control_hz), 2, round(4 * control_hz))
    tracks = pool.script([(500_000 + seed, 0.0) for seed in range(100)])
    pool.close()
    assert sum(bool(track.rows["success"][-1]) for track in tracks) >= 95


def test_success_must_be_held() -> None:
    bench = Bench(BenchConfig())
    bench.reset(1)
    bench.data.qpos[bench._block : bench._block + 2] = bench.layout.target
    for step in range(bench.hold):
        assert bench.success is False, step
        bench.step(bench.command)
    assert bench.success is True


def test_episodes_end_with_the_chunk_in_which_they_succeed() -> None:
    pool = BenchPool(BenchConfig(control_hz=5.0), 1, 20, 1)
    tracks = pool.script([(seed, 0.0) for seed in range(8)], 4)
    pool.close()
    early = [track for track in tracks if track.rows["success"].index(True) % 4]
    assert early and all(len(track.rows["success"]) % 4 == 1 for track in tracks)
    for track in early:
        won = track.rows["success"]
        assert won[-1] and won == sorted(won)


def test_a_chunk_is_carried_out_to_its_end() -> None:
    pool = BenchPool(BenchConfig(control_hz=5.0), 1, 20, 1)
    command = pool.reset({0: 1}, record=True)[0]["command"]
    bench = pool._inline.slots[0].bench
    bench.data.qpos[bench._block : bench._block + 2] = bench.layout.target
    after = pool.step({0: np.stack([command] * 4)})[0]
    assert after["over"] and after["track"].rows["success"] == [False, False, True, True, True]
    assert "track" not in pool.step({0: np.stack([command] * 4)})[0]  # over: it stands still
    pool.close()


def test_dial_is_checked() -> None:
    bench = Bench(BenchConfig())
    bench.reset(0)
    with pytest.raises(ValueError, match="noise_level"):
        Behaviour(bench.task, bench.layout, 1.5, np.random.default_rng(0))


def test_arms_reach_their_commands() -> None:
    bench = Bench(BenchConfig())
    bench.reset(3)
    command = bench.command.copy()
    command[0] += 0.05
    command[7] += 0.05
    for _ in range(6):
        bench.step(command)
    assert np.abs(bench.achieved() - command)[[0, 1, 2, 7, 8, 9]].max() < 0.008


@pytest.mark.parametrize("arm", [0, 1])
def test_arms_go_as_far_as_they_can_towards_what_lies_too_far_away(arm: int) -> None:
    bench = Bench(BenchConfig(control_hz=5.0))
    bench.reset(3)
    place = slice(7 * arm, 7 * arm + 3)
    for lateral in np.linspace(0.0, 0.3, 4) * (1 if arm else -1):  # across the middle, at the far edge
        for _ in range(8):
            command = bench.command.copy()
            command[7 * (1 - arm)], command[7 * (1 - arm) + 1] = 0.0, 0.36 * (1 if arm else -1)
            command[place] = 0.46, lateral, command[place][2]
            bench.step(command)
        assert np.abs(bench.achieved()[place] - bench.command[place]).max() < 0.004, lateral
        assert bench.command[place][2] == command[place][2] and bench.command[place][0] > 0.25


def test_block_is_seen_where_it_is() -> None:
    bench = Bench(BenchConfig(size=(128, 128)))
    bench.reset(5)
    red = bench.layout.block_rgb
    picture = bench.render(("head",))[0].astype(float) / 255
    intrinsic, c2w = (torch.from_numpy(a).float() for a in bench.cameras())
    at, _ = project(torch.from_numpy(bench.block[:3]).float()[None], intrinsic[0], c2w[0])
    u, v = at[0].round().long().tolist()
    seen = picture[:, v - 1 : v + 2, u - 1 : u + 2].mean((1, 2))
    assert np.argmax(seen) == np.argmax(red)


def test_env_specs_and_early_success() -> None:
    env = PhysicsEnv(BenchConfig(), batch=2, chunk=4, horizon=8, workers=1)
    check_env_specs(env)
    env.schedule([11, 12])
    td = env.reset()
    assert td[EPISODE].flatten().tolist() == [11, 12]
    assert td[IMAGE].dtype == torch.uint8
    still = td.clone()
    still[CHUNK] = torch.zeros(2, 4, 14)
    after = env.step(still)["next"]
    assert torch.allclose(after[COMMAND], td[COMMAND], atol=1e-5)
    assert not bool(after["done"].any())
    after = env.step(still)["next"]
    assert bool(after["truncated"].all()) and not bool(after[SUCCESS].any())
    env.close()


def test_nan_actions_are_refused() -> None:
    env = PhysicsEnv(BenchConfig(), batch=1, chunk=4, horizon=8, workers=1)
    td = env.reset()
    td[CHUNK] = torch.full((1, 4, 14), float("nan"))
    with pytest.raises(ValueError, match="NaN"):
        env.step(td)
    env.close()


def test_unknown_views_and_tasks_are_named() -> None:
    with pytest.raises(ValueError, match=r"task\.views"):
        BenchConfig(views=("head", "belly"))
    with pytest.raises(ValueError, match=r"task\.name"):
        BenchConfig(task="juggle")
    with pytest.raises(ValueError, match="multiple"):
        PhysicsEnv(BenchConfig(), batch=1, chunk=4, horizon=10, workers=1)


def test_state_layout_is_left_then_right() -> None:
    env = PhysicsEnv(BenchConfig(), batch=1, chunk=4, horizon=8, workers=1)
    td = env.reset()
    assert td[STATE].shape == (1, 16)
    moved = td.clone()
    chunk = torch.zeros(1, 4, 14)
    chunk[..., 13] = -1.0  # open the right gripper
    moved[CHUNK] = chunk
    after = env.step(moved)["next"]
    assert float(after[STATE][0, 15]) < 0.3 and float(after[STATE][0, 7]) > 0.7
    env.close()
