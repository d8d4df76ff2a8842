"""Imagined episodes that begin inside recorded ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torchrl.envs import TransformedEnv

from envs.embodiment import Embodiment
from envs.episodes import LeRobotWriter
from envs.episodes.clip_spec import ClipSpec
from envs.episodes.clips import ClipStore
from envs.initial_states import DecisionPoints, InitialStates, decision_points, shared_out
from envs.simulators import memory
from envs.specs import CHUNK, IMAGE, STATE, ActionMode, Rewards, memory_indices
from envs.transforms import world_transforms
from envs.world import WorldEnv
from tests.embodiments import ARM_DELTAS, BIMANUAL_POSES, world_spec
from tests.envs.simulators.test_engines import build_engine
from tests.envs.test_world import Fixed
from tests.moving_square import SIZE, moving_square

Stores = Callable[[Embodiment], ClipStore]
ROBOTS = pytest.mark.parametrize("robot", [BIMANUAL_POSES, ARM_DELTAS], ids=lambda robot: robot.robot)


def inside(store: ClipStore, batch: int, judge: Fixed, horizon: int) -> TransformedEnv:
    """A world whose episodes begin anywhere inside those of a store."""
    simulator, decoder = build_engine("unet_small", store.spec)
    mode = ActionMode.ABSOLUTE if store.spec.embodiment.delta else ActionMode.RELATIVE
    starts = DecisionPoints(store, torch.arange(len(store)))
    base = WorldEnv(simulator, starts, batch, horizon, mode, shared_noise=False, bf16=False)
    return TransformedEnv(base, world_transforms(store.spec, decoder, judge, Rewards(1.0, 1.0)))


@pytest.fixture
def dark(tmp_path: Path) -> ClipStore:
    """Episodes whose every third picture is missing."""
    robot, episodes = ARM_DELTAS.at(SIZE), []
    for seed in range(3):
        episode = moving_square(ARM_DELTAS, seed)
        present = np.arange(len(episode.frames)) % 3 != 2
        frames = episode.frames * present[:, None, None, None, None]
        episodes.append(replace(episode, present=present, frames=frames.astype(np.uint8)))
    LeRobotWriter(tmp_path / "dark", robot).write(episodes)
    return ClipStore([tmp_path / "dark"], world_spec(robot, SIZE))


@ROBOTS
def test_every_chunk_that_was_begun_is_a_start(tiny_store: Stores, robot: Embodiment) -> None:
    store = tiny_store(robot)
    episodes = torch.tensor([3, 1])
    owner, frame = decision_points(store, episodes)
    for number in episodes.tolist():
        last = int(store.length[number]) - 1
        assert frame[owner == number].tolist() == list(range(0, last, store.spec.chunk))
    assert owner.unique_consecutive().tolist() == [3, 1]


def test_nothing_begins_where_there_is_no_picture(dark: ClipStore) -> None:
    seen, chunk = dark.arrays["present"], dark.spec.chunk
    owner, frame = decision_points(dark, torch.arange(len(dark)))
    assert bool(seen[dark.start[owner] + frame].all())
    assert len(frame) < sum((int(n) - 2) // chunk + 1 for n in dark.length)
    clips = dark.sample(torch.arange(len(dark)), 64, ClipSpec(2, chunk), torch.Generator().manual_seed(0))
    assert bool(clips["memory", "present"][:, 0, -1].all())


def test_no_episode_is_an_error_that_names_the_key(store: ClipStore) -> None:
    with pytest.raises(ValueError, match=r"rl\.starts=first"):
        decision_points(store, torch.zeros(0, dtype=torch.int64))


@ROBOTS
def test_first_frames_of_further_episodes_are_starts(tiny_store: Stores, robot: Embodiment) -> None:
    store = tiny_store(robot)
    inside, further = torch.tensor([3, 1]), torch.tensor([0, 5, 7])
    starts = DecisionPoints(store, inside, further)
    points = len(decision_points(store, inside)[0])
    assert len(starts) == points + 3
    past, length = starts.past(torch.arange(points, points + 3))
    assert length.tolist() == [1, 1, 1]
    assert torch.equal(past["frames"][:, 0], store.first(further)["frames"])
    assert starts.instructions[points:] == [store.instructions[n] for n in further.tolist()]


@pytest.mark.parametrize(("inside", "extra"), [(4000, 320), (300, 300), (50, 1000)])
def test_extra_starts_get_about_their_share(inside: int, extra: int) -> None:
    for share in (0.2, 0.5):
        pool = shared_out(range(inside), range(inside, inside + extra), share)
        assert set(pool) == set(range(inside + extra))
        assert sum(number >= inside for number in pool) / len(pool) == pytest.approx(share, abs=0.12)


@pytest.mark.parametrize("newest", [1, 2, 3])
@ROBOTS
def test_sessions_remember_what_clips_show(tiny_store: Stores, robot: Embodiment, newest: int) -> None:
    store = tiny_store(robot)
    starts = DecisionPoints(store, torch.arange(len(store)))
    which = torch.tensor([0, len(starts) - 1, len(starts) // 2])
    past, length = starts.past(which)
    state = memory.new_sessions(past, length, which, starts.longest)
    remembered = memory.recall(state, 3, newest)
    spec = ClipSpec(3, store.spec.chunk, newest=newest)
    clip = store.clips(starts.episode[which], starts.frame[which], spec)
    for name in remembered.keys():
        assert torch.equal(remembered[name], clip["memory", name][:, 0]), name
    now = memory.newest(state)
    assert torch.equal(now["commands"], clip["now", "command"])
    assert torch.equal(now["states"], clip["now", "state"])


@ROBOTS
def test_episodes_go_on_from_the_recorded_moment(tiny_store: Stores, robot: Embodiment) -> None:
    store, judge = tiny_store(robot), Fixed(0.1)
    env = inside(store, 2, judge, 2 * store.spec.chunk)
    starts = env.base_env.starts
    middle, fresh = len(starts) // 2 + 1, 0
    env.base_env.schedule([middle, fresh, middle])
    begun = env.reset()
    rows = (store.start[starts.episode] + starts.frame)[[middle, fresh]]
    assert torch.equal(begun[IMAGE], store.frames(rows))
    assert torch.equal(begun[STATE], store.arrays["states"][rows])
    # The judge compares with how the episode truly began, not with where imagination took over.
    opening = store.frames(store.start[starts.episode[[middle, fresh]]])
    assert torch.equal(judge.shown[-1], opening)
    begun[CHUNK] = torch.zeros_like(env.action_spec.zero()[CHUNK])
    first = env.step(begun)["next"]
    assert torch.equal(judge.shown[-1], opening)
    first["_reset"] = torch.tensor([[False], [True]])
    again = env.reset(first.clone())
    assert torch.equal(again[IMAGE][1], store.frames(rows[:1])[0])
    again[CHUNK] = torch.zeros_like(env.action_spec.zero()[CHUNK])
    second = env.step(again)["next"]
    assert second["truncated"].flatten().tolist() == [True, False]
    # The same moment in another slot, at another time, goes on the same way.
    assert (second[IMAGE][1].int() - first[IMAGE][0].int()).abs().max() <= 1


def test_first_frames_are_moments_without_a_past(store: ClipStore) -> None:
    starts = InitialStates.of(store)
    past, length = starts.past(torch.tensor([2, 0]))
    assert length.tolist() == [1, 1] and past.shape == (2, 1) and starts.longest == 1
    assert torch.equal(past["frames"][:, 0], store.frames(store.start[[2, 0]]))


def test_some_of_memory_is_the_newest_and_the_rest_is_spread_over_the_past() -> None:
    lengths = torch.tensor([1, 2, 10])
    assert memory_indices(lengths, 4).tolist() == [[0] * 4, [0, 0, 1, 1], [0, 3, 6, 9]]
    assert memory_indices(lengths, 3, 2).tolist() == [[0] * 3, [0, 0, 1], [0, 8, 9]]
    assert memory_indices(lengths, 4, 2).tolist() == [[0] * 4, [0, 0, 0, 1], [0, 4, 8, 9]]
