"""Workers that die or fail, and suites that cannot be built."""

from __future__ import annotations

import os
import signal
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase

from actors.rollouts.evaluate import evaluate
from envs.physics import process
from envs.physics.env import PhysicsEnv
from envs.physics.pool import PoolError, TaskPool
from envs.physics.suite import build_suite
from envs.physics.worker import Worker, WorkerSpec
from envs.specs import CHUNK, LOST, STATE, ActionMode, Rewards, WorldSpec
from envs.targets import ConfigError
from tests.envs.physics.sections import task_section
from tests.sampling import every
from tests.suites.counting import Counting

pytestmark = pytest.mark.slow

SUITES = "tests.suites.counting"
COUNTING = {"_target_": f"{SUITES}.Counting", "fault": ""}


def pool_of(slots: int, workers: int, **changes: Any) -> TaskPool:
    return TaskPool({**COUNTING, **changes}, "count", slots, 8, workers)


@pytest.mark.parametrize("workers", [1, 2])
def test_several_tasks_are_played_by_turns(workers: int) -> None:
    pool = TaskPool({**COUNTING, "tasks": ["count", "recount"]}, ["recount", "count"], 3, 8, workers)
    said = pool.reset({0: 4, 1: 5, 2: 6}, False)
    assert [said[slot]["instruction"] for slot in range(3)] == ["recount", "count", "recount"]
    tracks = pool.script([(7, 0.0), (8, 0.0)], 1)
    assert [track.instruction for track in tracks] == ["count", "recount"]
    pool.close()
    with pytest.raises(ConfigError, match=r"recount.*unknown"):
        TaskPool(COUNTING, ["count", "recount"], 2, 8, workers)


class Remembering(Counting):
    """Counts, and remembers what it was asked to play."""

    def reset(self, task: str, seed: int) -> None:
        super().reset(task, seed)
        self.played = getattr(self, "played", set()) | {task}


def test_models_of_tasks_are_not_made_for_every_slot() -> None:
    tasks = ("a", "b", "c", "d")
    suite = {"_target_": f"{__name__}.Remembering", "fault": "", "tasks": tasks}
    worker = Worker(WorkerSpec(suite, tasks, 8), 6)
    for begin in range(0, 60, 6):
        said = worker.reset({slot: begin + slot for slot in range(6)}, False)
        assert [said[slot]["instruction"] for slot in range(6)] == [tasks[(begin + n) % 4] for n in range(6)]
        assert [said[slot]["state"][0] for slot in range(6)] == [begin + slot for slot in range(6)]
    assert sum(len(slot.suite.played) for slot in worker.slots) <= 8  # of 24
    before = {slot: worker.slots[slot].suite for slot in (0, 1, 3, 4)}
    worker.reset({2: 7, 5: 8}, False)  # the others are in mid-episode
    assert all(worker.slots[slot].suite is suite for slot, suite in before.items())
    assert len({id(slot.suite) for slot in worker.slots}) == 6


def test_a_killed_worker_is_replaced_and_its_episodes_go_on() -> None:
    task = task_section("push")
    chunks, ends = {}, []
    for kill in (False, True):
        pool = TaskPool(task["suite"], task["name"], 2, 8, 2)
        first = pool.reset({0: 1, 1: 2}, True)
        chunks = {slot: np.stack([row["command"] + 0.02] * 4) for slot, row in first.items()}
        pool.step(chunks)
        if kill:
            os.kill(pool.processes()[1], signal.SIGKILL)
        ends.append(pool.step(chunks))
        pool.close()
    whole, mended = ends
    for slot in (0, 1):
        one, two = whole[slot].pop("track"), mended[slot].pop("track")
        assert len(one) == len(two) == 9
        assert all(np.array_equal(rows, two.stack()[name]) for name, rows in one.stack().items())
        assert all(np.array_equal(value, mended[slot][name]) for name, value in whole[slot].items())


def test_scripts_of_a_killed_worker_run_again() -> None:
    pool = pool_of(2, 2)
    os.kill(pool.processes()[0], signal.SIGKILL)
    tracks = pool.script([(seed, 0.0) for seed in range(6)], 1)
    pool.close()
    assert [track.seed for track in tracks] == list(range(6))
    assert [track.privileged["count"][-1] for track in tracks] == [seed + 8.0 for seed in range(6)]


