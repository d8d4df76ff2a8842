"""Sections of configs/ for tests that build one part of a world."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

CONFIGS = Path(__file__).resolve().parent.parent / "configs"


def offered(group: str) -> list[str]:
    """Names of all choices of a config group."""
    return sorted(path.stem for path in (CONFIGS / group).glob("*.yaml"))


def section(choice: str, mode: str = "relative", root: Path = CONFIGS, **changes: Any) -> dict[str, Any]:
    """A choice such as "policy/chunk_gaussian" as plain containers, with keys changed.

    Args:
        mode: stands for ${task.mode}; ${cameras} is all.
        root: of the configs.
        changes: values for keys of the section; of nested sections, dictionaries of what differs there.
    """
    text = (root / f"{choice}.yaml").read_text().replace("${task.mode}", mode)
    loaded = yaml.safe_load(text.replace("${cameras}", "all"))
    group = choice.rpartition("/")[0]
    for base in loaded.pop("defaults", []):
        if base != "_self_":
            loaded = merged(section(f"{group}/{base}", mode, root), loaded)
    return merged(loaded, changes)


def merged(old: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """A section with some values changed, at any depth."""
    out = dict(old)
    for key, value in changes.items():
        nested = isinstance(value, dict) and isinstance(out.get(key), dict)
        out[key] = merged(out[key], value) if nested else value
    return out
