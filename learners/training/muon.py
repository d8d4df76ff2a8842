"""Muon (Jordan et al. 2024): momentum whose steps are made orthogonal, for matrices and convolutions.

torch.optim.Muon takes neither convolutions nor parameters in shards, iterates in bfloat16, which processors
without bfloat16 units emulate slowly, and on whole matrices instead of their small squares.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor, nn
from torch.distributed.tensor import DTensor, distribute_tensor
from torch.optim import Optimizer

_QUINTIC = (3.4445, -4.7750, 2.0315)  # of the Newton-Schulz iteration, as published
_RMS = 0.2  # root mean square of a step in units of the learning rate, as AdamW's (Liu et al. 2025)


class Muon(Optimizer):
    """Nesterov momentum, orthogonalised; a rate that suits AdamW suits it.

    Args:
        params: of at least two dimensions; all but the first are taken as one.
        lr: learning rate.
        weight_decay: decoupled.
        momentum: decay of the gradients' moving average.
        iterations: of Newton-Schulz.
    """

    def __init__(
        self,
        params: Iterable[nn.Parameter],
        lr: float,
        weight_decay: float,
        momentum: float = 0.95,
        iterations: int = 5,
    ):
        super().__init__(
            list(params),
            {"lr": lr, "weight_decay": weight_decay, "momentum": momentum, "iterations": iterations},
        )

    @torch.no_grad()
    def step(self, closure: Any = None) -> None:  # type: ignore[override]
        """One step from the gradients that are there; parameters without one stay."""
        for group in self.param_groups:
            alike: dict[tuple[int, ...], list[tuple[nn.Parameter, Tensor]]] = {}
            for parameter in group["params"]:
                if parameter.grad is not None:
                    update = self._momentum(parameter, group["momentum"])
                    alike.setdefault(tuple(update.shape), []).append((parameter, update))
            for (rows, columns), some in alike.items():  # as one batch of matrices
                steps = orthogonal(torch.stack([update for _, update in some]), group["iterations"])
                size = group["lr"] * _RMS * max(rows, columns) ** 0.5
                for (parameter, _), step in zip(some, steps, strict=True):
                    parameter.mul_(1 - group["lr"] * group["weight_decay"])
                    _add(parameter, step.reshape(parameter.shape), -size)

    def _momentum(self, parameter: nn.Parameter, decay: float) -> Tensor:
        """The whole direction of a parameter's next step, [rows, columns]."""
        gradient, state = parameter.grad, self.state[parameter]
        assert gradient is not None
        if "momentum_buffer" not in state:
            state["momentum_buffer"] = torch.zeros_like(parameter)
        average = state["momentum_buffer"]
        average.lerp_(gradient, 1 - decay)
        update = gradient.lerp(average, decay)
        whole = update.full_tensor() if isinstance(update, DTensor) else update
        return whole.flatten(1)


def orthogonal(matrices: Tensor, iterations: int) -> Tensor:
    """Nearly the orthogonal factors of matrices [N, rows, columns]: all singular values about 1.

    Singular values that are much smaller than the largest rise towards 1 and may stay below it. Every step of
    the iteration is a polynomial in X X', so they are worked out on that small square and meet X only once.
    """
    tall = matrices.shape[1] > matrices.shape[2]
    x = (matrices.mT if tall else matrices).float()
    x = x / (x.norm(dim=(1, 2), keepdim=True) + 1e-7)
    a, b, c = _QUINTIC
    square, whole = x @ x.mT, None
    for number in range(iterations):
        step = torch.baddbmm(square, square, square, beta=b, alpha=c)
        step.diagonal(dim1=1, dim2=2).add_(a)
        whole = step if whole is None else step @ whole
        if number + 1 < iterations:
            square = step @ square @ step
    x = x if whole is None else whole @ x
    return (x.mT if tall else x).to(matrices.dtype)


def _add(parameter: nn.Parameter, step: Tensor, scale: float) -> None:
    """parameter += scale * step, of a whole step for a parameter that may lie in shards."""
    if isinstance(parameter, DTensor):
        shards = distribute_tensor(step, parameter.device_mesh, parameter.placements, src_data_rank=None)
        parameter.to_local().add_(shards.to_local(), alpha=scale)
    else:
        parameter.add_(step, alpha=scale)
