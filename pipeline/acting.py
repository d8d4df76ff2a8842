"""Which world policies act in: the one that the section simulator describes, or its few-step student.

A student is a simulator by config, of the same class with other sampling and its own weights.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from envs.targets import ConfigError, target

Cfg = Mapping[str, Any]


def acting(cfg: Cfg) -> Cfg:
    """The config of the world that is acted in: the student's, if there is one (distill.steps > 0).

    Raises:
        ConfigError: if no such student can be made of the simulator.
    """
    steps, section = cfg["distill"]["steps"], cfg["simulator"]
    if not steps:
        return cfg
    try:
        own = target(section, "simulator").student_section(section, steps)  # type: ignore[attr-defined]
    except ConfigError:
        raise
    except ValueError as error:
        raise ConfigError(str(error)) from error
    return {**cfg, "simulator": own}
