"""Checkpoints as folders of safetensors and JSON: written by any number of workers, read by any other number.

Nothing in them is code, so a checkpoint from anywhere can be read. A checkpoint is written beside its
predecessor and renamed when it is whole, so a process killed at any moment, or a full disk, leaves the last
good one. Workers that hold shards gather one tensor after the other; the leading one keeps them in main
memory, a file at a time.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn
from torch.distributed.tensor import DTensor, distribute_tensor

from envs.files import atomic, remove, write_text
from envs.manifest import hashes
from learners.training.optimisers import optimiser_state
from learners.training.parallel import leads, whole, workers

_SUMS = "sha256.json"  # of every file beside it


class CheckpointError(RuntimeError):
    """A checkpoint is damaged, or belongs to another architecture; the message names it and the fix."""


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
            tensors: dictionaries of tensors, or of such dictionaries, by name; each becomes a file.
            facts: what JSON can hold.

        Raises:
            OSError: if it cannot be written, a full disk for example; the predecessor is kept.
        """
        final = self.folder / f"checkpoint-{step:09d}"
        _wait()
        if leads():
            # half-written ones are a killed process's
            older = [*self.folder.glob("checkpoint-*"), *self.folder.glob(".checkpoint-*")]
            with atomic(final) as part:
                part.mkdir()
                for name, held in tensors.items():
                    _write(part / f"{name}.safetensors", gathered(held))
                (part / "facts.json").write_text(json.dumps(dict(facts)))
                (part / _SUMS).write_text(json.dumps(hashes(part)))
            for path in older:
                if path != final:
                    remove(path)  # a half-written one of this very step is gone already
        else:
            for held in tensors.values():
                gathered(held)
        _wait()

    def load(self, tensors: Mapping[str, Any]) -> dict[str, Any] | None:
        """Fill these tensors in place from the newest checkpoint; returns its facts, None if there is none.

        Raises:
            CheckpointError: if it belongs to another architecture, or is damaged.
        """
        path = self.newest
        if path is None:
            return None
        _check(path)
        for name, held in tensors.items():
            try:
                _read(path / f"{name}.safetensors", held)
            except (OSError, SafetensorError, ValueError) as error:
                raise CheckpointError(
                    f"{path} belongs to another architecture: {name}: {error}."
                    " Remove the folder or restore the config."
                ) from error
        return self.facts()


def clear_checkpoints(folder: Path) -> None:
    """Remove all checkpoints in and under a folder, once what they led to is kept elsewhere."""
    for path in [*folder.rglob("checkpoint-*"), *folder.rglob(".checkpoint-*")]:
        remove(path)


def _check(path: Path) -> None:
    try:
        sums = json.loads((path / _SUMS).read_text())
    except (OSError, ValueError):
        sums = {}
    found = hashes(path)
    found.pop(_SUMS, None)
    if found != sums:
        odd = sorted(name for name in {_SUMS, *found, *sums} if found.get(name) != sums.get(name))
        raise CheckpointError(
            f"{path} is damaged: {', '.join(odd or [_SUMS])} changed since it was written. Delete the folder:"
            " what it belongs to then begins anew."
        )


def _wait() -> None:
    if workers() > 1:
        dist.barrier()


def _flat(tensors: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Tensor]]:
    """Tensors of nested dictionaries, with names joined by slashes."""
    for name, value in tensors.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{name}/")
        else:
            yield f"{prefix}{name}", value


def gathered(tensors: Mapping[str, Any]) -> dict[str, Tensor]:
    """Whole copies in main memory, by flat names; every worker must ask, only the leading one keeps them."""
    out = {}
    for name, value in _flat(tensors):
        full = whole(value.detach())
        if leads():
            out[name] = full.cpu().contiguous().clone()
    return out


def _write(path: Path, tensors: dict[str, Tensor]) -> None:
    try:
        save_file(tensors, path)
    except SafetensorError as error:  # what it says of a full disk
        raise OSError(None, str(error).splitlines()[0]) from error


def _read(path: Path, tensors: Mapping[str, Any]) -> None:
    """Fill tensors, whole or sharded, from a file that holds exactly these names and shapes."""
    wanted = dict(_flat(tensors))
    with safe_open(path, framework="pt") as file:
        known = set(file.keys())
        odd = sorted(known ^ wanted.keys())
        if odd:
            raise ValueError(f"{odd[0]} is in only one of checkpoint and model")
        for name, value in wanted.items():
            saved = file.get_tensor(name)
            if saved.shape != value.shape or saved.dtype != value.dtype:
                raise ValueError(
                    f"{name} is {saved.dtype} {list(saved.shape)},"
                    f" the model has {value.dtype} {list(value.shape)}"
                )
            _fill(value, saved)


@torch.no_grad()
def _fill(value: Tensor, saved: Tensor) -> None:
    if isinstance(
        value, DTensor
    ):  # every worker read the file, so each takes its own shard without a message
        local = value.to_local()
        shards = distribute_tensor(
            saved.to(local.device), value.device_mesh, value.placements, src_data_rank=None
        )
        local.copy_(shards.to_local())
    else:
        value.copy_(saved)


def buffers_of(module: nn.Module) -> dict[str, Tensor]:
    """The buffers that belong to a module's state, by name."""
    parameters = {name for name, _ in module.named_parameters(remove_duplicate=False)}
    return {
        name: value for name, value in module.state_dict(keep_vars=True).items() if name not in parameters
    }


def adam_moments(
    optimiser: torch.optim.Optimizer, parameters: Mapping[str, nn.Parameter]
) -> dict[str, dict[str, Tensor]]:
    """The state of one Adam by the parameters' names; see optimisers.optimiser_state."""
    return optimiser_state([optimiser], parameters)


def truncate_log(log: Path, step: int) -> None:
    """Drop log rows of steps that will run again, and the half-written one that a killed process leaves."""
    if log.exists():
        lines = log.read_text()
        rows = [
            line for line in lines[: lines.rfind("\n") + 1].splitlines() if json.loads(line)["step"] < step
        ]
        write_text(log, "".join(row + "\n" for row in rows))
