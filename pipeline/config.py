"""Composes the Hydra config from configs/ and the command line, and turns mistakes into sentences."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from actors.factory import ConfigError

CONFIGS = Path(__file__).resolve().parent.parent / "configs"


def load_config(overrides: Sequence[str]) -> dict[str, Any]:
    """The resolved config as plain containers.

    Args:
        overrides: Hydra overrides, such as experiment=smoke rl.lr=1e-4.

    Raises:
        ConfigError: for unknown keys or choices, naming the nearest fix.
    """
    try:
        with initialize_config_dir(str(CONFIGS), version_base="1.3"):
            cfg = compose("config", list(overrides))
        plain = OmegaConf.to_container(cfg, resolve=True)
    except (HydraException, OmegaConfBaseException) as error:
        text = str(error).split("\nSee https")[0].split("\nfull_key")[0]
        choices = ", ".join(
            sorted(p.name for p in CONFIGS.iterdir() if p.is_dir() and not p.name.startswith("_"))
        )
        raise ConfigError(
            f"{text}\nGroups are {choices}; `worldloop config` prints every key with its value."
        ) from error
    assert isinstance(plain, dict)
    cfg_plain: dict[str, Any] = {str(key): value for key, value in plain.items()}
    _check(cfg_plain)
    return cfg_plain


def _check(cfg: dict[str, Any]) -> None:
    """Refuse what can be seen to fail before anything starts."""
    task = cfg["task"]
    if task["horizon"] % task["chunk"]:
        raise ConfigError(f"task.horizon={task['horizon']} must be a multiple of task.chunk={task['chunk']}")
    if task["mode"] not in ("relative", "absolute"):
        raise ConfigError(f"task.mode={task['mode']!r} must be relative or absolute")
    if any(side % 16 for side in task["size"]):
        raise ConfigError(f"task.size={task['size']} must be multiples of 16 in both directions")
    if abs(sum(cfg["collect"]["mix"].values()) - 1) > 1e-6:
        raise ConfigError(f"collect.mix={cfg['collect']['mix']} must add up to 1")
    if cfg["rounds"]["count"] < 1:
        raise ConfigError("rounds.count must be at least 1")
    for key in ("deploy", "iterations"):
        if not cfg["rounds"][key]:
            raise ConfigError(f"rounds.{key} must hold at least one number")
