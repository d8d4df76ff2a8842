"""A second device for machines that have none: tensors that lie in main memory, say that they do not, and
refuse what a GPU would refuse, operations on tensors of both.

torch's name for it is "meta", the one device that every build of torch knows and nobody uses here. It finds
what was left in main memory; kernels and precision of a real GPU are tests/test_gpu.py's.
"""

from __future__ import annotations

import contextlib
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._pytree import tree_flatten, tree_map

from actors import process
from envs import precision

DEVICE = torch.device("meta")
_aten = torch.ops.aten
_COPIES = {_aten.copy_.default, _aten._to_copy.default}
# Tensors elsewhere may be indexed by some that lie in main memory, as on a GPU.
_INDEXED = {_aten.index.Tensor, _aten.index_put.default, _aten.index_put_.default}
# Made of operations that "meta" has a way of its own for, and of that way's tensors nothing is known.
_WHOLE = ("scaled_dot_product_attention", "interpolate", "grid_sample")


class Elsewhere(Tensor):
    """A tensor on the second device; `inner` is what it holds."""

    inner: Tensor
    __torch_function__ = torch._C._disabled_torch_function_impl  # type: ignore[assignment]

    @staticmethod
    def __new__(cls, inner: Tensor) -> Elsewhere:
        return torch.Tensor._make_wrapper_subclass(  # type: ignore[attr-defined, no-any-return]
            cls, inner.shape, strides=inner.stride(), dtype=inner.dtype, device=DEVICE
        )

    def __init__(self, inner: Tensor):
        self.inner = inner

    @classmethod
    def __torch_dispatch__(
        cls, func: Any, types: Any, args: Any = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        given = dict(kwargs or {})
        here = [t for t in _tensors((args, given)) if t.device.type == "cpu" and t.ndim]
        may = func in _COPIES or (func in _INDEXED and isinstance(args[0], Elsewhere))
        if here and not may:
            raise RuntimeError(
                f"{func} of tensors elsewhere and of {[tuple(t.shape) for t in here]} on the CPU"
            )
        back = given.get("device") is not None and torch.device(given["device"]).type == "cpu"
        if given.get("device") is not None:
            given["device"] = torch.device("cpu")
        out = func(*tree_map(_inner, args), **tree_map(_inner, given))
        if func._schema.name.endswith("_") and isinstance(args[0], Tensor):
            return args[0]  # changed in place
        return out if back else tree_map(_moved, out)


class SecondDevice(TorchFunctionMode):
    """While it is entered, `.to(DEVICE)` and `device=DEVICE` make tensors that are Elsewhere."""

    def __torch_function__(
        self, func: Any, types: Any, args: Any = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        given, name = dict(kwargs or {}), getattr(func, "__name__", "")
        first = args[0] if args else None
        if name == "to" and isinstance(first, Tensor):
            return _to(func, first, args[1:], given)
        if isinstance(first, Elsewhere):
            if name == "cpu":
                return _Back.apply(first)
            if name == "tolist":
                return first.inner.tolist()
            if name == "numpy":
                raise TypeError("can't convert a tensor that is elsewhere to numpy")
            if name == "__setitem__" and not (isinstance(args[2], Tensor) and args[2].ndim):
                first.inner[tree_map(_inner, args[1])] = _inner(args[2])
                return None
        if name == "where" and len(args) == 3:
            return func(first, _beside(first, args[1], args[2]), _beside(first, args[2], args[1]))
        if name in _WHOLE and any(isinstance(t, Elsewhere) for t in _tensors((args, given))):
            return _Whole.apply(partial(_call, func, args, given), *_tensors((args, given)))
        if _is_elsewhere(given.get("device")):
            grad = given.pop("requires_grad", False)
            made = _moved(func(*tree_map(_inner, args), **{**given, "device": "cpu"}))
            return made.requires_grad_() if grad else made
        return func(*args, **given)


class _Move(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor) -> Tensor:
        return Elsewhere(values.detach().clone())

    @staticmethod
    def backward(ctx: Any, *gradients: Any) -> Any:
        return _inner(gradients[0])


class _Back(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Any) -> Tensor:
        return values.inner.detach().clone()  # type: ignore[no-any-return]

    @staticmethod
    def backward(ctx: Any, *gradients: Any) -> Any:
        return Elsewhere(gradients[0])


class _Whole(torch.autograd.Function):
    """A function of tensors that are all elsewhere, as one operation."""

    @staticmethod
    def forward(ctx: Any, function: Callable[..., Tensor], *values: Any) -> Tensor:
        if not all(isinstance(value, Elsewhere) for value in values):
            raise RuntimeError("one function of tensors elsewhere and on the CPU")
        ctx.values = [
            value.inner.detach().requires_grad_(value.inner.is_floating_point()) for value in values
        ]
        with torch.enable_grad():
            ctx.out = function(ctx.values)
        return Elsewhere(ctx.out.detach())

    @staticmethod
    def backward(ctx: Any, *gradients: Any) -> Any:
        wanted = [value for value in ctx.values if value.requires_grad]
        found = iter(torch.autograd.grad(ctx.out, wanted, gradients[0].inner, allow_unused=True))
        each = (next(found) if value.requires_grad else None for value in ctx.values)
        return (None, *(None if gradient is None else Elsewhere(gradient) for gradient in each))


def _call(func: Any, args: Any, kwargs: Any, values: list[Tensor]) -> Tensor:
    """The function with other tensors in the place of its own."""
    given = iter(values)
    plain = tree_map(lambda leaf: next(given) if isinstance(leaf, Tensor) else leaf, (args, kwargs))
    return func(*plain[0], **plain[1])  # type: ignore[no-any-return]


def _to(func: Any, values: Tensor, args: Any, kwargs: dict[str, Any]) -> Tensor:
    other = kwargs.pop("other", args[0] if args and isinstance(args[0], Tensor) else None)
    if other is not None:
        device, dtype = other.device, other.dtype
    else:
        known = {k: v for k, v in kwargs.items() if k in ("device", "dtype", "memory_format")}
        device, dtype, *_ = torch._C._nn._parse_to(*(a for a in args if not isinstance(a, bool)), **known)
    out: Tensor = values
    if _is_elsewhere(device) and not isinstance(values, Elsewhere):
        out = _Move.apply(values)  # type: ignore[no-untyped-call]
    elif device is not None and device.type == "cpu" and isinstance(values, Elsewhere):
        out = _Back.apply(values)  # type: ignore[no-untyped-call]
    elif kwargs.get("copy"):
        out = values.clone()
    return out if dtype in (None, out.dtype) else func(out, dtype)


def _tensors(tree: Any) -> list[Tensor]:
    return [leaf for leaf in tree_flatten(tree)[0] if isinstance(leaf, Tensor)]


def _inner(value: Any) -> Any:
    """What an operation in main memory is given for a value; "meta" makes scalars of its own, without one."""
    if isinstance(value, Elsewhere):
        return value.inner
    lost = isinstance(value, Tensor) and value.device == DEVICE
    return torch.zeros(value.shape, dtype=value.dtype) if lost else value


def _moved(value: Any) -> Any:
    plain = isinstance(value, Tensor) and not isinstance(value, Elsewhere)
    return Elsewhere(_inner(value)) if plain else value


def _beside(condition: Any, value: Any, other: Any) -> Any:
    """A number as a tensor where the condition is."""
    if isinstance(value, Tensor) or not isinstance(condition, Elsewhere):
        return value
    return Elsewhere(torch.tensor(value, dtype=other.dtype if isinstance(other, Tensor) else None))


def _is_elsewhere(device: Any) -> bool:
    return isinstance(device, str | torch.device) and torch.device(device) == DEVICE


@contextlib.contextmanager
def second_device(patch: Any) -> Iterator[None]:
    """Everything that Worldloop puts on launch.device lies elsewhere, whatever the config says.

    Args:
        patch: pytest's monkeypatch.
    """
    asked, mixed = process.device_of, precision.mixed_precision
    for module in list(sys.modules.values()):
        if getattr(module, "device_of", None) is asked:
            patch.setattr(module, "device_of", lambda cfg: DEVICE)
        if getattr(module, "mixed_precision", None) is mixed:  # which "meta" has not
            patch.setattr(module, "mixed_precision", lambda *_: contextlib.nullcontext())
    for kind in (torch.optim.Adam, torch.optim.AdamW):
        patch.setattr(kind, "__init__", _unfused(kind.__init__))
    begin = threading.Thread.run

    def run(thread: threading.Thread) -> None:
        with SecondDevice():  # a mode is a thread's own
            begin(thread)

    patch.setattr(threading.Thread, "run", run)
    with SecondDevice():
        yield


def _unfused(begin: Any) -> Any:
    """An optimiser's __init__, without kernels that "meta" has not."""

    def plain(optimiser: Any, *args: Any, **kwargs: Any) -> None:
        begin(optimiser, *args, **{**kwargs, "fused": False, "foreach": False})

    return plain
