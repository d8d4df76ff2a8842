"""Which episodes are learned from, held out, and kept for calibration."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from envs.episodes import EpisodeError, LeRobotWriter
from envs.episodes.clips import ClipStore
from envs.episodes.splits import keep_in_splits, range_of, read_splits, write_splits
from tests.embodiments import ARM_DELTAS, BIMANUAL_POSES, world_spec
from tests.moving_square import SIZE, moving_square

SPEC = world_spec(BIMANUAL_POSES.at(SIZE), SIZE)


def test_splits_of_a_set_that_names_none_go_by_number(store: ClipStore) -> None:
    parts = {name: store.split(name).tolist() for name in ("train", "held_out", "calibration")}
    assert sorted(number for part in parts.values() for number in part) == list(range(20))
    for begin in (0, 8):
        mine = {name: [n for n in part if begin <= n < begin + 8] for name, part in parts.items()}
        assert (len(mine["held_out"]), len(mine["calibration"])) == (1, 2)


def test_tasks_that_were_recorded_by_turns_are_in_every_split() -> None:
    for tasks in (2, 4, 8):
        for name in ("train", "held_out", "calibration"):
            mine = range_of({"train": "0:160"}, name, 160, Path("set"))
            assert {number % tasks for number in mine} == set(range(tasks)), (tasks, name)


def test_episodes_that_train_does_not_name_are_in_no_split() -> None:
    names = ("train", "held_out", "calibration")
    for said, used in (("0:8", range(8)), ("2:5,8:12", [2, 3, 4, 8, 9, 10, 11]), ("0:99", range(16))):
        parts = [range_of({"train": said}, name, 16, Path("set")) for name in names]
        assert sorted(number for part in parts for number in part) == list(used)
        whole = [range_of({}, name, 16, Path("set")) for name in names]
        assert all({*part} <= {*every} for part, every in zip(parts, whole, strict=True))
    with pytest.raises(EpisodeError, match="'train' must be among them, as"):
        range_of({"train": "all"}, "held_out", 16, Path("set"))


def test_nothing_is_learned_from_what_somebody_called_validation_or_test() -> None:
    said = {"train": "0:14", "val": "12:15", "test": "15:16"}  # those that are in both are not learned from
    parts = {name: range_of(said, name, 16, Path("set")) for name in ("train", "held_out", "calibration")}
    assert parts["held_out"] == [12, 13, 14, 15]
    assert sorted(parts["train"] + parts["calibration"]) == list(range(12))
    assert len(parts["calibration"]) == 3
    with pytest.raises(EpisodeError, match="'train' must be among them"):
        range_of({"training": "0:14", "val": "14:16"}, "train", 16, Path("set"))


def test_splits_are_those_of_each_data_set(dataset: Path, tmp_path: Path) -> None:
    root = tmp_path / "set"
    shutil.copytree(dataset, root)
    write_splits(root, {"train": 12, "held_out": 5, "calibration": 3})
    store = ClipStore([dataset, root], SPEC)
    first = range_of({"train": "0:20"}, "held_out", 20, dataset)
    assert store.split("held_out").tolist() == [*first, *range(32, 37)]
    with pytest.raises(EpisodeError, match=r"'test' must be among them"):
        store.split("test")


def test_splits_stand_in_info_json(dataset: Path, tmp_path: Path) -> None:
    root = tmp_path / "set"
    shutil.copytree(dataset, root)
    write_splits(root, {"train": 12, "held_out": 5, "calibration": 3})
    info = json.loads((root / "meta/info.json").read_text())
    assert info["splits"] == {"train": "0:12", "held_out": "12:17", "calibration": "17:20"}
    with pytest.raises(EpisodeError, match="do not add up to 20"):
        write_splits(root, {"train": 12})


def test_fewer_episodes_can_be_kept_in_splits(dataset: Path, tmp_path: Path) -> None:
    root = tmp_path / "set"
    shutil.copytree(dataset, root)
    whole = read_splits(root)  # by number, as the set names none
    assert whole["held_out"] == [7, 14] and len(whole["train"]) == 13
    keep_in_splits(root, {"train": whole["train"][:4], "held_out": whole["held_out"], "calibration": []})
    info = json.loads((root / "meta/info.json").read_text())
    assert info["splits"] == {"train": "0:2,3:5", "held_out": "7:8,14:15", "calibration": "0:0"}
    assert read_splits(root) == {"train": [0, 1, 3, 4], "held_out": [7, 14], "calibration": []}


def test_appending_leaves_splits_as_they_are(tmp_path: Path) -> None:
    root, robot = tmp_path / "set", ARM_DELTAS.at(SIZE)
    writer, made = LeRobotWriter(root, robot), [moving_square(ARM_DELTAS, seed) for seed in range(9)]

    def splits() -> dict[str, str]:
        found: dict[str, str] = json.loads((root / "meta/info.json").read_text())["splits"]
        return found

    def members(name: str) -> list[int]:
        store = ClipStore([root], world_spec(robot, SIZE), tmp_path / "cache")
        return [int(store.episodes[number]["seed"]) for number in store.split(name).tolist()]

    writer.write(made[:1])
    info = json.loads((root / "meta/info.json").read_text())
    del info["splits"]  # whoever wrote it said nothing
    (root / "meta/info.json").write_text(json.dumps(info))
    writer.write(made[1:4])
    assert splits() == {"train": "0:4"}  # as LeRobot writes it
    write_splits(root, {"train": 2, "held_out": 1, "calibration": 1})
    writer.write(made[4:6])
    LeRobotWriter(root, robot).write(made[6:7])
    assert splits() == {"train": "0:2,4:7", "held_out": "2:3", "calibration": "3:4"}
    writer = LeRobotWriter(root, robot)
    writer.write(made[7:8], split="held_out")
    writer.write(made[8:], split="mine")
    assert splits() == {"train": "0:2,4:7", "held_out": "2:3,7:8", "calibration": "3:4", "mine": "8:9"}
    assert members("train") == [0, 1, 4, 5, 6] and members("held_out") == [2, 7]
    assert members("calibration") == [3] and members("mine") == [8]


def test_an_interrupted_description_knows_the_split(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root, robot = tmp_path / "set", ARM_DELTAS.at(SIZE)
    writer = LeRobotWriter(root, robot)
    writer.write([moving_square(ARM_DELTAS, seed) for seed in range(3)])

    def fail(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as broken, pytest.raises(KeyboardInterrupt):
        broken.setattr(writer, "_describe", fail)
        writer.write([moving_square(ARM_DELTAS, 3)], split="held_out")
    assert LeRobotWriter(root, robot).episodes == 4
    info = json.loads((root / "meta/info.json").read_text())
    assert info["splits"] == {"train": "0:3", "held_out": "3:4"} and info["total_episodes"] == 4
