"""Where a host's time goes: seconds inside the networks' forward passes, and in everything around them."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import torch


class Meter:
    """Adds up the seconds of some methods; calls within calls count once."""

    def __init__(self) -> None:
        self.seconds = 0.0
        self._depth = 0

    def watch(self, owner: object, name: str) -> None:
        """Count the seconds of owner.name from now on. The owner must be nobody else's: its method is wrapped
        in place.
        """
        inner: Callable[..., Any] = getattr(owner, name)

        def timed(*words: Any, **more: Any) -> Any:
            began = time.perf_counter()
            self._depth += 1
            try:
                return inner(*words, **more)
            finally:
                self._depth -= 1
                if not self._depth:
                    if torch.cuda.is_initialized():
                        torch.cuda.synchronize()  # kernels run on after their launch
                    self.seconds += time.perf_counter() - began

        setattr(owner, name, timed)
