"""Data sets both ways between Worldloop and LeRobot's own software.

Run it with an interpreter that has `lerobot[dataset]` (seen with 0.6.1, Python 3.12); of Worldloop it needs
the folder, and numpy, PyAV, pyarrow and OpenCV, which LeRobot brings along:

    PYTHONPATH=/path/to/worldloop python docs/lerobot_roundtrip.py
"""

from __future__ import annotations

import json
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.datasets import dataset_tools as tools
from lerobot.datasets.lerobot_dataset import LeRobotDataset as TheirDataset

from envs.embodiment import ActionKind, Arm, Camera, Embodiment
from envs.episodes import Episode, LeRobotDataset, LeRobotWriter

ROBOT = Embodiment(
    robot="one_arm",
    action_names=("x", "y", "z", "roll", "pitch", "yaw", "gripper"),
    action_kind=ActionKind.END_EFFECTOR,
    delta=False,
    arms=(Arm("arm", tuple(range(6)), 6),),
    state_names=("x", "y", "z", "roll", "pitch", "yaw", "gripper"),
    cameras=(Camera("front", (48, 64), calibrated=True), Camera("hand", (48, 64), wrist="arm")),
    fps=10.0,
)


def pictures(length: int, height: int, width: int, seed: int) -> np.ndarray:
    """Smooth pictures uint8 [T, 3, H, W], each different."""
    rows, columns = np.mgrid[0:height, 0:width]
    waves = [
        np.sin((rows + 2 * t) / 9 + seed) + np.cos((columns - t) / 11 + k)
        for t in range(length)
        for k in range(3)
    ]
    return (120 + 55 * np.stack(waves)).astype(np.uint8).reshape(length, 3, height, width)


def made_episode(seed: int, length: int = 14, robot: Embodiment = ROBOT) -> Episode:
    """An episode of ROBOT with everything that an episode may have; one camera is not calibrated."""
    rng = np.random.default_rng(seed)
    c2w = np.tile(np.eye(4, dtype=np.float32), (length, 2, 1, 1))
    intrinsic = np.tile(np.array([[60, 0, 32], [0, 60, 24], [0, 0, 1]], np.float32), (2, 1, 1))
    c2w[:, 1], intrinsic[1] = np.nan, np.nan
    return Episode(
        frames=np.stack([pictures(length, 48, 64, seed + k) for k in range(2)], 1),
        commands=rng.normal(size=(length, 7)).astype(np.float32),
        states=rng.normal(size=(length, 7)).astype(np.float32),
        instruction=("lift the cube", "open the drawer")[seed % 2],
        embodiment=robot,
        source="expert",
        seed=seed,
        success=np.arange(length) >= length - 2,
        intrinsic=intrinsic,
        c2w=c2w,
        reward=rng.normal(size=length).astype(np.float32),
        privileged={"objects": rng.normal(size=(length, 2, 4)).astype(np.float32)},
    )


def compare(root: Path, seeds: list[int]) -> None:
    """Open a data set of made episodes with both readers and compare pixels and columns."""
    theirs = TheirDataset("worldloop/made", root=root, video_backend="pyav")
    ours = LeRobotDataset(root, privileged=True)
    assert len(theirs) == sum(len(episode) for episode in ours), (len(theirs), root)
    row = 0
    for seed, episode in zip(seeds, ours, strict=True):
        made = made_episode(seed, robot=replace(ROBOT, fps=ours.fps))
        for name in ("commands", "states", "success", "c2w", "intrinsic"):
            assert np.array_equal(getattr(made, name), getattr(episode, name), equal_nan=True), (root, name)
        assert np.array_equal(made.privileged["objects"], episode.privileged["objects"])
        assert (made.seed, made.source) == (episode.seed, episode.source)
        assert made.embodiment == episode.embodiment, (made.embodiment, episode.embodiment)
        for t in range(len(episode)):
            item = theirs[row]
            for k, view in enumerate(ROBOT.views):
                their = (item[f"observation.images.{view}"] * 255).round().to(torch.uint8).numpy()
                assert np.abs(their.astype(int) - episode.frames[t, k]).max() <= 1, (root, seed, t, view)
            assert np.array_equal(item["observation.state"].numpy(), episode.states[t])
            assert np.array_equal(item["action"].numpy(), made.commands[min(t + 1, len(made) - 1)])
            assert item["task"] == episode.instruction
            row += 1
    stats = json.loads((root / "meta/stats.json").read_text(), parse_constant=lambda name: 1 / 0)
    assert {"q01", "q50", "q99"} <= stats["action"].keys() and np.shape(stats["action"]["q99"]) == (7,)
    assert np.shape(stats["observation.images.front"]["mean"]) == (3, 1, 1)


