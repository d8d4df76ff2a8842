"""Weights from a file into a part, strictly."""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import nn

from envs.manifest import check_part
from envs.targets import ConfigError

T = TypeVar("T")


def load(module: T, weights: Path | None) -> T:
    """Load safetensors weights strictly.

    Raises:
        ConfigError: if the file is missing or of another architecture, naming the first differences.
        DamagedArtefact: if it is part of a finished stage and has changed since.
    """
    if weights is None:
        return module
    assert isinstance(module, nn.Module)
    if not weights.exists():
        raise ConfigError(f"{weights} does not exist; run the stage that makes it")
    check_part(weights.resolve())
    try:
        found, wanted = load_file(weights), module.state_dict()
    except SafetensorError as error:
        raise ConfigError(f"{weights} cannot be read: {error}; restore the file") from error
    wrong = [
        f"{k}: file {tuple(found[k].shape)}, model {tuple(wanted[k].shape)}"
        for k in found.keys() & wanted.keys()
        if found[k].shape != wanted[k].shape
    ]
    missing, extra = sorted(wanted.keys() - found.keys()), sorted(found.keys() - wanted.keys())
    if wrong or missing or extra:
        raise ConfigError(
            f"{weights} is of another architecture or robot: missing {missing[:4]}, unexpected {extra[:4]},"
            f" differing {wrong[:4]}. Use the config it was trained with (config.yaml beside it)."
        )
    module.load_state_dict({name: value.to(wanted[name].dtype) for name, value in found.items()})
    return module  # type: ignore[return-value]
