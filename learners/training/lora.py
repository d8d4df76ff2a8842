"""Low-rank adaptation of a transformer (Hu et al. 2021) by peft: few weights learn, and are folded into the
rest at the end.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from torch import nn

# Every projection of attention and feed-forward, in trunk and state expert alike.
TARGETS = ("to_q", "to_k", "to_v", "to_out.0", "ff.net.0.proj", "ff.net.2")


@contextmanager
def low_rank(net: nn.Module, rank: int) -> Iterator[None]:
    """Within it only adapters of `net` learn; after it they are part of its weights, under their old names.
    Rank 0 does nothing.

    An exception leaves the adapters where they are: what follows is a new process that resumes from a
    checkpoint.
    """
    if not rank:
        yield
        return
    from peft import LoraConfig, LoraModel  # transformers come with it, which take seconds to import

    wanted = {name: parameter.requires_grad for name, parameter in net.named_parameters()}
    adapted = LoraModel(net, LoraConfig(r=rank, lora_alpha=rank, target_modules=list(TARGETS)), "default")
    yield
    adapted.merge_and_unload()
    for name, parameter in net.named_parameters():
        parameter.requires_grad_(wanted[name])
