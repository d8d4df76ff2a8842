"""Columns of data sets as other people fill them: read as they are meant, or refused by name."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from envs.embodiment import ActionKind, Arm
from envs.episodes import EpisodeError, LeRobotDataset, LeRobotWriter
from envs.episodes.clips import ClipStore
from tests.embodiments import ARM_DELTAS, world_spec
from tests.envs.episodes.lerobot.sets import LENGTHS, SETS, change_info, set_column, write_set
from tests.moving_square import SIZE, moving_square

SUCCESS = "next.success"
OF = np.repeat(np.arange(len(LENGTHS)), LENGTHS)  # the episode of each row
NAN = math.nan


@pytest.mark.parametrize("unknown", [None, NAN])
def test_an_episode_whose_labels_are_all_unknown_is_unlabelled(unknown: float | None, tmp_path: Path) -> None:
    root = tmp_path / "set"
    write_set(root, SETS["labelled"])
    told = [unknown if number in (0, 3) else float(number == 2) for number in OF]
    set_column(root, SUCCESS, told)
    assert [episode.succeeded for episode in LeRobotDataset(root)] == [None, False, True, None]
    store = ClipStore([root], world_spec(LeRobotDataset(root).embodiment, (32, 32)), tmp_path / "cache")
    assert store.arrays["labelled"].tolist() == [False, True, True, False]


@pytest.mark.parametrize(
    ("told", "match"),
    [
        ([NAN if number == 1 and k % 2 else 0.0 for k, number in enumerate(OF)], "is null or NaN in 6 of 11"),
        ([None if k == 9 else False for k in range(len(OF))], "is null or NaN in 1 of 11"),
        (["False"] * len(OF), r"holds 'False'.*true and false"),
        ([0.5] * len(OF), r"holds 0\.5"),
        ([2] * len(OF), "holds 2"),
    ],
    ids=["nan", "null", "text", "half", "two"],
)
def test_labels_that_say_nothing_certain_are_refused(told: list[Any], match: str, tmp_path: Path) -> None:
    write_set(tmp_path, SETS["labelled"])
    set_column(tmp_path, SUCCESS, told)
    with pytest.raises(EpisodeError, match=rf"episode [01]: column next\.success {match}"):
        list(LeRobotDataset(tmp_path))


def test_whole_numbers_are_labels(tmp_path: Path) -> None:
    write_set(tmp_path, SETS["labelled"])
    set_column(tmp_path, SUCCESS, [int(number != 1) for number in OF])
    assert [episode.succeeded for episode in LeRobotDataset(tmp_path)] == [True, False, True, True]


def test_columns_of_our_names_are_somebody_elses_in_their_sets(tmp_path: Path) -> None:
    write_set(tmp_path, SETS["labelled"])
    before = list(LeRobotDataset(tmp_path))
    set_column(tmp_path, "command", [[9.0] * 7] * len(OF))
    set_column(tmp_path, "present", ["yes"] * len(OF))
    set_column(tmp_path, "end_effector.command", [[1.0, 2.0]] * len(OF))
    set_column(tmp_path, "privileged.note", ["x"] * len(OF))
    for one, other in zip(before, LeRobotDataset(tmp_path, privileged=True), strict=True):
        assert np.array_equal(one.commands, other.commands) and other.present.all()
        assert other.poses is None and not other.privileged


@pytest.mark.parametrize(
    ("name", "cell", "match"),
    [
        ("command", [0.0, 1.0], "holds 2 numbers a row, but franka makes it 7"),
        ("present", "yes", "holds 'yes'"),
        ("end_effector.command", [0.0, 1.0], "holds 2 numbers a row, but franka makes it 7"),
    ],
)
def test_our_columns_are_checked_in_sets_with_our_description(
    name: str, cell: Any, match: str, tmp_path: Path
) -> None:
    write_set(tmp_path, SETS["labelled"])
    change_info(tmp_path, lambda info: info["features"]["action"].update(info={"worldloop": {}}))
    set_column(tmp_path, name, [cell] * len(OF))
    with pytest.raises(EpisodeError, match=rf"episode 0: column {name} {match}"):
        LeRobotDataset(tmp_path).episode(0)


@pytest.mark.parametrize("value", [None, "abc", 0.5])
def test_seeds_that_are_no_numbers_are_refused(value: Any, tmp_path: Path) -> None:
    write_set(tmp_path, SETS["labelled"])
    set_column(tmp_path, "seed", [value if number == 2 else type(value or 0)(7) for number in OF])
    with pytest.raises(EpisodeError, match=r"episode 2: column seed holds .* rename"):
        LeRobotDataset(tmp_path).episode(2)


def test_text_where_numbers_should_be_is_named(tmp_path: Path) -> None:
    write_set(tmp_path, SETS["labelled"])
    set_column(tmp_path, "next.reward", ["much"] * len(OF))
    with pytest.raises(EpisodeError, match=r"column next\.reward holds string where numbers"):
        LeRobotDataset(tmp_path).episode(0)


def test_the_first_command_of_changes_leaves_grippers_where_they_are(tmp_path: Path) -> None:
    write_set(tmp_path, SETS["labelled"])
    robot = replace(
        LeRobotDataset(tmp_path).embodiment,
        action_kind=ActionKind.END_EFFECTOR,
        delta=True,
        arms=(Arm("arm", (0, 1, 2), 6, (1.0, 0.0)),),
    )
    data = LeRobotDataset(tmp_path, embodiment=robot)
    for number, episode in enumerate(data):
        first = data.column("action")[number == OF][0]
        assert episode.commands[0].tolist() == [0, 0, 0, 0, 0, 0, first[6]]


def test_the_first_command_that_we_recorded_is_kept(tmp_path: Path) -> None:
    made = moving_square(ARM_DELTAS, 0)
    made.commands[0] = 0.25
    LeRobotWriter(tmp_path, ARM_DELTAS.at(SIZE)).write([made])
    assert LeRobotDataset(tmp_path).episode(0).commands[0].tolist() == [0.25] * 4


def test_the_source_of_a_set_is_the_name_of_its_folder_by_any_path(tmp_path: Path) -> None:
    write_set(tmp_path / "set", SETS["labelled"])
    (tmp_path / "link").symlink_to(tmp_path / "set")
    assert {episode.source for episode in LeRobotDataset(tmp_path / "link")} == {"set"}


# -- rates, depth and instructions
def test_a_rate_that_is_not_the_videos_is_named_before_anything_is_read(tmp_path: Path) -> None:
    write_set(tmp_path, SETS["labelled"])
    change_info(tmp_path, lambda info: info.update(fps=30))
    with pytest.raises(
        EpisodeError, match=r"info\.json: fps is 30, but .* 9 frames of episode 0 0\.9 s .* is 10 a sec"
    ):
        LeRobotDataset(tmp_path)
    change_info(tmp_path, lambda info: info.update(fps=10.2))  # a fifth of a frame
    assert len(list(LeRobotDataset(tmp_path))) == len(LENGTHS)


def depths(kind: type[np.generic]) -> list[dict[str, Any]]:
    """Cells of a picture column of one channel."""
    rows = [np.full((48, 64), 1500 if kind is np.uint16 else 90, kind) for _ in OF]
    return [{"bytes": cv2.imencode(".png", row)[1].tobytes(), "path": "deep.png"} for row in rows]


def test_depth_without_a_mark_is_left_out_and_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_set(tmp_path, SETS["images"])
    set_column(tmp_path, "observation.images.deep", depths(np.uint16))
    deep = {"dtype": "image", "shape": [48, 64, 1], "names": ["height", "width", "channels"]}
    change_info(tmp_path, lambda info: info["features"].update({"observation.images.deep": deep}))
    data = LeRobotDataset(tmp_path)
    assert data.embodiment.views == ("front",) and data.episode(0).frames.shape[1] == 1
    (said,) = caplog.messages
    assert "['observation.images.deep'] are left out as depth" in said


def test_depth_that_is_said_to_be_in_colour_is_refused(tmp_path: Path) -> None:
    write_set(tmp_path, SETS["images"])
    name = "observation.images.front"
    set_column(tmp_path, name, depths(np.uint8))
    assert (LeRobotDataset(tmp_path).episode(0).frames == 90).all()  # grey, which is a picture
    set_column(tmp_path, name, depths(np.uint16))
    with pytest.raises(EpisodeError, match=rf"{name} holds uint16 of one channel.*is_depth_map"):
        LeRobotDataset(tmp_path).episode(0)


def test_several_instructions_in_an_episode_are_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    write_set(tmp_path, SETS["labelled"])
    path = tmp_path / "meta/episodes/chunk-000/file-000.parquet"
    rows = pq.read_table(path).to_pylist()
    rows[1]["tasks"] = ["task 1", "task 0"]
    pq.write_table(pa.Table.from_pylist(rows), path)
    assert LeRobotDataset(tmp_path).episode(1).instruction == "task 1"
    (said,) = caplog.messages
    assert "1 of 4 episodes have several instructions" in said
