"""Timing on machines that do other things, too."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import torch

_CPU = torch.device("cpu")


def now(device: torch.device = _CPU) -> float:
    """Seconds of a clock, once the device has done what it was told to."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


def best(work: Callable[[], Any], repeats: int = 7, device: torch.device = _CPU) -> float:
    """Least seconds of several runs on a device after one warm-up; the least is what the machine can do."""
    work()
    times = []
    for _ in range(repeats):
        began = now(device)
        work()
        times.append(now(device) - began)
    return min(times)
