"""Looking at a policy while it learns, such as at its success in physics."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from actors.rollouts.host import Weights


@dataclass(frozen=True)
class Watch:
    """Looks at what has been learned, and may end the run. Nothing that it does changes what is learned next.

    Args:
        every: iterations between looks; the last iteration is looked at in any case.
        look: (iteration, the policy's trained tensors) -> figures for the log, and whether this is enough. Of
            several workers the leading one looks.
    """

    every: int
    look: Callable[[int, Weights], tuple[dict[str, float], bool]]

    def due(self, iteration: int, iterations: int) -> bool:
        """Whether to look after this iteration of so many."""
        return (iteration + 1) % self.every == 0 or iteration + 1 == iterations
