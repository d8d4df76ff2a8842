"""What a host is built from, in any process: the resolved config and the paths of weights and data, nothing
live.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from actors.factory import (
    build_judge,
    build_physics,
    build_policy,
    build_simulator,
    build_state_decoder,
    build_world,
    open_clips,
)
from actors.policies.contract import freeze_perception
from actors.process import prepare_process
from actors.rollouts.host import Host
from envs.initial_states import DecisionPoints, InitialStates
from envs.judges.base import Judge
from envs.targets import ConfigError, options


@dataclass(frozen=True)
class Recipe:
    """How to build a Host.

    Args:
        config: the resolved config, plain containers.
        episodes: side by side.
        policy: weights of the policy that RL starts from.
        simulator, decoder, judge: weights of the imagined world; without a simulator it is physics.
        data: data sets in whose episodes imagination begins.
        inside: numbers of the episodes anywhere inside which it begins; none for all first frames.
        first: numbers of the episodes at whose first frames it begins beside those.
        horizon: control steps of an imagined episode; 0 for the task's.
        freeze_perception, bootstrap: see RLConfig and Host.
        later: let rewards arrive after the episode, see JudgeReward.
        service: name of the judge service to ask instead of a judge of its own.
    """

    config: Mapping[str, Any]
    episodes: int
    policy: str
    simulator: str = ""
    decoder: str = ""
    judge: str = ""
    data: tuple[str, ...] = ()
    inside: tuple[int, ...] = ()
    first: tuple[int, ...] = ()
    horizon: int = 0
    freeze_perception: bool = False
    bootstrap: bool = True
    later: bool = False
    service: str = ""

    def plain(self) -> dict[str, Any]:
        """As a dictionary of plain containers, for the wire."""
        return asdict(self)

    def missing(self) -> list[str]:
        """Paths that this machine does not have."""
        return [
            path
            for path in (self.policy, self.simulator, self.decoder, self.judge, *self.data)
            if path and not Path(path).exists()
        ]


def build_host(recipe: Recipe) -> Host:
    """A host as the recipe says.

    Raises:
        ConfigError: if weights or data are missing here.
    """
    if recipe.missing():
        raise ConfigError(
            f"{recipe.missing()} are not on this machine; on a cluster, let `runs` be a folder that all nodes"
            " share"
        )
    cfg, threads = recipe.config, recipe.config["rl"]["threads"]
    policy = build_policy(cfg, Path(recipe.policy))
    if recipe.freeze_perception:
        freeze_perception(policy)
    if not recipe.simulator:
        return Host(build_physics(cfg, recipe.episodes), policy, recipe.bootstrap, threads)
    simulator = build_simulator(cfg, Path(recipe.simulator))
    decoder = build_state_decoder(cfg, simulator, Path(recipe.decoder))
    if recipe.service:
        # Ray takes seconds to import, which a local run need not spend
        from actors.serving.judge_service import JudgeClient, ServiceConfig

        judge: Judge = JudgeClient(
            recipe.service, options(ServiceConfig, cfg["launch"]["service"], "launch.service")
        )
    else:
        judge = build_judge(cfg, Path(recipe.judge))
    store = open_clips(cfg, [Path(folder) for folder in recipe.data])
    starts = InitialStates.of(store)
    if recipe.inside:
        first = torch.tensor(recipe.first, dtype=torch.int64)
        starts = DecisionPoints(store, torch.tensor(recipe.inside), first)
    world = build_world(
        cfg, simulator, decoder, judge, starts, recipe.episodes, recipe.later, recipe.horizon or None
    )
    return Host(world, policy, recipe.bootstrap, threads)


def build_host_process(plain: Mapping[str, Any]) -> Host:
    """build_host in a process of its own, from the wire's form of a recipe."""
    recipe = Recipe(**{**plain, **{name: tuple(plain[name]) for name in ("data", "inside", "first")}})
    prepare_process(0, recipe.config["rl"]["threads"])
    return build_host(recipe)
