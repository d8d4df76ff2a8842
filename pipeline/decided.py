"""What `auto` in a config comes to, which other parts of the config decide."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from typing import Any

from envs.targets import ConfigError, target

AUTO = "auto"
_GOING_ON = {"lr": 1e-4, "optimiser": "adamw", "batch": 8}  # of weights that know much already


def decided(cfg: dict[str, Any]) -> dict[str, Any]:
    """A resolved config without `auto` where something else decides: rl.freeze_perception, which the policy's
    class may not be able to do, and how `finetune` learns, which is another thing from nothing than from
    weights. What is no section stays as it is, for `checks.faults` to tell.
    """
    return _fine_tuning(_perception(cfg))


def _perception(cfg: dict[str, Any]) -> dict[str, Any]:
    rl = cfg.get("rl")
    if not isinstance(rl, Mapping) or rl.get("freeze_perception") != AUTO:
        return cfg
    able = False
    with suppress(ConfigError, AttributeError):
        able = hasattr(target(cfg["policy"], "policy"), "freeze_perception")
    return {**cfg, "rl": {**rl, "freeze_perception": able}}


def _fine_tuning(cfg: dict[str, Any]) -> dict[str, Any]:
    with suppress(KeyError, TypeError, AttributeError):
        section, simulator = cfg["finetune"], cfg["simulator"]
        known = section["weights"] or simulator.get("checkpoint")
        taught = (simulator.get("state_expert") or {}).get("checkpoint")
        fits = {
            "simulator": _GOING_ON if known else cfg["simulator_fit"]["first"]["fit"],
            "state": _GOING_ON if taught else cfg["state_fit"]["first"]["fit"],
        }
        parts = {name: {**section[name], "fit": _filled(section[name]["fit"], fits[name])} for name in fits}
        return {**cfg, "finetune": {**section, **parts}}
    return cfg


def _filled(fit: Mapping[str, Any], like: Mapping[str, Any]) -> dict[str, Any]:
    """Options of a fit, those that are `auto` as another has them, or as FitConfig has where that says
    nothing.
    """
    return {key: like.get(key, _GOING_ON.get(key)) if value == AUTO else value for key, value in fit.items()}
