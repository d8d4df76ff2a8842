"""What tells action heads apart: how a chunk is said, and how far one is from another."""

from __future__ import annotations

import abc
from typing import Any, ClassVar

from torch import Tensor, nn


class Head(nn.Module, abc.ABC):
    """From a policy's hidden vector [..., width] to the parameters of a distribution over chunks [K, A].

    Attributes:
        names: of those parameters, in the order in which forward returns them; the distribution takes them by
            name.
        distribution: its class, with log_prob, entropy, mode, a registered KL divergence, and `held`.
        chunk: actions per chunk, K.
    """

    names: ClassVar[tuple[str, ...]]
    distribution: ClassVar[type[Any]]
    chunk: int

    @abc.abstractmethod
    def normalise(self, chunks: Tensor, floor: Tensor) -> None:
        """Set units from demonstrated chunks [N, K, A]; dimensions whose spread is below `floor` [A] become
        constants.
        """

    @abc.abstractmethod
    def target(self, chunks: Tensor) -> Tensor:
        """What `error` compares with, of chunks [N, K, A]."""

    @abc.abstractmethod
    def error(self, hidden: Tensor, target: Tensor) -> Tensor:
        """Scalar loss of imitation."""

    @abc.abstractmethod
    def apart(self, one: Tensor, other: Tensor) -> Tensor:
        """Scalar distance of what is said of two hidden vectors [N, width]."""

    @abc.abstractmethod
    def exploration(self) -> list[nn.Parameter]:
        """Parameters that say how much to explore, which demonstrations do not tell."""
