"""What every task suite that configs offer must do, whatever its robot and its tasks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torchrl.envs.utils import check_env_specs

from envs.episodes import Episode
from envs.physics.env import PhysicsEnv
from envs.physics.mujoco_suite import MujocoSuite, SimulationDiverged
from envs.physics.pool import TaskPool, Track
from envs.physics.render import PARTS
from envs.physics.suite import Observation, TaskSuite, build_suite
from envs.specs import CHUNK, COMMAND, EPISODE, IMAGE, STATE, Rewards, WorldSpec
from envs.targets import ConfigError
from tests.envs.physics.sections import physical_tasks
from tests.sampling import those

TASKS = physical_tasks()
SEEDS = (11, 12, 13)


# Of each suite one, and of the table top's the one that needs two arms, too.
SAMPLED = (
    "aloha",
    "metaworld",
    "tabletop-carry",
    "tabletop-pick_place",
)


@pytest.fixture(scope="module", params=those(SAMPLED, sorted(TASKS)))
def task(request: pytest.FixtureRequest) -> dict[str, Any]:
    return TASKS[request.param]


@pytest.fixture(scope="module")
def suite(task: dict[str, Any]) -> TaskSuite:
    """The suite; make setup installs the packages of all but ogbench."""
    try:
        return build_suite(task["suite"])
    except ConfigError as error:
        if "needs more packages" not in str(error):
            raise
        pytest.skip(str(error))


def env_of(task: dict[str, Any], suite: TaskSuite, batch: int, horizon: int) -> PhysicsEnv:
    spec = WorldSpec(suite.embodiment, tuple(task["size"]), 2)
    pool = TaskPool(task["suite"], task["name"], batch, horizon, workers=1)
    return PhysicsEnv(pool, spec, task["mode"], Rewards(1.0, 1.0))


def act(suite: TaskSuite, task: str, seed: int, noise_level: float, steps: int) -> list[Observation]:
    suite.reset(task, seed)
    expert = suite.expert(noise_level, np.random.default_rng([seed, 1]))
    seen = [suite.observe()]
    for _ in range(steps):
        if not seen[-1].success:
            suite.step(expert())
            seen.append(suite.observe())
    return seen


def same(one: Observation, two: Observation) -> bool:
    pairs = ((getattr(one, name), getattr(two, name)) for name in vars(one))
    return all((a is None and b is None) or np.array_equal(a, b) for a, b in pairs)


def check_equal(one: Track, two: Track) -> None:
    assert one.instruction == two.instruction
    for rows, others in ((one.rows, two.rows), (one.privileged, two.privileged)):
        assert rows.keys() == others.keys()
        for name in rows:
            assert np.array_equal(np.stack(rows[name]), np.stack(others[name])), name


def test_shapes_are_those_of_the_embodiment(task: dict[str, Any], suite: TaskSuite) -> None:
    robot = suite.embodiment
    assert task["name"] in suite.tasks
    for option in ("cameras", "actions"):
        chosen = task["suite"].get(option, ())
        chosen = {chosen} if isinstance(chosen, str) else set(chosen)
        assert chosen <= set(suite.offers.get(option, chosen))
    suite.reset(task["name"], 1)
    seen, pictures = suite.observe(), suite.render()
    assert pictures.dtype == np.uint8
    assert pictures.shape == (len(robot.cameras), 3, *task["size"])
    assert {camera.size for camera in robot.cameras} == {tuple(task["size"])}
    assert all(picture.std() > 5 for picture in pictures)  # nobody looks at a bare wall
    assert seen.state.shape == (robot.state_dim,) and seen.command.shape == (robot.action_dim,)
    assert np.isfinite(seen.state).all() and seen.instruction and not seen.success
    assert 0.0 <= seen.progress < 1.0
    if robot.delta:
        assert not seen.command.any()
    if robot.calibrated:
        assert seen.intrinsic is not None and seen.intrinsic.shape == (len(robot.cameras), 3, 3)
        assert seen.c2w is not None and seen.c2w.shape == (len(robot.cameras), 4, 4)
    else:
        assert seen.intrinsic is None and seen.c2w is None


def test_each_pixel_is_the_robots_a_things_or_nobodys(task: dict[str, Any], suite: TaskSuite) -> None:
    suite.reset(task["name"], 1)
    pictures, labels = suite.render(), suite.segment()
    assert labels is not None and labels.dtype == np.uint8
    assert labels.shape == (len(suite.embodiment.cameras), *task["size"])
    # What a robot with its things fills is some of the pictures, and not most of them.
    assert {PARTS["background"], PARTS["arm"]} <= set(np.unique(labels)) <= set(PARTS.values())
    assert 0.005 < (labels == PARTS["arm"]).mean() < 0.6
    assert np.array_equal(suite.render(), pictures)  # looking at parts changes nothing


def test_an_episode_depends_on_its_seed_alone(task: dict[str, Any], suite: TaskSuite) -> None:
    first = act(suite, task["name"], 1, 0.5, 4)
    first_picture = suite.render()
    other = act(suite, task["name"], 2, 0.5, 4)
    again = act(suite, task["name"], 1, 0.5, 4)
    assert all(same(one, two) for one, two in zip(first, again, strict=True))
    assert np.array_equal(first_picture, suite.render())
    assert not same(first[-1], other[-1])


def test_the_first_picture_shows_what_is_there(task: dict[str, Any], suite: TaskSuite) -> None:
    pictures = []
    for seed in (1, 2, 1):
        suite.reset(task["name"], seed)
        pictures.append(suite.render())
    assert np.array_equal(pictures[0], pictures[2])  # not where things lay in the episode before
    there = [suite.segment()]
    suite.step(suite.observe().command)
    there.append(suite.segment())
    main = suite.embodiment.main_view
    thing, later = (labels[main] == PARTS["object"] for labels in there if labels is not None)
    if thing.sum() >= 30:  # a few pixels may be hidden, or settle
        assert (thing & later).sum() > 0.7 * (thing | later).sum()


def test_physics_that_diverges_is_an_error(
    task: dict[str, Any], suite: TaskSuite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not isinstance(suite, MujocoSuite):
        pytest.skip("not on MuJoCo")
    monkeypatch.chdir(tmp_path)  # MuJoCo leaves a log
    for bad in (1e13, np.nan):
        act(suite, task["name"], 1, 0.0, 2)
        suite.world().data.qvel[0] = bad
        with pytest.raises(SimulationDiverged, match=r"BADQ(POS|VEL)"):
            suite.step(suite.observe().command)
    assert not act(suite, task["name"], 1, 0.0, 2)[-1].success  # another episode is as good as before


def test_the_expert_succeeds_and_chance_does_not(task: dict[str, Any], suite: TaskSuite) -> None:
    last = [act(suite, task["name"], 900 + seed, 0.0, task["horizon"])[-1] for seed in range(6)]
    assert sum(seen.success for seen in last) >= 5
    assert all(seen.progress > 0.8 for seen in last if seen.success)
    random = [act(suite, task["name"], 900 + seed, 1.0, task["horizon"])[-1] for seed in range(6)]
    assert sum(seen.success for seen in random) <= 3


def test_the_number_of_workers_changes_nothing(task: dict[str, Any], suite: TaskSuite) -> None:
    jobs = [(seed, 0.5) for seed in SEEDS]
    tracks, steps = [], []
    for slots, workers in ((1, 1), (3, 2)):
        pool = TaskPool(task["suite"], task["name"], slots, 3, workers)
        tracks.append(pool.script(jobs, 1))
        if workers == 2:
            assert not {"torch", "torchrl"} & set(pool.modules()), "physics workers imported torch"
            observed = pool.reset(dict(enumerate(SEEDS)), True)
            steps = [np.stack([row["command"]] * 3) for row in observed.values()]
            batched = pool.step(dict(enumerate(steps)))
        else:
            alone = pool
    for one, two in zip(*tracks, strict=True):
        check_equal(one, two)
    for slot, seed in enumerate(SEEDS):
        alone.reset({0: seed}, True)
        after = alone.step({0: steps[slot]})[0]
        check_equal(after.pop("track"), batched[slot].pop("track"))
        assert all(np.array_equal(after[name], batched[slot][name]) for name in after)
    pool.close()


def test_a_track_keeps_apart_what_only_physics_knows(task: dict[str, Any], suite: TaskSuite) -> None:
    pool = TaskPool(task["suite"], task["name"], 1, 2, 1)
    (track,) = pool.script([(1, 0.0)], 1)
    suite.reset(task["name"], 1)
    assert {"progress", *suite.privileged()} == track.privileged.keys()
    poses = suite.privileged().get("object_poses")
    if poses is not None:  # evaluation measures the first object by its first three numbers
        assert poses.ndim == 2 and poses.shape[1] >= 3 and np.isfinite(poses).all()
    assert not track.privileged.keys() & track.rows.keys()
    episode = Episode.from_track(track, "expert", suite.embodiment)
    assert episode.privileged.keys() == track.privileged.keys() and len(episode.frames) == 3
    assert np.array_equal(episode.frames, track.stack()["frames"])


def test_the_env_keeps_its_specs_and_resets_in_part(task: dict[str, Any], suite: TaskSuite) -> None:
    env = env_of(task, suite, 2, 4)
    check_env_specs(env)
    env.schedule([21, 22, 23])
    start = env.reset()
    assert start[EPISODE].flatten().tolist() == [21, 22]
    step = start.clone()
    still = start[COMMAND] if task["mode"] == "absolute" else torch.zeros_like(start[COMMAND])
    step[CHUNK] = still.unsqueeze(1).expand(-1, 2, -1).clone()
    after = env.step(step)["next"]
    assert not bool(after["done"].any())
    part = after.clone()
    part["_reset"] = torch.tensor([[True], [False]])
    mixed = env.reset(part)
    assert mixed[EPISODE].flatten().tolist() == [23, 22]
    assert torch.equal(mixed[IMAGE][1], after[IMAGE][1]) and torch.equal(mixed[STATE][1], after[STATE][1])
    assert not torch.equal(mixed[IMAGE][0], after[IMAGE][0])
    assert env.instructions[1] and len(env.instructions) == 2
    step[CHUNK] = step[CHUNK].clone()
    last = env.step(step)["next"]
    assert last["truncated"].flatten().tolist() == [False, True]
    env.close()


def test_bad_input_is_named(task: dict[str, Any], suite: TaskSuite) -> None:
    with pytest.raises(ConfigError, match=r"task\.name='no-such-task' is unknown; the nearest"):
        suite.reset("no-such-task", 0)
    suite.reset(task["name"], 0)
    with pytest.raises(ValueError, match="noise_level"):
        suite.expert(1.5, np.random.default_rng(0))
    with pytest.raises(ValueError, match="finite"):
        suite.step(np.full(suite.embodiment.action_dim, np.nan))
    with pytest.raises(ConfigError, match=r"task\.suite\.cameras holds \['belly'\]"):
        build_suite({**task["suite"], "cameras": ["belly"]})
    with pytest.raises(ConfigError, match="colour"):
        build_suite({**task["suite"], "colour": "blue"})
