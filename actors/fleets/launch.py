"""From a recipe and configs/launch to a running fleet."""

from __future__ import annotations

import os
import uuid
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch

from actors.fleets.fleet import Fleet, LocalFleet, Patience
from actors.rollouts.recipe import Recipe, build_host
from envs.targets import ConfigError, options


def check_launch(launch: Mapping[str, Any]) -> None:
    """See before any work that the cluster lets us in and can hold the plan; the first stage that needs it
    may come hours later. Nobody stays connected until then.

    Raises:
        ConfigError: naming what cannot be reached, or the role that finds no place.
    """
    if launch["backend"] != "ray":
        return
    # Ray takes seconds to import, which a local run need not spend.
    import ray

    from actors.fleets.cluster import Plan, connect

    if launch["address"] == "local":
        here = {"CPU": float(launch["cpus"] or os.cpu_count() or 1), "GPU": float(torch.cuda.device_count())}
        Plan.of(launch).check([here])
        return
    connected = ray.is_initialized()
    try:
        Plan.of(launch).check(connect(launch))
    finally:
        if not connected:
            ray.shutdown()


def build_fleet(recipe: Recipe) -> Fleet:
    """The fleet of launch.backend: one host in this process, or Ray actors.

    Raises:
        ConfigError: if the backend is unknown or the plan cannot be scheduled.
    """
    launch = recipe.config["launch"]
    if launch["backend"] == "local":
        return LocalFleet(build_host(recipe))
    if launch["backend"] != "ray":
        raise ConfigError(
            f"launch.backend={launch['backend']!r} is unknown; choose launch=local or launch=ray"
        )
    # Ray takes seconds to import, which a local run need not spend.
    from actors.fleets.cluster import Plan, connect
    from actors.fleets.ray_fleet import RayFleet
    from actors.serving.judge_service import ServiceConfig, start_service

    plan = Plan.of(launch)
    nodes = connect(launch)
    plan.check(nodes)
    missing = recipe.missing()
    if missing:
        raise ConfigError(f"{missing} do not exist; run the stages that make them")
    attached: tuple[Any, ...] = ()
    if launch["judge_service"] and recipe.judge:
        name = f"judge-{uuid.uuid4().hex[:8]}"
        settings = options(ServiceConfig, launch["service"], "launch.service")
        attached = (
            start_service(
                name,
                recipe.config,
                recipe.judge,
                settings,
                plan.options("judge"),
                recipe.config["rl"]["threads"],
            ),
        )
        recipe = replace(recipe, service=name)
    return RayFleet(
        recipe,
        launch["actors"],
        plan.options("actors"),
        options(Patience, launch["patience"], "launch.patience"),
        attached,
    )
