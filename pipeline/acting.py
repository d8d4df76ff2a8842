"""Which world policies act in: the one that the section simulator describes, or its few-step student.

A student is a simulator by config, of the same class with other sampling and its own weights.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from envs.targets import ConfigError, target

Cfg = Mapping[str, Any]
_SAMPLING = ("sampler", "kind", "steps")  # of the sections denoising (dit, forcing) and sampling (gesim)


def acting(cfg: Cfg) -> Cfg:
    """The config of the world that is acted in: the student's, if there is one (distill.steps > 0).

    Raises:
        ConfigError: if no such student can be made of the simulator, or it is conditioned otherwise.
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
    check_alike(section, own)
    return {**cfg, "simulator": own}


def check_alike(teacher: Mapping[str, Any], student: Mapping[str, Any]) -> None:
    """See that two sections simulator differ in how they sample alone.

    Raises:
        ConfigError: naming the other keys in which they do.
    """
    one, other = ({key: value for key, value in _leaves(each, "simulator")} for each in (teacher, student))
    odd = [
        f"{key}: {one.get(key)!r} and {other.get(key)!r}"
        for key in dict.fromkeys([*one, *other])
        if key.rpartition(".")[2] not in _SAMPLING and one.get(key) != other.get(key)
    ]
    if odd:
        raise ConfigError(
            f"teacher and student are conditioned differently: {'; '.join(odd)}; student_section of"
            f" {teacher['_target_']} may change {', '.join(_SAMPLING)} alone"
        )


def _leaves(section: Mapping[str, Any], path: str) -> Iterator[tuple[str, Any]]:
    """Options by their dotted keys."""
    for key, value in section.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{path}.{key}")
        else:
            yield f"{path}.{key}", value
