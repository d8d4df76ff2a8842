"""Shared fixtures: material outside the repository, and small data of any robot made once per session."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

# Before torch is imported: small work that is cut in two waits for itself, most of all beside other work.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import pytest
import torch

from envs.embodiment import Embodiment
from envs.episodes import Episode, LeRobotWriter
from envs.episodes.clips import ClipStore
from tests.embodiments import BIMANUAL_POSES, world_spec
from tests.moving_square import SIZE, episodes_of

# Two Rays at once have more processes than there are cores.
WITH_RAY = ("test_ray_fleet", "test_cluster", "test_judge_service", "test_chaos", "test_stage_workers")


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Files stay together in one of the processes of `pytest -n`, and those that start Rays in the same."""
    from xdist.scheduler import LoadScopeScheduling

    class Files(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            file = nodeid.partition("::")[0]
            return "ray" if Path(file).stem in WITH_RAY else file

    config.option.loadscopereorder = False  # the order is that of pytest_collection_modifyitems
    return Files(config, log)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Of several processes none may be left alone with what takes minutes: that begins first."""
    if not hasattr(config, "workerinput"):
        return
    sizes = Counter(item.path for item in items)
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: (item.path.stem not in WITH_RAY, item.path not in slow, -sizes[item.path]))


@pytest.fixture(autouse=True)
def one_thread() -> None:
    """More threads than one end with the test that asked for them: beside other work they wait for long."""
    torch.set_num_threads(1)


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder with real episodes and golden outputs, beside the repository or at $WORLDLOOP_SHARED."""
    path = Path(os.environ.get("WORLDLOOP_SHARED", Path(__file__).resolve().parent.parent.parent / "shared"))
    if not (path / "golden").exists():
        pytest.skip(f"{path} is not here; set WORLDLOOP_SHARED")
    return path


@pytest.fixture(scope="session")
def tiny_data(tmp_path_factory: pytest.TempPathFactory) -> Callable[[Embodiment], Path]:
    """Makes, once for every robot, a LeRobot data set of moving_square.py in two shards."""
    made: dict[Embodiment, Path] = {}

    def data(robot: Embodiment) -> Path:
        if robot not in made:
            root = tmp_path_factory.mktemp("data") / robot.robot
            writer, some = LeRobotWriter(root, robot.at(SIZE)), episodes_of(robot)
            writer.write(some[:10])
            writer.write(some[10:])
            made[robot] = root
        return made[robot]

    return data


@pytest.fixture(scope="session")
def tiny_store(tiny_data: Callable[[Embodiment], Path]) -> Callable[[Embodiment], ClipStore]:
    """Opens the data of `tiny_data` at the size they have, with every conditioning that the robot allows."""

    def store(robot: Embodiment) -> ClipStore:
        return ClipStore([tiny_data(robot)], world_spec(robot.at(SIZE), SIZE))

    return store


@pytest.fixture(scope="session")
def episodes() -> list[Episode]:
    """Twenty short episodes of two arms that command poses; every other one a success."""
    return episodes_of(BIMANUAL_POSES)


@pytest.fixture(scope="session")
def dataset(tiny_data: Callable[[Embodiment], Path]) -> Path:
    """Those episodes as a LeRobot data set of two shards."""
    return tiny_data(BIMANUAL_POSES)


@pytest.fixture(scope="session")
def store(tiny_store: Callable[[Embodiment], ClipStore]) -> ClipStore:
    """The data set behind its cache."""
    return tiny_store(BIMANUAL_POSES)
