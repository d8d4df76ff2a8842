"""Low-rank adaptation of transformers (Hu et al. 2021) by peft: few weights learn, and are folded in at the
end.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from torch import nn

from envs.targets import ConfigError

# Every projection of attention and feed-forward, in trunk and state expert alike.
TARGETS = ("to_q", "to_k", "to_v", "to_out.0", "ff.net.0.proj", "ff.net.2")


@contextmanager
def low_rank(module: nn.Module, rank: int) -> Iterator[None]:
    """Within it only adapters of a module's projections learn; after it they are part of its weights.

    Names of parameters are the old ones again afterwards. Rank 0 leaves all weights to learn. An exception
    leaves the adapters where they are: what follows is a new process that resumes from a checkpoint.

    Args:
        module: with projections that are named as in TARGETS.
        rank: of the adapters.

    Raises:
        ConfigError: if the module has no such projections.
    """
    if not rank:
        yield
        return
    if not any(name.endswith(TARGETS) for name, _ in module.named_modules()):
        raise ConfigError(
            f"lora={rank} adapts the projections of transformers, and {type(module).__name__} has none;"
            " set lora=0 to train all weights"
        )
    from peft import LoraConfig, LoraModel  # transformers come with it, which take seconds to import

    wanted = {name: parameter.requires_grad for name, parameter in module.named_parameters()}
    adapted = LoraModel(module, LoraConfig(r=rank, lora_alpha=rank, target_modules=list(TARGETS)), "default")
    yield
    adapted.merge_and_unload()
    for name, parameter in module.named_parameters():
        parameter.requires_grad_(wanted[name])
