"""Options of a simulator that are free at inference, in all combinations on equal weights and episodes."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from envs.targets import ConfigError, nearest

Settings = Mapping[str, Any]
# Frames generated at a call: nobody acts in a grid, and weights of a world of single frames do not depend on
# it. Weights that do are refused as they are loaded.
_CHUNK = "task.chunk"


def combinations(grid: Mapping[str, Sequence[Any]]) -> Iterator[dict[str, Any]]:
    """Every choice of one value for each dotted key."""
    for values in itertools.product(*grid.values()):
        yield dict(zip(grid, values, strict=True))


def with_settings(cfg: Mapping[str, Any], settings: Settings) -> dict[str, Any]:
    """A config with the values at dotted keys replaced.

    Raises:
        ConfigError: for a key that the config does not have, or other than task.chunk and those of the
            section simulator, whose weights alone stay what they are.
    """
    out = dict(cfg)
    for key, value in settings.items():
        if not key.startswith("simulator.") and key != _CHUNK:
            raise ConfigError(
                f"fidelity.grid.{key}: only options of the simulator, and task.chunk, can be tried on one set"
                " of weights, as in fidelity.grid={simulator.<option>: [...]}"
            )
        section, parts = out, key.split(".")
        for part in parts[:-1]:
            if not isinstance(section.get(part), Mapping):
                raise ConfigError(f"fidelity.grid: {key} is not a key{nearest(part, section)}")
            section[part] = dict(section[part])
            section = section[part]
        if parts[-1] not in section:
            raise ConfigError(f"fidelity.grid: {key} is not a key{nearest(parts[-1], section)}")
        section[parts[-1]] = value
    return out


def optimum(rows: Sequence[Mapping[str, Any]], figure: str) -> int | None:
    """The position of the row with the least value of a figure; None where no row has any."""
    known = [(row[figure], n) for n, row in enumerate(rows) if row.get(figure) is not None]
    return min(known)[1] if known else None


def run_grid(
    grid: Mapping[str, Sequence[Any]], measure: Callable[[Settings], Mapping[str, Any]]
) -> dict[str, Any]:
    """{"keys", "rows", "figure", "best"}: what `measure` says of each combination, with its settings, and the
    position of the best by arm_mse, or by mse where nobody knows the arm.
    """
    rows = [{"settings": settings, **measure(settings)} for settings in combinations(grid)]
    figure = "arm_mse" if any(row.get("arm_mse") is not None for row in rows) else "mse"
    return {"keys": list(grid), "rows": rows, "figure": figure, "best": optimum(rows, figure)}
