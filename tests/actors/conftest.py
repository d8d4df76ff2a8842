"""An imagined world on disk, for hosts to be built from, and a served one."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from actors.rollouts.recipe import Recipe
from envs.conditioning.joint_commands import JointCommands
from envs.geometry.kinematics import Kinematics
from envs.simulators.dit.engine import DiTSimulator
from pipeline.commands.demo_world import demo_recipe
from pipeline.config import load_config
from tests.actors.serving import Running, make, tiny_world
from tests.arms import two_arms
from tests.embodiments import BIMANUAL_POSES


@pytest.fixture(scope="session")
def cfg() -> dict[str, Any]:
    """The smoke experiment on Ray, on more CPUs than there may be."""
    return load_config(["experiment=smoke", "launch=ray", "launch.cpus=8", "launch.object_store_mb=200"])


@pytest.fixture(scope="session")
def recipe(cfg: dict[str, Any], tmp_path_factory: pytest.TempPathFactory) -> Recipe:
    """An imagined world of untrained networks: what it shows is poor, but it shows the same to everybody."""
    return demo_recipe(cfg, tmp_path_factory.mktemp("world"), 4, starts=8)


@pytest.fixture(scope="module")
def world() -> DiTSimulator:
    return tiny_world()


@pytest.fixture(scope="module")
def joints(tmp_path_factory: pytest.TempPathFactory) -> JointCommands:
    robot = two_arms(tmp_path_factory.mktemp("robot"))
    return JointCommands(BIMANUAL_POSES, Kinematics(robot))


@pytest.fixture
def server(world: DiTSimulator, joints: JointCommands) -> Iterator[Running]:
    running = make(world, joints)
    yield running
    running.stop()
