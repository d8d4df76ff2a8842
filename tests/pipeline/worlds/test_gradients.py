"""worldloop gradients measures what the stage `rl` would learn from, and learns nothing."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from envs.targets import ConfigError
from pipeline.commands.worlds.gradients import (
    LAMS,
    Found,
    gradients,
    measured,
    rows_by_lambda,
    rows_by_task,
    tables,
)
from pipeline.config import load_config
from pipeline.graph.kept import Tensors
from tests.beginning import anew, begun


def said(found: Found, batches: int) -> str:
    return tables(rows_by_lambda(found), rows_by_task(found), found, batches)


def test_imagined_and_recorded_decisions_by_lambda_and_task(tmp_path: Path) -> None:
    cfg, ready = begun(tmp_path)
    before = {name: value.clone() for name, value in ready.policy.state_dict().items()}
    found = measured(cfg, ready, 3, anew)
    assert list(found.by_lambda) == sorted({*LAMS, found.used})  # type: ignore[type-var]
    decisions = ready.true.decisions
    assert decisions is not None and len(decisions) >= 32
    for mine in found.by_lambda.values():
        assert len(mine.imagined) == 3 and sum(mine.recorded_decisions) == len(decisions)
        assert all(one.isfinite().all() and one.any() for one in (*mine.imagined, *mine.recorded))
    least, most = found.by_lambda[0.0], found.by_lambda[0.95]
    assert not torch.equal(least.imagined[0], most.imagined[0])
    assert not torch.equal(least.recorded[0], most.recorded[0])
    assert [task[-3:] for task in found.by_task] == [", 0", ", 1"]
    whole = found.by_lambda[found.used]
    apart = list(found.by_task.values())
    assert sum(sum(its.imagined_decisions) for its in apart) == sum(whole.imagined_decisions)
    assert (
        32 <= sum(sum(its.recorded_decisions) for its in apart) <= len(decisions)
    )  # single ones are left out
    assert all(torch.equal(value, before[name]) for name, value in ready.policy.state_dict().items())
    text = said(found, 3)
    assert text.count("(in use)") == 1 and "half signal" in text and text.count("| move the square") == 2


@pytest.mark.long
def test_what_is_kept_is_not_taken_again_and_is_the_same_if_it_is(tmp_path: Path) -> None:
    cfg, ready = begun(tmp_path)
    kept: dict[str, Tensors] = {}

    def keep(name: str, about: Mapping[str, Any], make: Callable[[], Tensors]) -> Tensors:
        return kept[name] if name in kept else kept.setdefault(name, make())

    whole = rows_by_lambda(measured(cfg, ready, 3, keep))
    assert list(kept) == ["imagined-0", "imagined-1", "imagined-2", "recorded"]
    before = kept.pop("imagined-1")
    assert rows_by_lambda(measured(cfg, ready, 3, keep)) == whole
    assert before.keys() == kept["imagined-1"].keys()
    assert all(torch.equal(value, kept["imagined-1"][name]) for name, value in before.items())
    assert rows_by_lambda(measured(cfg, replace(ready, recipe=None), 3, keep)) == whole  # type: ignore[arg-type]


def test_an_algorithm_without_lambda_has_one_row(tmp_path: Path) -> None:
    found = measured(*begun(tmp_path, "algorithm=grpo", "algorithm.group=2"), 3, anew)
    assert list(found.by_lambda) == [None] and not found.by_task and not found.by_lambda[None].recorded
    assert "| none (in use) |" in said(found, 3)


class Own:
    """Somebody's algorithm, which has a critic and no lambda."""

    def __init__(self, inner: Any):
        self.inner = inner

    def __getattr__(self, name: str) -> Any:
        if name in ("config", "credit", "value"):
            raise AttributeError(name)
        return getattr(self.inner, name)


@pytest.mark.long
def test_somebody_elses_algorithm_keeps_the_advantages_that_it_gave(tmp_path: Path) -> None:
    cfg, ready = begun(tmp_path)
    found = measured(cfg, replace(ready, algorithm=Own(ready.algorithm)), 3, anew)
    assert list(found.by_lambda) == [None] and len(found.by_lambda[None].recorded) == 16


def test_what_cannot_be_asked_is_told(tmp_path: Path) -> None:
    cfg = load_config(["experiment=soak"])
    with pytest.raises(ConfigError, match="3 of them at least"):
        gradients(cfg, tmp_path, 1, 2)
    with pytest.raises(ConfigError, match=r"not come to round 1 .*first `worldloop run`"):
        gradients(cfg, tmp_path, 1, 4)