def ours_in_lerobot(folder: Path) -> None:
    """What we write opens there, and what LeRobot's tools leave behind opens in both."""
    root = folder / "made"
    writer = LeRobotWriter(root, ROBOT)
    writer.write([made_episode(seed) for seed in range(3)])
    writer.write([made_episode(seed) for seed in range(3, 5)])
    compare(root, [0, 1, 2, 3, 4])
    from lerobot.utils.feature_utils import dataset_to_policy_features

    theirs = TheirDataset("worldloop/made", root=root, video_backend="pyav")
    shown = set(dataset_to_policy_features(theirs.meta.features))
    assert shown - {"next.reward"} == {
        "action",
        "observation.state",
        *(f"observation.images.{v}" for v in ROBOT.views),
    }, shown
    print("written by us: opens there, pixels and columns are equal; policies there see", sorted(shown))
    tools.delete_episodes(theirs, [1, 3], folder / "deleted", "worldloop/deleted")
    compare(folder / "deleted", [0, 2, 4])
    print("delete_episodes: opens in both")
    parts = tools.split_dataset(theirs, {"train": 0.6, "val": 0.4}, folder / "split")
    compare(parts["train"].root, [0, 1, 2])
    compare(parts["val"].root, [3, 4])
    print("split_dataset: opens in both")
    other = LeRobotWriter(folder / "other", ROBOT)
    other.write([made_episode(seed) for seed in (7, 8)])
    there = TheirDataset("worldloop/other", root=folder / "other", video_backend="pyav")
    tools.merge_datasets([theirs, there], "worldloop/merged", folder / "merged")
    compare(folder / "merged", [0, 1, 2, 3, 4, 7, 8])
    print("merge_datasets: opens in both")
    files = [path for path in (folder / "merged").rglob("*.*") if path.is_file()]
    before = {path: path.read_bytes() for path in files if path.parent.name != "meta"}
    LeRobotWriter(folder / "merged", ROBOT).write([made_episode(9)])
    assert all(path.read_bytes() == data for path, data in before.items())
    compare(folder / "merged", [0, 1, 2, 3, 4, 7, 8, 9])
    print("appended to the merged set: opens in both, and no file of theirs was touched")
    LeRobotWriter(folder / "deleted", ROBOT).write([made_episode(10)])
    compare(folder / "deleted", [0, 2, 4, 10])
    tools.modify_tasks(TheirDataset("worldloop/made", root=root), new_task="put it back")
    assert {episode.instruction for episode in LeRobotDataset(root)} == {"put it back"}
    TheirDataset("worldloop/made", root=root, video_backend="pyav")[0]
    print("modify_tasks: opens in both")
    slow = replace(ROBOT, fps=12.5)
    LeRobotWriter(folder / "slow", slow).write([made_episode(seed, robot=slow) for seed in (0, 1)])
    compare(folder / "slow", [0, 1])
    print("12.5 frames a second: opens there")


def _vector(names: Any, size: int) -> dict[str, Any]:
    return {"dtype": "float32", "shape": (size,), "names": names}


def _camera(kind: str, height: int, width: int) -> dict[str, Any]:
    return {"dtype": kind, "shape": (height, width, 3), "names": ["height", "width", "channels"]}


