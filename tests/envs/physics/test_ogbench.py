"""OGBench: its oracles succeed on every task, words say what is meant, pictures do not tell success."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import pytest

from envs.physics.suite import build_suite
from envs.targets import ConfigError
from tests.envs.physics.sections import task_section

pytest.importorskip("ogbench", reason="make ogbench installs it")

from envs.physics.ogbench import TASKS, OGBench


@pytest.fixture(scope="module")
def suite() -> OGBench:
    made = built()
    assert isinstance(made, OGBench)
    return made


def built(**changes: Any) -> Any:
    return build_suite(task_section("ogbench", **changes)["suite"])


@pytest.mark.parametrize("task", TASKS)
def test_oracles_succeed(suite: OGBench, task: str) -> None:
    won, words = 0, set()
    for seed in range(4):
        suite.reset(task, 300 + seed)
        words.add(suite.observe().instruction)
        assert suite.observe().progress == 0.0
        expert = suite.expert(0.0, np.random.default_rng(seed))
        for _ in range(56):
            if not suite.observe().success:
                suite.step(expert())
        won += suite.observe().success
    assert won >= 3 and all(len(text.split()) >= 3 for text in words)


def test_words_say_which_way(suite: OGBench) -> None:
    said = set()
    for seed in range(12):
        suite.reset("scene-drawer", seed)
        said.add(suite.observe().instruction)
    assert said == {"open the drawer", "close the drawer"}


@pytest.mark.parametrize("task", ["cube-double", "scene-drawer"])
def test_outer_starts_are_none_of_the_inner_ones(task: str) -> None:
    far = {}
    for starts in ("inner", "outer"):
        suite = built(starts=starts)
        found = []
        for seed in (*range(12), 3):
            suite.reset(task, seed)
            data = suite._env._data
            cubes = [data.joint(f"object_joint_{k}").qpos[:2].copy() for k in range(suite._env._num_cubes)]
            (low, high) = suite._env._object_sampling_bounds
            off = [np.abs(2 * (xy - low) / (high - low) - 1) for xy in cubes]
            if task.startswith("scene"):
                off.append(np.abs(2 * -data.joint("drawer_slide").qpos / 0.16 - 1))
                off.append(np.abs(2 * data.joint("window_slide").qpos / 0.2 - 1))
            found.append(np.concatenate(off).max())
        assert found[3] == found.pop()  # a seed is a start
        far[starts] = found
    assert max(far["inner"]) < 0.82 and min(far["outer"]) > 0.78  # things settle by millimetres


def test_pictures_show_the_mark_but_not_success(suite: OGBench) -> None:
    suite.reset("cube-single", 1)
    env = suite._env
    marks, cubes = env._cube_target_geom_ids_list[0], env._cube_geom_ids_list[0]
    assert (env._model.geom_rgba[marks, 3] > 0).all()
    before = env._model.geom_rgba[cubes].copy()
    expert = suite.expert(0.0, np.random.default_rng(0))
    for _ in range(56):
        if not suite.observe().success:
            suite.step(expert())
    assert suite.observe().success and np.array_equal(env._model.geom_rgba[cubes], before)


def test_pictures_may_be_larger_than_the_package_makes_them() -> None:
    suite = built(size=(256, 320))
    suite.reset("cube-single", 1)
    (picture,) = suite.render()
    assert picture.shape == (3, 256, 320) and picture[:, 230:, 280:].std() < 60  # the floor, not noise


def test_rates_must_divide_that_of_the_simulation() -> None:
    with pytest.raises(ConfigError, match=r"task\.suite\.control_hz=8.0 must divide"):
        built(control_hz=8.0)


def test_a_missing_package_is_named_with_the_line_to_type(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ogbench.manipspace.envs.cube_env", None)
    with pytest.raises(ConfigError, match=r"pip install --no-deps dm_control==1\.0\.41 ogbench==1\.2\.2"):
        built()
