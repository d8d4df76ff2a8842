"""The part of the config that a stage may read; reading anything else is an error, so keys can be trusted."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

# Where and with how many processes a stage runs. Results do not depend on it, so it is never part of a key.
OPEN = ("launch",)


class UndeclaredRead(RuntimeError):
    """A stage read a config key that its `reads` does not name; its artefact's key would not know of it."""


class ConfigView(Mapping[str, Any]):
    """A mapping over the sections of a config that a stage declares.

    Args:
        config: the resolved config, plain containers.
        reads: dotted paths that may be read, whole: "task", "simulator_fit.first".
        stage: name of the stage, for the error.
        prefix: path of this mapping inside the config.

    Raises:
        UndeclaredRead: on reading any other key. It is no KeyError, so `get` and `in` do not hide it.
    """

    def __init__(self, config: Mapping[str, Any], reads: tuple[str, ...], stage: str, prefix: str = ""):
        self._config, self._reads, self._stage, self._prefix = config, reads, stage, prefix

    def __getitem__(self, key: str) -> Any:
        path = f"{self._prefix}{key}"
        allowed = (*self._reads, *OPEN)
        if any(path == read or path.startswith(f"{read}.") for read in allowed):
            return self._config[key]
        if any(read.startswith(f"{path}.") for read in allowed):
            return ConfigView(self._config[key], self._reads, self._stage, f"{path}.")
        raise UndeclaredRead(
            f"stage {self._stage} reads {path}, which its `reads` does not declare: {list(self._reads)};"
            " add it there, or artefacts would not know of its changes"
        )

    def __iter__(self) -> Iterator[str]:
        for key in self._config:
            path = f"{self._prefix}{key}"
            if any(f"{read}.".startswith(f"{path}.") for read in (*self._reads, *OPEN)) or any(
                path.startswith(f"{read}.") for read in self._reads
            ):
                yield key

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def plain(self) -> dict[str, Any]:
        """What may be read, as plain containers, for other processes."""
        out = {}
        for key in self:
            value = self[key]
            out[key] = value.plain() if isinstance(value, ConfigView) else value
        return out


def sections(config: Mapping[str, Any], reads: tuple[str, ...]) -> dict[str, Any]:
    """The values at dotted paths, None where there is none."""
    out = {}
    for path in reads:
        value: Any = config
        for part in path.split("."):
            value = value.get(part) if isinstance(value, Mapping) else None
        out[path] = value
    return out
