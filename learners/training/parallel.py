"""Training in one process or in many, with the same code and, up to rounding, the same result.

Every worker runs the same stage with the same seeds. A batch is cut into microbatches, each with its own
generator; a worker takes its share of them, and FSDP2 (torch.distributed.fsdp.fully_shard; Zhao et al. 2023)
keeps parameters, gradients and optimiser state in shards, gathers what a forward pass needs and averages
gradients. So results depend on the number of microbatches, not on who computes them. Worker processes are
started by pipeline/graph/workers.py.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any, TypeVar

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.distributed.device_mesh import init_device_mesh
from torch.distributed.fsdp import fully_shard
from torch.distributed.tensor import DTensor

T = TypeVar("T")

# Parameters from which on a block of a module list is gathered by itself, with the lists inside it; below, a
# round of messages costs more than the memory it saves.
BLOCK = 500_000


def workers() -> int:
    """Processes that train together."""
    return dist.get_world_size() if dist.is_available() and dist.is_initialized() else 1


def rank() -> int:
    """Which of them this is."""
    return dist.get_rank() if workers() > 1 else 0


def leads() -> bool:
    """Whether this process writes files and shows progress."""
    return rank() == 0


def my_share(parts: int) -> range:
    """The microbatches of this worker.

    Raises:
        ValueError: if they cannot be shared out evenly.
    """
    if parts % workers():
        raise ValueError(f"microbatches={parts} must be a multiple of launch.learners={workers()}")
    return range(rank(), parts, workers())


def from_leader(make: Callable[[], T]) -> T:
    """What the leading worker makes, for all; its error, too."""
    if workers() == 1:
        return make()
    box: list[Any] = [None, None]
    error: Exception | None = None
    if leads():
        try:
            box[0] = make()
        except Exception as raised:
            error, box[1] = raised, f"{type(raised).__name__}: {raised}"
    dist.broadcast_object_list(box, src=0)
    if error is not None:
        raise error
    if box[1] is not None:
        raise RuntimeError(f"the leading worker failed: {box[1]}")
    return box[0]  # type: ignore[no-any-return]


def averaged(rows: Iterable[Mapping[str, float]]) -> dict[str, float]:
    """Figures of all microbatches of all workers, averaged; every row has the same names."""
    mine = [dict(row) for row in rows]
    names = sorted(mine[0])
    if len(mine) == workers() == 1:
        return mine[0]
    values = torch.tensor([[row[name] for name in names] for row in mine], dtype=torch.float64).mean(0)
    if workers() > 1:
        values = values.to(_device())
        dist.all_reduce(values)
        values = values.cpu() / workers()
    return dict(zip(names, values.tolist(), strict=True))


def _device() -> str:
    return "cuda" if dist.get_backend() == "nccl" else "cpu"


def local(value: Tensor) -> Tensor:
    """This worker's shard of a tensor, or all of it."""
    return value.to_local() if isinstance(value, DTensor) else value


def whole(value: Tensor) -> Tensor:
    """All of a tensor; every worker must ask."""
    return value.full_tensor() if isinstance(value, DTensor) else value


class _Scope(nn.Module):
    """Runs functions while the module's parameters are gathered: FSDP2 gathers around forward passes, and
    losses here are functions of their own.
    """

    def __init__(self, module: nn.Module):
        super().__init__()
        self.module = module

    def forward(self, function: Callable[..., T], *arguments: Any) -> T:
        return function(*arguments)


class _Block(nn.Module):
    """Stands around a block that is gathered by itself, so that the block comes out of training as it went
    in. The block's methods are its own, and run while it is gathered.
    """

    def __init__(self, block: nn.Module):
        super().__init__()
        self.block = block

    def forward(self, *arguments: Any, method: str = "__call__", **named: Any) -> Any:
        return getattr(self.block, method)(*arguments, **named)

    def __getattr__(self, name: str) -> Any:
        if name != "block" and callable(getattr(type(self.block), name, None)):
            return partial(self, method=name)
        return super().__getattr__(name)


class Trainee:
    """A module in training: as it is in one process, in shards over many.

    Calling it with a function and arguments runs that function with whole parameters.

    Args:
        module: all of whose parameters belong to the training, frozen ones included.
        apart: whether large blocks are gathered one by one, each as it or a method of it runs. Functions
            that ask a block for anything else, such as its weights, want all of them whole.
    """

    def __init__(self, module: nn.Module, apart: bool = True):
        self.module, self.apart = module, apart
        self._homes: dict[str, list[tuple[nn.Module, str]]] = {}
        names: dict[int, str] = {}
        for prefix, owner in module.named_modules():
            for attribute, parameter in owner.named_parameters(recurse=False):
                name = names.setdefault(id(parameter), f"{prefix}.{attribute}" if prefix else attribute)
                self._homes.setdefault(name, []).append((owner, attribute))
        self._strides = {name: value.stride() for name, value in self.parameters.items()}
        self._wrapped: list[tuple[nn.ModuleList, int, nn.Module]] = []
        self._scope = _Scope(module)
        if workers() > 1:
            self._shard()

    def _shard(self) -> None:
        mesh = init_device_mesh(_device(), (workers(),))
        for parameter in self.module.parameters():  # FSDP2 takes no other layout, such as channels_last
            parameter.data = parameter.data.contiguous()
        inside = set[nn.Module]()  # of a block; FSDP2 takes no parameter into two groups
        for blocks in [m for m in self.module.modules() if self.apart and isinstance(m, nn.ModuleList)]:
            for number, block in enumerate(blocks):
                if blocks not in inside and sum(p.numel() for p in block.parameters()) >= BLOCK:
                    inside.update(block.modules())
                    self._wrapped.append((blocks, number, block))
                    blocks[number] = _Block(block)
                    fully_shard(blocks[number], mesh=mesh, reshard_after_forward=True)
        fully_shard(self._scope, mesh=mesh, reshard_after_forward=True)

    def __call__(self, function: Callable[..., T], *arguments: Any) -> T:
        return self._scope(function, *arguments)  # type: ignore[no-any-return]

    @property
    def parameters(self) -> dict[str, nn.Parameter]:
        """All parameters by the names they have in the module, as they lie here: whole or in shards."""
        return {name: getattr(*homes[0]) for name, homes in self._homes.items()}

    @property
    def trained(self) -> dict[str, nn.Parameter]:
        """Those that learn."""
        return {name: value for name, value in self.parameters.items() if value.requires_grad}

    def release(self) -> None:
        """Give the module back whole, with ordinary parameters, on every worker."""
        if workers() == 1:
            return
        for name, shard in self.parameters.items():
            value = whole(shard.detach())
            laid = torch.empty_strided(
                value.shape, self._strides[name], dtype=value.dtype, device=value.device
            ).copy_(value)
            parameter = nn.Parameter(laid, requires_grad=shard.requires_grad)
            for owner, attribute in self._homes[name]:
                setattr(owner, attribute, parameter)
        for blocks, number, block in self._wrapped:
            blocks[number] = block


def clip_gradients(parameters: Iterable[nn.Parameter], limit: float) -> float:
    """Scale gradients down to a norm of `limit`; returns the norm they had, over all shards."""
    return float(whole(nn.utils.clip_grad_norm_(list(parameters), limit)))


def twin(values: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Detached copies, sharded as the originals are."""
    return {name: value.detach().clone() for name, value in values.items()}
