"""What a process needs before heavy work: its settings, and the device it computes on."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Mapping
from typing import Any

import torch

from envs.physics.pool import available_cores
from envs.rng import seed_process
from envs.targets import ConfigError


def prepare_process(seed: int, threads: int) -> None:
    """Settings every process needs before heavy work: seeds, threads, and an allocator that keeps its memory.

    Args:
        seed: of the global generators.
        threads: of torch on the CPU, which decide the order of sums and so their last bits; what must be
            equal on any machine fixes them. 0 for one per core.

    Video batches are tens of megabytes; glibc would map and unmap them at every operation, and page faults
    then cost a third more time per training step (8.4 ms a sample with this, 11.3 without).
    """
    # Softmax tails leave gradients too small for normal floats, on which Intel CPUs are ten times slower;
    # threads started later inherit the setting.
    torch.set_flush_denormal(True)
    seed_process(seed)
    # Threads sum gradients of indexing in any order otherwise: the same seed would give other weights, the
    # sooner the busier the machine is. Where a GPU has no such kernel, torch warns and goes on.
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
    torch.use_deterministic_algorithms(True, warn_only=True)
    torch.utils.deterministic.fill_uninitialized_memory = False  # type: ignore[attr-defined]
    torch.set_num_threads(threads or available_cores())
    try:
        libc = ctypes.CDLL("libc.so.6")
    except OSError:
        return  # another C library: slower, not wrong
    trim, top_pad, mmap = -1, -2, -3
    libc.mallopt(mmap, 2**31 - 1)
    libc.mallopt(trim, 2**31 - 1)
    libc.mallopt(top_pad, 2**26)


def device_of(cfg: Mapping[str, Any]) -> torch.device:
    """The device of policies, simulators, judges and learners.

    Raises:
        ConfigError: if launch.device asks for a GPU that is not there.
    """
    name = cfg["launch"]["device"]
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    if name.startswith("cuda") and not torch.cuda.is_available():
        raise ConfigError(f"launch.device={name}, but this machine has no CUDA device; use launch.device=cpu")
    return torch.device(name)
