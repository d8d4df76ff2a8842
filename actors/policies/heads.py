"""What tells action heads apart: how a chunk is said, and how far one is from another."""

from __future__ import annotations

import abc
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from envs.conditioning.units import RESOLUTION
from envs.embodiment import ActionKind, Embodiment

MARGIN = 0.01  # share of the greatest spread among numbers of one unit, below which it may be constant
# Variance over mean squared step, above which a number travels. Noise has 1/2; where chunks are offsets from
# a command that is as noisy, it has 1.
_DIRECTED = 1.25


class Head(nn.Module, abc.ABC):
    """From a policy's hidden vector [..., width] to the parameters of a distribution over chunks [K, A].

    Built as head(width=, chunk=, actions=, **options of its config section).

    Attributes:
        names: of those parameters, in the order in which forward returns them; the distribution takes them by
            name.
        distribution: its class, with log_prob, entropy, mode, a registered KL divergence, and `held`.
        chunk: actions per chunk, K.
        actions: numbers of an action, A.
        share: of chunks that are drawn at random, float32 []; the others are the mode (see some_drawn).
    """

    names: ClassVar[tuple[str, ...]]
    distribution: ClassVar[type[Any]]
    chunk: int
    actions: int
    share: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("share", torch.ones(()))

    @abc.abstractmethod
    def normalise(self, chunks: Tensor, varies: Tensor) -> None:
        """Set units from demonstrated chunks [N, K, A]; what does not vary (bool [A]) becomes constant."""

    @abc.abstractmethod
    def target(self, chunks: Tensor) -> Tensor:
        """What `error` compares with, of chunks [N, K, A]."""

    @abc.abstractmethod
    def error(self, hidden: Tensor, target: Tensor) -> Tensor:
        """Scalar loss of imitation."""

    @abc.abstractmethod
    def scale_spread(self, width: float) -> None:
        """Multiply how widely chunks are drawn around the mode, which stays."""

    def scale_exploration(self, width: float, share: float) -> None:
        """Multiply how widely chunks are drawn around the mode, and draw that share of them."""
        self.scale_spread(width)
        self.share.fill_(share)

    @property
    @abc.abstractmethod
    def varies(self) -> Tensor:
        """Which numbers of an action are no constants, bool [A]; all until `normalise`."""

    @property
    def exploration(self) -> float:
        """How widely chunks are drawn, over how widely the config says; 1 where a step of parameters moves
        the distribution as far however widely it is drawn.
        """
        return 1.0


def some_drawn(drawn: Tensor, mode: Tensor, share: Tensor) -> Tensor:
    """Chunks [..., K, A], each drawn with probability `share` [...] and the mode otherwise.

    What comes of a drawn chunk is also what comes of those drawn after it; with fewer of them an episode
    survives wider ones. (TRPO's vine estimate, Schulman et al. 2015, tries single actions from states, too.)
    """
    chosen = torch.rand(drawn.shape[:-2], device=drawn.device) < share
    return torch.where(chosen[..., None, None], drawn, mode)


def varying(chunks: Tensor, robot: Embodiment) -> Tensor:
    """Which numbers of an action vary in demonstrated chunks [N, K, A]: bool [A].

    A number is constant if its standard deviation is below RESOLUTION, or small and noise alone. Small is
    below MARGIN times the greatest one among the numbers of its unit: positions, angles and joints each have
    one, grippers that of their range, and numbers of unknown meaning are each alone. Positions and angles of
    poses are certain to share theirs, so what is small among them need not look like noise. Of joints one may
    be a rail in metres, the others in degrees, and the range of a gripper may be another than is thought.
    """
    spread = chunks.flatten(0, 1).double().std(0, unbiased=False)
    least = torch.full_like(spread, RESOLUTION)
    for group in _units(robot):
        least[group] = torch.maximum(least[group], MARGIN * spread[group].max())
    doubtful = torch.zeros_like(spread, dtype=torch.bool)
    if robot.action_kind is ActionKind.JOINTS:
        doubtful[[number for arm in robot.arms for number in arm.numbers]] = True
    for arm in robot.arms:
        if arm.gripper is not None:
            opened, closed = arm.gripper_range
            least[arm.gripper], doubtful[arm.gripper] = MARGIN * abs(closed - opened), True
    return (spread > RESOLUTION) & ((spread > least) | (doubtful & _travels(chunks, robot)))


def _travels(chunks: Tensor, robot: Embodiment) -> Tensor:
    """Which numbers go further in chunks [N, K, A] than steps without a direction would take them: bool [A].

    Noise is as far from its mean as from what comes next, up to a factor. Steps in which nothing moves, as
    past an episode's end, tell nothing.
    """
    path = chunks.to(torch.float64, copy=True)
    changes = list(robot.changes)
    path[..., changes] = path[..., changes].cumsum(1)
    steps = path.diff(dim=1)
    steps = steps[(steps != 0).any(-1)]
    square = steps.square().sum(0) / max(1, len(steps))
    return path.flatten(0, 1).var(0, unbiased=False) > _DIRECTED * square


def _units(robot: Embodiment) -> list[list[int]]:
    """Positions in the action of numbers that have the same unit."""
    if robot.action_kind is ActionKind.OTHER:
        return []
    numbers = [list(arm.numbers) for arm in robot.arms]
    if robot.action_kind is ActionKind.JOINTS:
        return [[n for arm in numbers for n in arm]] if numbers else []
    groups = ([n for arm in numbers for n in arm[:3]], [n for arm in numbers for n in arm[3:]])
    return [group for group in groups if group]
