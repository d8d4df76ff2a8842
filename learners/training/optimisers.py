"""Which optimiser moves which parameters, and its state as named tensors for checkpoints."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim import AdamW, Optimizer

from learners.training.muon import Muon

Parameters = Mapping[str, nn.Parameter]
Optimise = Callable[[Parameters, float, float], list[Optimizer]]  # of parameters, lr and weight decay


def adamw(trained: Parameters, lr: float, weight_decay: float, hidden: Sequence[str] = ()) -> list[Optimizer]:
    """AdamW (Loshchilov & Hutter 2019) on all; norms, biases and other vectors do not decay."""
    groups = [
        {"params": [p for p in trained.values() if p.ndim >= 2], "weight_decay": weight_decay},
        {"params": [p for p in trained.values() if p.ndim < 2], "weight_decay": 0.0},
    ]
    return [AdamW([group for group in groups if group["params"]], lr=lr, betas=(0.9, 0.99), fused=True)]


def muon(trained: Parameters, lr: float, weight_decay: float, hidden: Sequence[str] = ()) -> list[Optimizer]:
    """Muon on matrices and convolutions of hidden layers, AdamW on everything else, at one learning rate.

    Args:
        hidden: names of these layers, as one part of their parameters' names; all layers if there are none.
    """
    matrices = {
        name: p
        for name, p in trained.items()
        if p.ndim >= 2 and (not hidden or not set(hidden).isdisjoint(name.split(".")))
    }
    rest = {name: p for name, p in trained.items() if name not in matrices}
    out: list[Optimizer] = [Muon(matrices.values(), lr=lr, weight_decay=weight_decay)] if matrices else []
    return out + (adamw(rest, lr, weight_decay) if rest else [])


OPTIMISERS: dict[str, Callable[..., list[Optimizer]]] = {
    "adamw": adamw,
    "muon": muon,
}


def optimiser_state(optimisers: Sequence[Optimizer], trained: Parameters) -> dict[str, dict[str, Tensor]]:
    """The state of optimisers by the parameters' names, made zero where it has not begun.

    The tensors are the optimisers' own: whatever is filled in there is what they go on with.
    """
    names = {id(parameter): name for name, parameter in trained.items()}
    out: dict[str, dict[str, Tensor]] = {}
    for optimiser in optimisers:
        begin = _BEGIN[type(optimiser)]
        for group in optimiser.param_groups:
            for parameter in group["params"]:
                state = optimiser.state[parameter]
                if not state:
                    state.update(begin(parameter, optimiser.defaults))
                out[names[id(parameter)]] = dict(state)
    return out


def _adam(parameter: nn.Parameter, defaults: Mapping[str, Any]) -> dict[str, Tensor]:
    device = parameter.device if defaults.get("fused") else torch.device("cpu")
    return {
        "step": torch.zeros((), dtype=torch.float32, device=device),
        "exp_avg": torch.zeros_like(parameter),
        "exp_avg_sq": torch.zeros_like(parameter),
    }


def _muon(parameter: nn.Parameter, defaults: Mapping[str, Any]) -> dict[str, Tensor]:
    return {"momentum_buffer": torch.zeros_like(parameter)}


_BEGIN: dict[type[Optimizer], Callable[[nn.Parameter, Mapping[str, Any]], dict[str, Tensor]]] = {
    torch.optim.Adam: _adam,
    AdamW: _adam,
    Muon: _muon,
}
