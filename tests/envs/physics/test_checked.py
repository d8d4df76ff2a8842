"""What a suite shows and says and its embodiment does not, found before anything is recorded."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from envs.episodes import Episode, LeRobotWriter
from envs.episodes.episode import EpisodeError
from envs.physics.checked import observation
from envs.physics.pool import PoolError, TaskPool
from envs.physics.suite import SuiteError
from envs.targets import ConfigError
from tests.suites.counting import Saying, TwoCameras

SUITES = "tests.suites.counting"
COUNTING = {"_target_": f"{SUITES}.Counting", "fault": ""}


def test_pictures_that_are_not_those_of_the_embodiment_are_refused_before_they_are_recorded() -> None:
    said = r"Counting\.render gives uint8 \[1, 3, 4, 6\], but its embodiment's .* \[1, 3, 4, 4\]"
    for ask in (lambda pool: pool.script([(0, 0.0)], 1), lambda pool: pool.reset({0: 0}, False)):
        pool = TaskPool({**COUNTING, "shows": [4, 6]}, "count", 2, 8, 2)
        with pytest.raises(ConfigError, match=said):
            ask(pool)
        assert not pool.lost
        pool.close()


@pytest.mark.parametrize(
    ("tells", "said"),
    [
        ("nothing", r"gives no intrinsic, .* calibrated=True of camera eye; give intrinsic \[2, 3, 3\], NaN"),
        ("no poses", r"gives no c2w, .* calibrated=True of camera eye; give c2w \[2, 4, 4\], NaN of"),
        (
            "one camera",
            r"gives intrinsic \[1, 3, 3\] for cameras eye, other, which make it \[2, 3, 3\];",
        ),
        ("nan", r"gives c2w with NaN .* for camera eye, .*; give finite ones, or say calibrated=False"),
        ("zeros", r"gives c2w for camera other, .* does not say calibrated=True; say so, or give NaN"),
    ],
)
def test_calibration_that_is_not_what_the_embodiment_says_is_refused_at_the_start(
    tells: str, said: str
) -> None:
    suite = {"_target_": f"{SUITES}.TwoCameras", "tells": tells}
    for ask in (lambda pool: pool.script([(0, 0.0)], 1), lambda pool: pool.reset({0: 0}, False)):
        pool = TaskPool(suite, "count", 1, 8, 1)
        with pytest.raises(ConfigError, match=rf"task\.suite: TwoCameras\.observe {said}"):
            ask(pool)
        assert not pool.lost
        pool.close()


def test_cameras_that_are_not_calibrated_are_nan_among_others() -> None:
    pool = TaskPool({"_target_": f"{SUITES}.TwoCameras", "tells": ""}, "count", 1, 8, 1)
    (track,) = pool.script([(0, 0.0)], 1)
    assert pool.reset({0: 0}, False)[0]["c2w"].shape == (2, 4, 4)
    pool.close()
    episode = Episode.from_track(track, "expert", TwoCameras("").embodiment)
    assert episode.c2w is not None and np.isnan(episode.c2w[:, 1]).all() and len(episode) == 9


def saying(what: str, **how: int) -> TaskPool:
    return TaskPool({"_target_": f"{SUITES}.Saying", "what": what, **how}, "count", 1, 8, 1)


@pytest.mark.parametrize(
    ("what", "said"),
    [
        ("no state", r"gives nothing for state, of which its embodiment makes float \[1\]"),
        ("long state", r"gives numbers \[2\] for state, .* float \[1\]; correct either"),
        ("words for numbers", r"gives command=\['left'\], which are no numbers; give float \[1\]"),
        ("no words", r"gives instruction=None; give the task in words"),
        ("much progress", r"gives progress=7\.5; it is RL's reward in physics: bring it to 0\.\.1"),
        ("less than none", r"gives progress=-0\.1; "),
        ("many progresses", r"gives numbers \[2\] for progress"),
        ("unknown progress", r"gives progress nan, which is not finite"),
        ("infinite", r"gives state \[inf\], which is not finite"),
        ("numbers for success", r"gives success=0\.0; give a bool"),
        ("no arms", r"gives numbers \[1, 7\] for poses, .* float \[0, 7\]"),
    ],
)
def test_what_an_observation_cannot_hold_is_refused_at_the_start(what: str, said: str) -> None:
    with pytest.raises(SuiteError, match=rf"^task\.suite: Saying\.observe {said}"):
        observation(Saying(what))


@pytest.mark.parametrize("what", ["lists", "arrays"])
def test_what_can_be_brought_to_the_contract_is(what: str) -> None:
    seen = observation(Saying(what))
    assert (seen.success, seen.progress) == (False, 0.25)
    assert type(seen.success) is bool and type(seen.progress) is float
    assert seen.state.shape == seen.command.shape == (1,) and seen.command.dtype == np.float64


def test_episodes_that_begin_with_their_task_done_are_dropped_and_counted(
    caplog: pytest.LogCaptureFixture,
) -> None:
    for ask in (
        lambda pool, *seeds: [track.seed for track in pool.script([(seed, 0.0) for seed in seeds], 1)],
        lambda pool, *seeds: [seeds[slot] for slot in pool.reset(dict(enumerate(seeds)), True)],
    ):
        caplog.clear()
        with closing(TaskPool({"_target_": f"{SUITES}.Done", "fault": ""}, "count", 3, 8, 1)) as pool:
            assert ask(pool, 4, 5, 8) == [4, 8] and pool.lost == [5]
            assert "Done.observe gives success=True at the start of an episode" in caplog.text
            assert "seed 5; it is dropped" in caplog.text
            with pytest.raises(PoolError, match=r"(?s)seeds \[5, 6\].*let reset draw again"):
                ask(pool, 6)


def test_a_success_that_is_taken_back_is_refused_wherever_it_is_played() -> None:
    for ask in (lambda pool: pool.script([(0, 0.0)], None), _played):
        pool = saying("won", since=1, frames=2)
        with pytest.raises(
            ConfigError, match=r"Saying\.observe gives success=False after it was True .*Held"
        ):
            ask(pool)
        pool.close()
    pool = saying("won", since=1)
    (track,) = pool.script([(0, 0.0)], None)
    pool.close()
    assert [bool(row) for row in track.rows["success"]] == [False] + 8 * [True]


def _played(pool: TaskPool) -> None:
    pool.reset({0: 0}, False)
    pool.step({0: np.zeros((4, 1))})


def test_numbers_that_physics_blows_up_cost_an_episode_and_not_the_run() -> None:
    pool = saying("infinite", since=2)
    assert not pool.script([(3, 0.0)], 1) and pool.lost == [3]
    pool.close()


def test_shapes_of_what_only_physics_knows_stay() -> None:
    pool = saying("more things", since=2)
    with pytest.raises(
        ConfigError, match=r"privileged gives object_poses \[2, 3\] after \[1, 3\]; its shape"
    ):
        pool.script([(0, 0.0)], 1)
    pool.close()


def test_shapes_that_hang_on_the_task_are_told_where_episodes_meet(tmp_path: Path) -> None:
    robot, made = Saying("lists").embodiment, []
    for since in (0, 99):
        pool = saying("more things", since=since)
        made.append(Episode.from_track(pool.script([(since, 0.0)], 1)[0], "expert", robot))
        pool.close()
    with pytest.raises(EpisodeError, match=r"privileged\.object_poses .*are the suite's, whatever the task"):
        LeRobotWriter(tmp_path, robot).write(made)