def test_a_worker_that_keeps_dying_is_reported() -> None:
    with pytest.raises(PoolError, match=r"4 times in a row physics worker 0 died \(exit code 3\)"):
        pool_of(2, 2, at_start="exit")


def test_an_episode_in_which_physics_keeps_crashing_is_dropped_and_counted() -> None:
    pool = pool_of(2, 2, fault="exit")
    assert [track.seed for track in pool.script([(7, 1.0), (8, 0.0)], 1)] == [8] and pool.lost == [7]
    with pytest.raises(PoolError, match=r"in 2 of 3 episodes \(seeds \[7, 9\]\), more than a share of"):
        pool.script([(9, 1.0)], 1)
    pool.close()


def test_only_the_slot_in_which_physics_keeps_crashing_is_lost() -> None:
    pool = TaskPool({**COUNTING, "fault": "exit"}, "count", 4, 8, 2)
    spec = WorldSpec(build_suite({**COUNTING}).embodiment, (4, 4), 2)
    env = PhysicsEnv(pool, spec, ActionMode.ABSOLUTE, Rewards(1.0, 1.0), record=True)
    env.schedule([0, 10, 20, 30, 40])
    now = env.reset()
    crash = torch.tensor([0.0, 2.0, 0.0, 0.0])[:, None, None].expand(4, 2, 1)
    for chunk, counted in ((crash * 0, [2, 12, 22, 32]), (crash, [4, 12, 24, 34])):
        now[CHUNK] = chunk
        now = env.step(now)["next"]
        assert now[STATE].flatten().tolist() == counted
    now[CHUNK] = crash
    after, now = env.step_and_maybe_reset(now)
    assert after["next", STATE].flatten().tolist() == [6, 12, 26, 36]  # it stands where it was lost
    assert after["next", LOST].flatten().tolist() == [False, True, False, False]
    assert torch.equal(after["next", LOST], after["next", "done"])
    now[CHUNK] = crash * 0
    after = env.step(now)["next"]
    assert after[STATE].flatten().tolist() == [8, 42, 28, 38] and not after[LOST].any()
    assert pool.lost == [10] and [track.seed for track in env.pop_tracks()] == [0, 20, 30]
    env.close()


@pytest.mark.long
def test_evaluations_do_not_count_where_physics_crashes() -> None:
    pool = TaskPool({**COUNTING, "fault": "exit"}, "count", 2, 4, 2)
    spec = WorldSpec(build_suite({**COUNTING}).embodiment, (4, 4), 2)
    env = PhysicsEnv(pool, spec, ActionMode.ABSOLUTE, Rewards(1.0, 1.0))

    class Reckless(TensorDictModuleBase):
        in_keys, out_keys = [STATE], [CHUNK]

        def forward(self, seen: TensorDict) -> TensorDict:
            odd = seen[STATE] == 13.0
            return seen.set(CHUNK, torch.where(odd, 2.0, 0.0).unsqueeze(1).expand(-1, 2, 1))

    outcome = evaluate(env, Reckless(), [1, 11, 21, 31])
    assert outcome.counted.tolist() == [True, False, True, True]
    env.close()


@pytest.mark.parametrize(("workers", "fault"), every(3, product((1, 2), ("raise", "exit"))))
def test_an_error_of_the_suite_counts_like_a_crash_and_is_told(
    fault: str, workers: int, caplog: pytest.LogCaptureFixture
) -> None:
    pool, still, odd = pool_of(2, workers, fault=fault), np.zeros((2, 1)), np.full((2, 1), 2.0)
    pool.reset({0: 10, 1: 20}, False)
    pool.step({0: still, 1: still})
    assert [seen["state"].tolist() for seen in pool.step({0: odd, 1: still}).values()] == [[24.0]]
    assert pool.lost == [10]
    why = "RuntimeError: the bench is on fire" if fault == "raise" else "exit code 3"
    assert caplog.text.count(why) == 1 and "seed 10; it is dropped" in caplog.text
    with pytest.raises(PoolError, match=f"(?s)in 2 of 3 episodes.*{why}"):
        pool.script([(30, 1.0)], 1)
    pool.close()