MOTORS = ["shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper"]
ALOHA = [
    f"{arm}_{joint}"
    for arm in ("left", "right")
    for joint in ("waist", "shoulder", "elbow", "forearm_roll", "wrist_angle", "wrist_rotate", "gripper")
]
FRANKA = ["x", "y", "z", "roll", "pitch", "yaw", "gripper"]
NEXT = {
    "next.reward": {"dtype": "float32", "shape": (1,), "names": None},
    "next.success": {"dtype": "bool", "shape": (1,), "names": None},
    "next.done": {"dtype": "bool", "shape": (1,), "names": None},
}
# name: fps, robot_type, features
THEIRS: dict[str, tuple[int, str, dict[str, Any]]] = {
    "single_arm": (
        20,
        "franka",
        {
            "observation.images.front": _camera("video", 48, 64),
            "observation.images.wrist": _camera("video", 32, 32),
            "observation.state": _vector(FRANKA, 7),
            "action": _vector(FRANKA, 7),
        },
    ),
    "aloha": (
        50,
        "aloha",
        {
            "observation.images.top": _camera("video", 48, 64),
            "observation.state": _vector({"motors": ALOHA}, 14),
            "action": _vector({"motors": ALOHA}, 14),
        },
    ),
    "so101": (
        30,
        "so101_follower",
        {
            "observation.images.up": _camera("video", 48, 64),
            "observation.state": _vector([f"{m}.pos" for m in MOTORS], 6),
            "action": _vector([f"{m}.pos" for m in MOTORS], 6),
        },
    ),
    "labelled": (
        10,
        "franka",
        {
            "observation.images.front": _camera("video", 48, 64),
            "observation.state": _vector(FRANKA, 7),
            "action": _vector(FRANKA, 7),
            **NEXT,
        },
    ),
    "images": (
        10,
        "franka",
        {
            "observation.images.front": _camera("image", 48, 64),
            "observation.state": _vector(FRANKA, 7),
            "action": _vector(FRANKA, 7),
        },
    ),
    "pusht": (
        10,
        "2d pointer",
        {
            "observation.image": _camera("video", 96, 96),
            "observation.state": _vector({"motors": ["motor_0", "motor_1"]}, 2),
            "action": _vector({"motors": ["motor_0", "motor_1"]}, 2),
            **NEXT,
        },
    ),
    "many_files": (
        10,
        "franka",
        {
            "observation.images.front": _camera("video", 48, 64),
            "observation.state": _vector(None, 7),
            "action": _vector(None, 7),
        },
    ),
}


def lerobot_in_ours(folder: Path) -> None:
    """What LeRobotDataset.create writes opens with us."""
    for name, (fps, robot, features) in THEIRS.items():
        theirs = TheirDataset.create(
            f"worldloop/{name}", fps, features, folder / name, robot, use_videos=name != "images"
        )
        if name == "many_files":  # every episode in files of its own
            theirs.meta.info.data_files_size_in_mb = theirs.meta.info.video_files_size_in_mb = 1e-6
        given: list[list[dict[str, Any]]] = []
        for number in range(3):
            rng, rows = np.random.default_rng(number), []
            for t in range(9 + number):
                row: dict[str, Any] = {}
                for key, feature in features.items():
                    if feature["dtype"] in ("video", "image"):
                        row[key] = pictures(9 + number, *feature["shape"][:2], number)[t].transpose(1, 2, 0)
                    elif key == "next.reward":
                        row[key] = np.array([0.1 * t], np.float32)
                    elif feature["dtype"] == "bool":
                        row[key] = np.array([t == 8 + number and number != 1])
                    else:
                        row[key] = rng.normal(size=feature["shape"]).astype(np.float32)
                rows.append(row)
                theirs.add_frame({**row, "task": f"task {number % 2}"})
            theirs.save_episode()
            given.append(rows)
        theirs.finalize()
        ours = LeRobotDataset(folder / name, size=(48, 64))
        robot_seen = ours.embodiment
        assert robot_seen.robot == robot and robot_seen.fps == fps and len(ours) == 3
        for number, (episode, rows) in enumerate(zip(ours, given, strict=True)):
            assert episode.instruction == f"task {number % 2}"
            assert np.array_equal(episode.states, [row["observation.state"] for row in rows])
            assert np.array_equal(episode.commands[1:], [row["action"] for row in rows[:-1]])
            key = next(key for key in features if "image" in key)
            if features[key]["shape"][:2] == (48, 64):
                shown = np.stack([row[key].transpose(2, 0, 1) for row in rows])
                assert np.abs(shown.astype(int) - episode.frames[:, 0]).mean() < 6, name
            assert episode.succeeded == ((number != 1) if "next.success" in features else None)
        files = len(list((folder / name / "data").rglob("*.parquet")))
        kind = robot_seen.action_kind.value
        print(f"written there, {name}: opens; {kind}, {robot_seen.action_names}, {files} data files")


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as made:
        ours_in_lerobot(Path(made) / "ours")
        lerobot_in_ours(Path(made) / "theirs")
