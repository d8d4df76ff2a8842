"""What this process has of the machine."""

from __future__ import annotations

import os


def available_cores() -> int:
    """Cores this process may run on, which in containers and batch systems is less than the machine has."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