@pytest.mark.long
def test_a_worker_that_hangs_counts_like_one_that_died(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    suite = {"_target_": f"{SUITES}.Hanging", "once": str(tmp_path / "once")}
    pool = TaskPool(suite, "count", 2, 8, 2)
    monkeypatch.setattr(process, "PATIENCE", 8.0)
    tracks = pool.script([(seed, float(seed == 2)) for seed in range(4)], 1)
    assert [track.privileged["count"][-1] for track in tracks] == [8.0, 9.0, 10.0, 11.0]
    assert (tmp_path / "once").exists() and "no sign of life for 8 s" in caplog.text and not pool.lost
    pool.close()


@pytest.mark.long
def test_a_worker_that_is_slow_does_not_hang(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    pool = TaskPool({"_target_": f"{SUITES}.Slow", "fault": ""}, "count", 2, 8, 2)
    monkeypatch.setattr(process, "PATIENCE", 8.0)  # less than an episode takes
    tracks = pool.script([(seed, 0.0) for seed in range(2)], 1)
    assert [len(track) for track in tracks] == [9, 9] and not caplog.text
    chunks = {slot: np.zeros((8, 1)) for slot in range(2)}
    pool.reset({0: 5, 1: 6}, False)
    assert [float(seen["state"][0]) for seen in pool.step(chunks).values()] == [13, 14]
    pool.close()


@pytest.mark.long
def test_what_others_said_when_one_failed_is_no_answer_to_the_next_request() -> None:
    pool, still, odd = pool_of(4, 2, fault="raise"), np.zeros((2, 1)), np.full((2, 1), 2.0)
    pool.reset({slot: 10 * slot for slot in range(4)}, False)
    with pytest.raises(PoolError, match="on fire"):
        pool.step({0: odd, 1: still, 2: odd, 3: still})  # too many are lost before worker 1 is heard
    again = pool.reset({slot: 10 * slot + 5 for slot in range(4)}, False)
    assert {slot: float(seen["state"][0]) for slot, seen in again.items()} == {0: 5, 1: 15, 2: 25, 3: 35}
    after = pool.step(dict.fromkeys(range(4), still))
    assert {slot: float(seen["state"][0]) for slot, seen in after.items()} == {0: 7, 1: 17, 2: 27, 3: 37}
    with pytest.raises(PoolError, match="on fire"):
        pool.script([(100, 1.0), *((seed, 0.0) for seed in range(8))], 1)
    assert [track.seed for track in pool.script([(seed, 0.0) for seed in range(50, 54)], 1)] == [
        50,
        51,
        52,
        53,
    ]
    pool.close()


def test_a_suite_that_cannot_be_made_is_told_at_once() -> None:
    with pytest.raises(ConfigError, match=r"task\.suite \(tests\..*\.Counting\): .*on fire"):
        pool_of(2, 2, at_start="raise")


@pytest.mark.parametrize("workers", [1, 2])
def test_what_cannot_be_built_is_a_config_error(workers: int) -> None:
    with pytest.raises(ConfigError, match=r"task\.name='cuont' is unknown; the nearest .*'count'"):
        TaskPool(COUNTING, "cuont", 2, 8, workers)
    with pytest.raises(ConfigError, match=r"task\.suite\._target_=no_such_package\.Suite does not import"):
        TaskPool({"_target_": "no_such_package.Suite"}, "count", 2, 8, workers)


def test_a_task_without_an_expert_is_told_at_once_and_its_random_actions_play() -> None:
    suite = {"_target_": "tests.suites.counting.Scriptless", "fault": ""}
    pool = TaskPool(suite, "count", 2, 8, 2)
    mine = pool.processes()
    said = r"Scriptless\.expert has no behaviour of noise level 0\.5 for task 'count' .*nobody has written it"
    with pytest.raises(ConfigError, match=rf"task\.suite: {said}.*collect\.mix="):
        pool.script([(0, 1.0), (1, 0.5)], 1)
    assert not pool.lost and pool.processes()[1:] == mine[1:]
    (track,) = pool.script([(2, 1.0)], 1)
    pool.close()
    assert len(track) == 9
    pool = TaskPool(suite, "count", 1, 0, 1)  # no step, so nobody is asked
    (track,) = pool.script([(2, 0.0)], 1)
    pool.close()
    assert len(track) == 1


def test_other_classes_are_no_suites() -> None:
    with pytest.raises(ConfigError, match="TaskSuite"):
        build_suite({"_target_": "fractions.Fraction", "numerator": 1})
