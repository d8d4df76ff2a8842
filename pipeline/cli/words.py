"""What the commands share: overrides, the run's folder, and a process made ready for work."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from envs.targets import ConfigError

Words = list[str]


def without_given(base: Sequence[str], words: Sequence[str]) -> list[str]:
    """Those overrides of `base` whose keys the words do not set themselves."""
    given = {word.split("=")[0] for word in words}
    return [word for word in base if word.split("=")[0] not in given]


def listed(value: str) -> list[str]:
    """The names in a word's value, such as [a,b] or a."""
    return [name.strip() for name in value.strip("[]").split(",") if name.strip()]


def counts_of(words: Words, own: Mapping[str, int]) -> tuple[dict[str, int], Words]:
    """A command's own numbers, as said or as in `own`, and the other words.

    Raises:
        ConfigError: at one that is no whole number above 0.
    """
    found, rest = dict(own), []
    for word in words:
        key, _, value = word.partition("=")
        if key not in own:
            rest.append(word)
        elif not value.isdigit() or not int(value):
            raise ConfigError(f"{word}: say a whole number above 0")
        else:
            found[key] = int(value)
    return found, rest


def root_of(cfg: Mapping[str, Any]) -> Path:
    """The run's folder."""
    return Path(cfg["runs"]) / cfg["name"]


def prepared(words: Words) -> tuple[dict[str, Any], Path]:
    """The config and the run's folder, with this process made ready for work."""
    from pipeline.config import load_config

    cfg = load_config(words)
    # a mistake in the words is told before these load torch
    from actors.process import device_of, prepare_process
    from actors.world_config import check_world

    device_of(cfg)  # what is not there is told before any work
    check_world(cfg)
    prepare_process(cfg["seed"], cfg["threads"])
    return cfg, root_of(cfg)
