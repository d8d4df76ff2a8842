"""Layers of the U-Net engine."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from envs.conditioning import ActionVector, Pace
from envs.conditioning.units import LEAST_SPREAD, Units
from envs.precision import working_dtype
from envs.simulators.row_linear import RowLinear
from envs.simulators.unet.folding import fold
from envs.specs import WorldSpec

_MAPS = 16  # channels of the action map before it is lifted


class FilmBlock(nn.Module):
    """Residual block of two 3x3 convolutions whose middle is scaled and shifted by the actions (FiLM).

    Args:
        width: channels, a multiple of 8.
        cond: numbers of the conditioning vector.
    """

    def __init__(self, width: int, cond: int):
        super().__init__()
        self.norm1, self.norm2 = nn.GroupNorm(8, width), nn.GroupNorm(8, width)
        self.conv1 = nn.Conv2d(width, width, 3, padding=1)
        self.conv2 = nn.Conv2d(width, width, 3, padding=1)
        self.film = RowLinear(cond, 2 * width)
        nn.init.zeros_(self.conv2.weight)
        nn.init.zeros_(self.film.weight)
        nn.init.zeros_(self.film.bias)

    def forward(self, x: Tensor, cond: Tensor) -> Tensor:
        """[B, width, h, w] of the same, and [B, cond]."""
        h = self.conv1(F.silu(self.norm1(x)))
        scale, shift = self.film(cond)[..., None, None].chunk(2, 1)
        h = self.conv2(F.silu(self.norm2(h) * (1 + scale) + shift))
        return x + h


class Embed(nn.Module):
    """Looks at one view, square by square.

    Args:
        channels: of the pictures, which are bytes.
        width: of what comes out.
        shrink: 2 looks at the mean of each four pixels, 1 at all.
        edge: of a square.
    """

    def __init__(self, channels: int, width: int, shrink: int, edge: int):
        super().__init__()
        self.shrink, self.edge = shrink, edge
        bound = channels**-0.5 / edge
        self.weight = nn.Parameter(torch.empty(width, channels, edge, edge).uniform_(-bound, bound))
        self.bias = nn.Parameter(torch.empty(width).uniform_(-bound, bound))

    def forward(self, pictures: Sequence[Tensor]) -> Tensor:
        """[B, width, h / edge, w / edge] of bytes or floats in 0..255 [B, C, shrink h, shrink w]."""
        dtype = working_dtype(self.weight.device, self.weight.dtype)
        weight: Tensor = self.weight
        if self.shrink > 1:
            weight = (
                weight.repeat_interleave(self.shrink, 2).repeat_interleave(self.shrink, 3) / self.shrink**2
            )
        # Bytes stay what they are; that they are meant as -1..1 is left to the weights.
        weight = weight.flatten(1)
        folded = torch.cat([fold(some, self.edge * self.shrink).to(dtype) for some in pictures], -1)
        return F.linear(folded, weight / 127.5, self.bias - weight.sum(1)).permute(0, 3, 1, 2)


class ActionEncoder(nn.Module):
    """A chunk of actions, and the robot's state, as a vector and as a coarse map.

    The map lets the network tell where actions act even without pose maps.

    Args:
        spec: whose actions and states.
        cond: numbers of the vector.
        width: channels of the map.
        cells: its rows and columns.
    """

    def __init__(self, spec: WorldSpec, cond: int, width: int, cells: tuple[int, int]):
        super().__init__()
        self.vector = ActionVector(spec.embodiment)
        self.units = Units(spec.state_dim, spec.embodiment.state_rotations, LEAST_SPREAD)
        size = spec.chunk * self.vector.size + spec.state_dim
        self.layers = nn.Sequential(
            RowLinear(size, cond), nn.SiLU(), RowLinear(cond, cond), nn.SiLU(), RowLinear(cond, cond)
        )
        self.pace = Pace(cond)
        cut = nn.Unflatten(1, (_MAPS, *cells))
        self.map = nn.Sequential(nn.SiLU(), RowLinear(cond, _MAPS * cells[0] * cells[1]), cut)
        self.lift = nn.Conv2d(_MAPS, width, 1)

    def normalise(self, commands: Tensor, moves: Tensor, states: Tensor) -> None:
        """Take units from data; arguments as of Simulator.normalise."""
        self.vector.normalise(commands, moves)
        self.units.normalise(states)

    def forward(self, commands: Tensor, now: Tensor, state: Tensor, stride: Tensor) -> tuple[Tensor, Tensor]:
        """[B, cond] and [B, width, *cells] of commands [B, K, A], the one in force [B, A], the state [B, S],
        and the robot's frames from one shown frame to the next [B].
        """
        actions = self.vector(commands, now).flatten(1)
        joints = self.units(state).clamp(-5, 5)
        cond = self.layers(torch.cat((actions, joints), 1))
        cond = cond + self.pace(stride).to(cond.dtype)
        return cond, self.lift(self.map(cond))


def output_head(width: int, chunk: int, maps: int, memory: int, edge: int) -> nn.Sequential:
    """Output maps of one view; it starts from the last frame, for random output takes hundreds of steps to
    unlearn.

    Args:
        width: channels that come in.
        chunk: frames per chunk.
        maps: per frame; the first are logits of the `memory` remembered frames, of which the last is the
            newest.
        edge: of the square that each place says.
    """
    last = nn.Conv2d(width, maps * chunk * edge**2, 1)
    bias = torch.zeros(chunk, maps, edge**2)
    bias[:, memory - 1 : memory + 1] = 1.0
    nn.init.zeros_(last.weight)
    last.bias = nn.Parameter(bias.flatten())
    return nn.Sequential(nn.GroupNorm(8, width), nn.SiLU(), last)


def flow_head(width: int, chunk: int) -> nn.Sequential:
    """Flow of one view, [B, 2 * chunk, h, w] of features [B, width, h, w]; one vector for a whole square of
    pixels keeps it smooth.
    """
    last = nn.Conv2d(width, 2 * chunk, 3, padding=1)
    nn.init.zeros_(last.weight)
    assert last.bias is not None
    nn.init.zeros_(last.bias)
    return nn.Sequential(nn.GroupNorm(8, width), nn.SiLU(), last)


def at_detail(pictures: Tensor, shrink: int) -> Tensor:
    """Bytes [B, 3, H, W] as float in 0..1, with shrink = 2 the mean of each four pixels."""
    x = pictures.float().div(255)
    if shrink == 1:
        return x
    # Four sums are faster than torch's pooling.
    return (x[..., ::2, ::2] + x[..., 1::2, ::2] + x[..., ::2, 1::2] + x[..., 1::2, 1::2]) / 4
