"""Two processes that train together, started as the cluster starts them but on one machine."""

from __future__ import annotations

import json
from collections.abc import Callable
from datetime import timedelta
from pathlib import Path
from typing import Any

import torch.distributed as dist
import torch.multiprocessing as mp
from torch import nn

from learners.training import parallel

Work = Callable[..., Any]
_PATIENCE = timedelta(minutes=3)  # of a worker that waits for another


def two(work: Work, folder: Path, *given: Any, limit: int = parallel.BLOCK) -> list[Any]:
    """What two workers say.

    Args:
        work: (folder, *given) -> figures, as JSON knows them; nothing of who was stopped.
        limit: parameters from which on a block is gathered by itself.
    """
    folder.mkdir(exist_ok=True)
    rendezvous = folder / "rendezvous"
    rendezvous.unlink(missing_ok=True)
    mp.spawn(_worker, (str(rendezvous), str(folder), limit, work, given), nprocs=2)
    return [json.loads(path.read_text()) for path in sorted(folder.glob("values-*.json"))]


def gathered(folder: Path) -> set[str]:
    """Classes of the blocks that the workers of a folder gathered by themselves."""
    return set(json.loads((folder / "gathered.json").read_text()))


def _worker(rank: int, rendezvous: str, folder: str, limit: int, work: Work, given: tuple[Any, ...]) -> None:
    names = set()

    class Noted(parallel._Block):
        def __init__(self, block: nn.Module):
            super().__init__(block)
            names.add(type(block).__name__)

    parallel.BLOCK, parallel._Block = limit, Noted  # type: ignore[misc]
    dist.init_process_group(
        "gloo", init_method=f"file://{rendezvous}", rank=rank, world_size=2, timeout=_PATIENCE
    )
    values = work(Path(folder), *given)
    if values:
        (Path(folder) / f"values-{rank}.json").write_text(json.dumps(values))
    if rank == 0:
        (Path(folder) / "gathered.json").write_text(json.dumps(sorted(names)))
    dist.destroy_process_group()
