"""Errors of an object's place in generated video, measured where they can be."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from envs.episodes import Episode, LeRobotWriter
from envs.episodes.clips import ClipStore
from envs.files import write_json
from envs.geometry.cameras import project
from envs.physics.pool import TaskPool
from envs.physics.suite import build_suite
from envs.simulators.replay import Replay
from envs.specs import WorldSpec
from envs.targets import ConfigError
from pipeline.evaluation.fidelity.open_loop import Measured
from pipeline.evaluation.fidelity.page import object_text
from pipeline.evaluation.measurement import rollout_error
from pipeline.evaluation.objects.error import object_offsets
from pipeline.evaluation.objects.rays import on_plane
from tests.embodiments import BIMANUAL_POSES, world_spec
from tests.envs.physics.sections import task_section
from tests.moving_square import SIZE, SQUARE, moving_square
from tests.sampling import every

MEASURED = {"object_px", "object_cm", "object_cm_at_end", "object_lost", "locator_px", "locator_cm"}
CALIBRATED = [
    *(("metaworld", f"{task}-v3") for task in ("push", "drawer-open", "button-press-topdown")),
    *(("aloha", task) for task in ("transfer_cube", "insertion")),
    *(("ogbench", "scene-drawer"), ("push", "push"), ("tabletop", "pick_place")),
]


def store_of(folder: Path, change: Callable[[Episode], Episode]) -> ClipStore:
    """Calibrated episodes of the moving square, changed."""
    made = [change(moving_square(BIMANUAL_POSES, seed, "random")) for seed in range(3)]
    LeRobotWriter(folder / "set", BIMANUAL_POSES.at(SIZE)).write(made)
    return ClipStore([folder / "set"], world_spec(BIMANUAL_POSES.at(SIZE), SIZE), folder / "cache")


def recorded(store: ClipStore, episodes: torch.Tensor, shift: int = 0) -> Replay:
    """The true video as if a world had made it, with every picture `shift` pixels too far right."""
    rows, valid = store.whole(episodes)
    frames = store.frames(rows).roll(shift, -1)
    return Replay(frames, rows, valid, store.arrays["states"][rows], torch.zeros(len(rows), 1, 1))


def test_calibrated_data_without_privileged_columns_are_measured(tmp_path: Path) -> None:
    store = store_of(tmp_path, lambda episode: replace(episode, privileged={}))
    assert store.spec.embodiment.calibrated
    episodes = torch.arange(3)
    result = rollout_error(store, episodes, recorded(store, episodes))
    assert result["psnr_last_frames"] == 80.0 and not MEASURED & result.keys()


def with_positions(more: int, lifted: float = 0.0) -> Callable[[Episode], Episode]:
    """Records where the square is, as the first of two objects; `more` numbers follow each position. In the
    course of the episode it is lifted by so many metres.
    """

    def change(episode: Episode) -> Episode:
        assert episode.intrinsic is not None
        centre = (
            episode.privileged["object_pose"] * (SIZE[1] - SQUARE) + SQUARE / 2
        )  # pixels of the main view
        poses = np.zeros((len(episode), 2, 3 + more), np.float32)
        # The camera of tests.embodiments is a metre up and looks down, its y against the world's.
        poses[:, 0, 2] = np.linspace(0, lifted, len(episode))
        away = (1 - poses[:, 0, 2:3]) / episode.intrinsic[0, 0, 0]
        poses[:, 0, :2] = (centre - SIZE[1] / 2) * away * (1, -1)
        return replace(episode, privileged={"object_poses": poses})

    return change


@pytest.mark.parametrize("more", [0, 1, 4])
def test_the_first_object_is_measured_however_much_a_suite_says_of_it(more: int, tmp_path: Path) -> None:
    store, episodes = store_of(tmp_path, with_positions(more)), torch.arange(3)
    exact = rollout_error(store, episodes, recorded(store, episodes))
    assert exact["object_px"]["p90"] < 1.0 and exact["object_lost"] == 0.0
    shifted = rollout_error(store, episodes, recorded(store, episodes, shift=4))
    assert shifted["object_px"]["median"] == pytest.approx(4.0, abs=1.0)
    assert shifted["object_cm"]["median"] == pytest.approx(4 / 32 * 100, abs=3.0)
    assert shifted["locator_px"] == exact["locator_px"] == exact["object_px"]
    assert shifted["locator_cm"] == exact["locator_cm"] == exact["object_cm"]


def test_an_object_is_as_high_as_it_truly_is(tmp_path: Path) -> None:
    store, episodes = store_of(tmp_path, with_positions(0, lifted=0.5)), torch.arange(3)
    exact = rollout_error(store, episodes, recorded(store, episodes))
    assert exact["object_px"]["p90"] < 1.0 and exact["object_cm"]["p90"] < 2.0  # a pixel is 1.6 to 3.1 cm


def test_things_of_the_same_colour_are_no_part_of_it(tmp_path: Path) -> None:
    def crowded(episode: Episode) -> Episode:
        frames = episode.frames.copy()
        frames[:, :, :, -6:, -6:] = np.array([220, 40, 30], np.uint8)[:, None, None]  # the square's
        return replace(with_positions(0)(episode), frames=frames)

    store, episodes = store_of(tmp_path, crowded), torch.arange(3)
    exact = rollout_error(store, episodes, recorded(store, episodes))
    assert exact["object_px"]["p90"] < 1.0 and exact["object_lost"] == 0.0


def test_where_the_locator_fails_on_recorded_video_it_says_nothing(tmp_path: Path) -> None:
    def elsewhere(episode: Episode) -> Episode:
        known = with_positions(0)(episode)
        known.privileged["object_poses"][4:, 0, 0] += 0.3  # what has the colour stays behind
        return known

    store, episodes = store_of(tmp_path, elsewhere), torch.arange(3)
    made, measured = recorded(store, episodes), Measured()
    found = rollout_error(store, episodes, made)
    assert set(found) & MEASURED == {"locator_px", "locator_cm"} and found["locator_px"]["p90"] > 5
    measured.objects.append(object_offsets(store, episodes, made, store.frames(made.rows)))
    measured.add({"mse": torch.zeros(3, 1, 1)}, torch.ones(3, 1, dtype=torch.bool))
    result = measured.result((), {})
    assert result["object_cm"] is None and result["object_lost"] is None and result["locator_cm"] > 5
    said = object_text(result)
    assert "is unknown: the locator, which goes by its colour, errs by" in said
    assert "by more than 6.2% of the picture's side" in said
    dark = store.frames(made.rows).zero_()  # nor where it finds nothing
    measured.objects = [object_offsets(store, episodes, made, dark)]
    assert "finds it in no recorded frame" in object_text(measured.result((), {}))


def test_a_median_is_that_of_all_frames_however_they_were_measured(tmp_path: Path) -> None:
    store, measured = store_of(tmp_path, with_positions(0)), Measured()
    # one batch of one episode that is right, one of two that are not: the mean of medians is a third number
    for episodes, shift in ((torch.arange(1), 0), (torch.arange(1, 3), 4)):
        made = recorded(store, episodes, shift)
        measured.objects.append(object_offsets(store, episodes, made, store.frames(made.rows)))
    measured.add({"mse": torch.zeros(3, 1, 1)}, torch.ones(3, 1, dtype=torch.bool))
    found = measured.result((), {})
    every = torch.cat([part["cm"] for part in measured.objects])
    assert found["object_cm"] == float(every.median()) > 8.0 and found["object_lost"] == 0.0


def test_a_lost_object_is_said_to_be_lost(tmp_path: Path) -> None:
    store, episodes = store_of(tmp_path, with_positions(0)), torch.arange(3)
    right = recorded(store, episodes)
    true = store.frames(right.rows)
    black = right._replace(frames=torch.zeros_like(true))
    said = []
    for parts in ([black], [black, right], []):
        measured = Measured()
        measured.objects += [object_offsets(store, episodes, made, true) for made in parts]
        measured.add({"mse": torch.zeros(3, 1, 1)}, torch.ones(3, 1, dtype=torch.bool))
        said.append(object_text(measured.result((), {})))
    assert said[0].startswith(
        "The first object is lost: it is found in no generated frame; in recorded video"
    )
    assert "the same locator errs" in said[1]
    assert "median over the frames in which it is found) and is lost in 50.0% of those" in said[1]
    assert said[2].startswith("The first object is not measured")
    found = rollout_error(store, episodes, black)
    assert found["object_px"] is found["object_cm"] is None and found["object_lost"] == 1.0
    write_json(tmp_path / "found.json", found)  # or there would be numbers in it that are none


def test_poses_that_are_no_rows_of_objects_are_left_alone(tmp_path: Path) -> None:
    def flat(episode: Episode) -> Episode:
        return replace(episode, privileged={"object_poses": np.ones((len(episode), 14), np.float32)})

    store, episodes = store_of(tmp_path, flat), torch.arange(3)
    assert not MEASURED & rollout_error(store, episodes, recorded(store, episodes)).keys()


@pytest.mark.parametrize(("choice", "task"), every(3, CALIBRATED))
def test_true_video_is_measured_as_true_or_called_unknown(choice: str, task: str, tmp_path: Path) -> None:
    told = {} if choice in ("push", "tabletop") else {"calibrated": True}  # ours always are
    section = task_section(choice, **told, size=[64, 64])
    try:
        robot = build_suite(section["suite"]).embodiment
    except ConfigError as error:
        if "needs more packages" not in str(error):
            raise
        pytest.skip(str(error))
    pool = TaskPool(section["suite"], task, 2, section["horizon"], workers=1)
    try:
        tracks = pool.script([(1, 0.0), (2, 0.0)], 1)
    finally:
        pool.close()
    LeRobotWriter(tmp_path / "set", robot).write(
        [Episode.from_track(track, "scripted", robot) for track in tracks]
    )
    store = ClipStore([tmp_path / "set"], WorldSpec(robot, robot.cameras[0].size, 2))
    episodes = torch.arange(2)
    result = rollout_error(store, episodes, recorded(store, episodes))
    if "object_unknown" in result:
        assert not result.keys() & (MEASURED - {"locator_px", "locator_cm"})
        # whose things are as red as the robot, or as grey as what stands about
        assert choice in ("metaworld", "ogbench")
        return
    assert result.keys() >= MEASURED and result["object_px"] == result["locator_px"]
    assert result["object_px"]["median"] < 2.0 and result["object_cm"]["median"] < 5.0


def test_projection_is_the_inverse_of_on_plane() -> None:
    intrinsic = torch.tensor([[50.0, 0, 32], [0, 50, 32], [0, 0, 1]])
    c2w = torch.eye(4)
    c2w[:3, :3] = torch.tensor([[0.0, -1, 0], [-1, 0, 0], [0, 0, -1]])
    c2w[:3, 3] = torch.tensor([0.2, 0.0, 1.0])
    points = torch.tensor([[0.1, 0.2, 0.03], [0.3, -0.1, 0.03]])
    pixels, depth = project(points, intrinsic, c2w)
    assert bool((depth > 0).all())
    assert torch.allclose(on_plane(pixels, 0.03, intrinsic, c2w), points, atol=1e-5)
