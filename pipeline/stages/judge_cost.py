"""What a stage asked its judge for and paid, as part of its result."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any

from envs.files import write_json
from envs.targets import target
from pipeline.graph.stage import Inputs, Result
from pipeline.graph.view import ConfigView

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
        return {**result, "judge_cost": {name: after[name] - before[name] for name in after}}

    return with_cost
