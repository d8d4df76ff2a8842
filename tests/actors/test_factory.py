"""From a config to robots, specs and parts."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from torch import nn

from actors.factory import build_physics, build_policy, build_pool, open_clips
from actors.process import device_of, prepare_process
from actors.world_config import world_spec
from envs.embodiment import Embodiment
from envs.episodes import LeRobotWriter
from envs.episodes.formats.lerobot.columns import C2W, INTRINSIC
from envs.episodes.formats.lerobot.info import INFO_KEY, to_info
from envs.targets import ConfigError
from pipeline.config import composed
from tests.embodiments import ARM_DELTAS, ARM_JOINTS, BIMANUAL_JOINTS, BIMANUAL_POSES
from tests.envs.episodes.lerobot.sets import SETS, write_set
from tests.moving_square import SIZE, moving_square
from tests.sections import section

AROUND = {"pose_map": "auto", "ray_map": "auto", "kinematics": None}


def recorded(robot: Embodiment, folder: Path) -> Path:
    """A data set of which there is only the description."""
    features: dict[str, Any] = {
        "action": {"shape": [robot.action_dim], "names": list(robot.action_names), "dtype": "float32"},
        "observation.state": {"shape": [robot.state_dim], "names": list(robot.state_names)},
    }
    for camera in robot.cameras:
        features[f"observation.images.{camera.name}"] = {
            "dtype": "image",
            "shape": [*camera.size, 3],
            "names": ["height", "width", "channels"],
        }
    count = len(robot.calibrated_views)
    for name, numbers in ((C2W, 16), (INTRINSIC, 9)):
        if count:
            features[name] = {"shape": [count * numbers], "names": None, "dtype": "float32"}
    (folder / "meta").mkdir(parents=True)
    features["action"]["info"] = {INFO_KEY: to_info(robot)}
    info = {"robot_type": robot.robot, "fps": robot.fps, "features": features}
    (folder / "meta/info.json").write_text(json.dumps(info))
    return folder


def config(*folders: Path, **simulator: Any) -> dict[str, Any]:
    """A config whose robot is known from data alone."""
    task = {"suite": None, "data": [str(folder) for folder in folders], "size": [32, 48], "chunk": 4}
    return {
        "task": {**task, "mode": "absolute"},
        "simulator": {**AROUND, **simulator},
        "policy": section("policy/chunk_gaussian", "absolute"),
        "launch": {"device": "cpu", "compile": None},
    }


def test_sets_that_contradict_each_other_about_arms_are_refused(tmp_path: Path) -> None:
    folders = [recorded(ARM_JOINTS, tmp_path / name) for name in ("a", "b", "c")]
    assert world_spec(config(*folders)).embodiment == ARM_JOINTS
    for folder, arms in zip(folders, ({"gripper_range": [100, 0]}, None, {}), strict=True):
        info = json.loads((folder / "meta/info.json").read_text())
        own = info["features"]["action"]["info"][INFO_KEY]
        own["arms"] = None if arms is None else [{**own["arms"][0], **arms}]
        (folder / "meta/info.json").write_text(json.dumps(info))
    a, b, c = folders
    # b says nothing, so its names do: 100 open .. 0 closed
    assert world_spec(config(c, b)).embodiment.arms[0].gripper_range == (0, 100)
    with pytest.raises(ConfigError, match=r"task\.data: .*a and .*c are of different robots: arms are .*100"):
        world_spec(config(b, a, c))


@pytest.mark.parametrize(
    ("robot", "pose_map", "ray_map"),
    [(BIMANUAL_POSES, True, True), (BIMANUAL_JOINTS, False, True), (ARM_DELTAS, False, False)],
)
def test_conditioning_is_what_the_robot_allows(
    robot: Embodiment, pose_map: bool, ray_map: bool, tmp_path: Path
) -> None:
    cfg = config(recorded(robot, tmp_path / "a"))
    spec = world_spec(cfg)
    assert spec.embodiment == robot and spec.size == (32, 48)
    assert (spec.pose_map, spec.ray_map) == (pose_map, ray_map)
    assert not world_spec(config(tmp_path / "a", pose_map=False, ray_map=False)).ray_map
    assert build_policy(cfg).head.actions == robot.action_dim
    told = config(tmp_path / "a", pose_map=True)
    if robot is ARM_DELTAS:
        with pytest.raises(ConfigError, match="pose_map"):
            world_spec(told)
    else:  # recordings of joint commands may bring flange poses along
        assert world_spec(told).pose_map


def test_robots_that_are_unknown_or_differ_are_named(tmp_path: Path) -> None:
    one, other = recorded(ARM_DELTAS, tmp_path / "a"), recorded(ARM_JOINTS, tmp_path / "b")
    with pytest.raises(ConfigError, match="different robots: action_names"):
        world_spec(config(one, other))
    with pytest.raises(ConfigError, match="no robot is known"):
        world_spec(config())
    with pytest.raises(ConfigError, match="does not exist"):
        world_spec(config(tmp_path / "c"))
    with pytest.raises(ConfigError, match="must be auto, true or false"):
        world_spec(config(one, ray_map="perhaps"))


def rewritten(root: Path, change: Callable[[dict[str, Any], pa.Table], pa.Table]) -> None:
    """Change the features and the table of a data set of one file."""
    info = json.loads((root / "meta/info.json").read_text())
    (path,) = (root / "data").rglob("*.parquet")
    pq.write_table(change(info["features"], pq.read_table(path)), path)
    (root / "meta/info.json").write_text(json.dumps(info))


def test_calibration_that_columns_tell_is_used_whoever_recorded_it(tmp_path: Path) -> None:
    write_set(tmp_path / "set", SETS["labelled"])
    plain = config(tmp_path / "set", pose_map_style={})
    assert not world_spec(plain).ray_map

    def calibrate(features: dict[str, Any], table: pa.Table) -> pa.Table:
        for name, matrix in ((C2W, np.eye(4)), (INTRINSIC, np.diag([40.0, 40.0, 1.0]))):
            values = np.tile(matrix.astype(np.float32).reshape(-1), (len(table), 1))
            cells = pa.FixedSizeListArray.from_arrays(pa.array(values.reshape(-1)), values.shape[1])
            table = table.append_column(name, cells)
            features[name] = {"dtype": "float32", "shape": [values.shape[1]], "names": None}
        return table

    rewritten(tmp_path / "set", calibrate)
    spec = world_spec(plain)
    assert spec.ray_map and spec.pose_map and spec.embodiment.calibrated
    store = open_clips(plain, [tmp_path / "set"])
    assert torch.equal(store.arrays["c2w"], torch.eye(4).expand(len(store.arrays["c2w"]), 1, 4, 4))


def test_a_set_whose_calibration_was_removed_is_read_without(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    robot = BIMANUAL_POSES.at(SIZE)
    for name in ("whole", "stripped"):
        LeRobotWriter(tmp_path / name, robot).write([moving_square(BIMANUAL_POSES, 0)])

    def strip(features: dict[str, Any], table: pa.Table) -> pa.Table:
        features.pop(C2W), features.pop(INTRINSIC)
        return table.drop_columns([C2W, INTRINSIC])

    rewritten(tmp_path / "stripped", strip)  # as LeRobot's tools remove features
    folders = [tmp_path / "stripped", tmp_path / "whole"]
    for chosen in (folders[:1], folders, folders[::-1]):
        cfg = config(*chosen, pose_map_style={})
        spec, store = world_spec(cfg), open_clips(cfg, chosen)
        assert not (spec.pose_map or spec.ray_map or "c2w" in store.arrays) and len(store) == len(chosen)
    assert caplog.text.count("says that cameras ['top', 'left_wrist'] are calibrated") == 1
    assert world_spec(config(folders[1])).pose_map
    with pytest.raises(ConfigError, match="need a calibrated camera"):
        world_spec(config(folders[0], pose_map=True))


def test_a_gpu_that_is_not_there_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert device_of({"launch": {"device": "auto"}}).type == "cpu"
    with pytest.raises(ConfigError, match=r"launch\.device=cuda"):
        device_of({"launch": {"device": "cuda"}})


def test_processes_are_prepared_alike() -> None:
    drawn = []
    for _ in range(2):
        prepare_process(5, 1)
        drawn.append(torch.rand(3).tolist())
    assert drawn[0] == drawn[1] and torch.get_num_threads() == 1


def test_arithmetic_is_the_same_on_any_number_of_cores() -> None:
    known, made = os.sched_getaffinity(0), []
    try:
        for cores in (known, {min(known)}):
            os.sched_setaffinity(0, cores)
            prepare_process(0, composed([])["threads"])
            layers = nn.Sequential(nn.Conv2d(3, 8, 3), nn.GroupNorm(2, 8), nn.Flatten(), nn.Linear(7200, 8))
            optimiser = torch.optim.Adam(layers.parameters())
            for _ in range(3):
                optimiser.zero_grad()
                layers(torch.randn(64, 3, 32, 32)).square().mean().backward()
                optimiser.step()
            made.append(torch.cat([weight.detach().flatten() for weight in layers.parameters()]))
    finally:
        os.sched_setaffinity(0, known)
    assert torch.equal(*made)


def test_gradients_of_indexing_are_the_same_every_time() -> None:
    prepare_process(0, 0)
    table, place = torch.randn(64, 32, requires_grad=True), torch.randint(64, (20000,))
    weight = torch.randn(20000, 32)
    once, *again = [torch.autograd.grad((table[place] * weight).sum(), table)[0] for _ in range(20)]
    assert all(torch.equal(once, other) for other in again)


@pytest.mark.parametrize("make", [build_pool, lambda cfg: build_physics(cfg, 1)])
def test_recordings_are_no_physics(make: Callable[[Any], Any]) -> None:
    with pytest.raises(ConfigError, match=r"task\.suite is empty: .*; choose a task with a suite"):
        make(composed(["task=lerobot", "task.data=[anywhere]"]))
