"""What a stage, or a command, asked its judge for and paid, as part of its result."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from functools import partial, wraps
from pathlib import Path
from types import TracebackType
from typing import Any

from envs.files import write_json
from envs.targets import target
from pipeline.graph.stage import Inputs, Result
from pipeline.graph.view import ConfigView

COST = "judge_cost.json"  # beside what a command keeps
_BEFORE = ".judge_cost.json"  # what had been spent when the stage was begun, however often it was resumed

Run = Callable[[ConfigView, Path, Inputs], Result]


def priced(run: Run) -> Run:
    """A stage that asks the judge of the config; its result says as "judge_cost" what that has cost.

    Counted is what all processes spent meanwhile under the judge's cache folder, so that hosts elsewhere are
    in it; of runs side by side that share a cache, so are the others.
    """

    @wraps(run)
    def with_cost(cfg: ConfigView, folder: Path, inputs: Inputs) -> Result:
        kind: Any = target(cfg["judge"], "judge")
        path, now = folder / _BEFORE, kind.spent(cfg["judge"])
        if now and not path.exists():
            write_json(path, now)
        result = run(cfg, folder, inputs)
        if not now:
            return result
        before, after = json.loads(path.read_text()), kind.spent(cfg["judge"])
        return {**result, "judge_cost": {name: after[name] - before.get(name, 0.0) for name in after}}

    return with_cost


class Spending:
    """What a command that goes on where it was stopped asks the judge of a section for, in all its lives.

    Args:
        section: judge.
        path: file that holds what its lives before have spent.
    """

    def __init__(self, section: Mapping[str, Any], path: Path):
        kind: Any = target(section, "judge")
        self._spent = partial(kind.spent, section)
        self._path, self._before = path, json.loads(path.read_text()) if path.exists() else {}
        self._began: dict[str, float] = self._spent()

    @property
    def total(self) -> dict[str, float]:
        """So far, by name; {} of a judge that is free."""
        now = self._spent()
        return {name: self._before.get(name, 0.0) + now[name] - self._began.get(name, 0.0) for name in now}

    def __enter__(self) -> Spending:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if total := self.total:
            write_json(self._path, total)
