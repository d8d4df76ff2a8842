"""Compiled networks: torch.compile on the parts of a network that run often and alike (regional compilation).

A whole network takes minutes to compile; of a transformer one block is compiled for all. Weights keep their
names, and a copy of a module is not compiled.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from typing import Any, Literal, TypeVar

import torch
from torch import nn

Compile = Literal["blocks", "graphs"]
Network = TypeVar("Network", bound=nn.Module)

# Variants of one part, by shapes and arguments; with more, torch goes on uncompiled. A video autoencoder's
# layers have some thirty.
_VARIANTS = 64


class Repeated(nn.Module):
    """A network that says which of its parts are worth compiling; here none is."""

    compiled: Compile | None = None

    def repeated(self) -> Iterator[tuple[nn.Module, bool]]:
        """Parts that run often and alike, and of each whether launches are what its time goes to, so that
        CUDA graphs may replay it.
        """
        return iter(())


def compile_parts(network: Network, how: Compile | None) -> Network:
    """Compile what a network says is worth it, in place, at its first use.

    Args:
        network: what is not Repeated stays as it is.
        how: "blocks" fuses operations; "graphs" also replays them as CUDA graphs, which pays where a GPU
            waits for the launches of small networks, and only within one thread; None does nothing.

    Raises:
        ValueError: if there is no compiler to build what is fused.
    """
    if how is None or not isinstance(network, Repeated):
        return network
    if not any(shutil.which(name) for name in (os.environ.get("CXX", "g++"), os.environ.get("CC", "gcc"))):
        raise ValueError(
            f"launch.compile={how} needs a C++ compiler, and this machine has neither g++ nor $CXX; install"
            " one, or leave launch.compile=null"
        )
    settings: Any = torch._dynamo.config
    settings.recompile_limit = max(settings.recompile_limit, _VARIANTS)
    for part, launches in network.repeated():
        part.compile(mode="reduce-overhead" if how == "graphs" and launches else "default")
    network.compiled = how
    return network


def replays(network: nn.Module) -> bool:
    """Whether CUDA graphs replay a part of it; `begin_step` must then be called between its uses."""
    return any(getattr(part, "compiled", None) == "graphs" for part in network.modules())


def begin_step() -> None:
    """What CUDA graphs have made is used up from here on, and its memory theirs again."""
    torch.compiler.cudagraph_mark_step_begin()
