"""Checkpoints as folders of torch.distributed.checkpoint: written by any number of workers, read by any other
number.

A checkpoint is written beside its predecessor and renamed when it is whole, so a process killed at any
moment, or a
full disk, leaves the last good one.
"""

from __future__ import annotations

import json
import os
import shutil
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist
import torch.distributed.checkpoint as dcp
from torch import Tensor, nn
from torch.distributed.checkpoint.api import CheckpointException

from learners.training.parallel import leads, workers


class Checkpoints:
    """The newest checkpoint of a run.

    Args:
        folder: of the run; all workers must see it.
    """

    def __init__(self, folder: Path):
        self.folder = folder

    @property
    def newest(self) -> Path | None:
        """The folder of the newest whole checkpoint."""
        return max(self.folder.glob("checkpoint-*"), default=None)

    def facts(self) -> dict[str, Any] | None:
        """What was saved besides tensors; None if there is no checkpoint."""
        return None if self.newest is None else dict(json.loads((self.newest / "facts.json").read_text()))

    def save(self, step: int, tensors: Mapping[str, Any], facts: Mapping[str, Any]) -> None:
        """Write a checkpoint and remove its predecessors.

        Args:
            step: names it; later ones are greater.
            tensors: by name, nested as one likes; shards are written by the workers that hold them.
            facts: what JSON can hold.

        Raises:
            OSError: if it cannot be written, a full disk for example; the predecessor is kept.
        """
        part, final = self.folder / ".checkpoint.part", self.folder / f"checkpoint-{step:09d}"
        if leads():
            shutil.rmtree(part, ignore_errors=True)
        _wait()
        try:
            with warnings.catch_warnings():
                # as it is meant to be
                warnings.filterwarnings("ignore", message="torch.distributed is disabled")
                dcp.save(dict(tensors), checkpoint_id=part, no_dist=workers() == 1)
            if leads():
                (part / "facts.json").write_text(json.dumps(dict(facts)))
        except (OSError, RuntimeError, CheckpointException) as error:
            shutil.rmtree(part, ignore_errors=True)
            raise OSError(
                f"cannot write {final}: {str(error).splitlines()[0]}; free disk space and start again, finished work is kept"
            ) from error
        if leads():
            older = list(self.folder.glob("checkpoint-*"))
            if final in older:  # of a run that was resumed from an earlier one
                shutil.rmtree(final)
            os.replace(part, final)
            for path in older:
                if path != final:
                    shutil.rmtree(path)
        _wait()

    def load(self, tensors: Mapping[str, Any]) -> dict[str, Any] | None:
        """Fill these tensors in place from the newest checkpoint; returns its facts, None if there is none.

        Raises:
            RuntimeError: if it belongs to another architecture.
        """
        path = self.newest
        if path is None:
            return None
        try:
            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", message="torch.distributed is disabled")
                dcp.load(dict(tensors), checkpoint_id=path, no_dist=workers() == 1)
        except (CheckpointException, RuntimeError, ValueError, KeyError) as error:
            last = str(error).strip().splitlines()[-1]
            raise RuntimeError(
                f"{path} belongs to another architecture: {last}. Remove the folder or restore the config."
            ) from error
        return self.facts()

    def clear(self) -> None:
        """Remove all, once the run has ended and what it made is kept elsewhere."""
        _wait()
        if leads():
            for path in self.folder.glob("checkpoint-*"):
                shutil.rmtree(path)


def _wait() -> None:
    if workers() > 1:
        dist.barrier()


def buffers_of(module: nn.Module) -> dict[str, Tensor]:
    """The buffers that belong to a module's state, by name."""
    parameters = {name for name, _ in module.named_parameters(remove_duplicate=False)}
    return {
        name: value for name, value in module.state_dict(keep_vars=True).items() if name not in parameters
    }


def adam_moments(
    optimiser: torch.optim.Optimizer, parameters: Mapping[str, nn.Parameter]
) -> dict[str, dict[str, Tensor]]:
    """The state of an Adam by the parameters' names, zero where it has not begun; what is filled in there is
    what it goes on with.
    """
    out = {}
    for name, parameter in parameters.items():
        if parameter.requires_grad:
            state = optimiser.state[parameter]
            if not state:
                fused = optimiser.defaults.get("fused")
                state["step"] = torch.zeros(
                    (), dtype=torch.float32, device=parameter.device if fused else "cpu"
                )
                state["exp_avg"], state["exp_avg_sq"] = (
                    torch.zeros_like(parameter),
                    torch.zeros_like(parameter),
                )
            out[name] = dict(state)
    return out


def truncate_log(log: Path, step: int) -> None:
    """Drop log rows of steps that will be run again, and the half-written one that a killed process leaves."""
    if log.exists():
        lines = log.read_text()
        rows = [
            line for line in lines[: lines.rfind("\n") + 1].splitlines() if json.loads(line)["step"] < step
        ]
        log.write_text("".join(row + "\n" for row in rows))
