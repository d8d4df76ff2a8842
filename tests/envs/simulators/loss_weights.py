"""The weights of what a world that denoises is trained to say."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from envs.simulators.stepwise import Stepwise


def loss_weights(world: Stepwise, output: nn.Module, clip: TensorDict) -> tuple[Tensor, Tensor]:
    """Those of a chunk in steps, and of the loss: twice its second derivative by what the layer `output` says
    last.
    """
    said: list[Tensor] = []
    hook = output.register_forward_hook(lambda layer, args, out: said.append(out) or out)
    loss = world.loss(clip, torch.Generator().manual_seed(0))[0]
    hook.remove()
    (first,) = torch.autograd.grad(loss, said[-1:], create_graph=True)
    (second,) = torch.autograd.grad(first.sum(), said[-1:])
    return world.chunk_of(clip, torch.Generator().manual_seed(0))[1], second
