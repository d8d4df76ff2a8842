"""Builds the algorithm that the config names."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from actors.factory import ConfigError, options
from actors.policies.vla import ChunkPolicy
from learners.rl.algorithm import Algorithm
from learners.rl.filtered_bc import FilteredBC, FilteredBCConfig
from learners.rl.grpo import GRPO, GRPOConfig
from learners.rl.ppo import PPO, PPOConfig


def build_algorithm(cfg: Mapping[str, Any], policy: ChunkPolicy) -> Algorithm:
    """The algorithm of algorithm.name around a policy."""
    section = dict(cfg["algorithm"])
    name = section.pop("name")
    if name == "ppo":
        return PPO(policy, options(PPOConfig, section, "algorithm"))
    if name == "grpo":
        return GRPO(policy, options(GRPOConfig, section, "algorithm"))
    if name == "filtered_bc":
        return FilteredBC(policy, options(FilteredBCConfig, section, "algorithm"))
    raise ConfigError(f"algorithm.name={name!r} is unknown; choose ppo, grpo or filtered_bc")
