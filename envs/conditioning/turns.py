"""Numbers that tell one orientation in several ways, and the one of them that lies nearest to others."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

_TURN = 2 * math.pi
_HALF = math.pi + 0.1  # rad, that a robot tells at most
_STEP = 1.0  # rad, that a robot turns from one frame to the next at most, mostly far less
_UNIT = 0.05  # how far from 1 the norm of a recorded quaternion may be


class Turns(nn.Module):
    """Which of a robot's numbers are orientations, if data bear it out.

    Roll, pitch and yaw jump by a whole turn where they pass pi, rotation vectors change their direction
    there, and a quaternion is the same orientation as its negative. A gripper that points down comes there
    from one episode to the next, or within one.

    Args:
        size: how many numbers there are.
        groups: positions of the numbers of each orientation: 1 is an angle in radians, 3 are a rotation
            vector in radians, 4 a quaternion in any order. Angles and vectors of more than a turn, or of more
            than half a turn that jump by no whole turns, and quaternions of another norm than 1, are counted
            in something else, or counted on, and are taken as they are.
    """

    turn: Tensor
    borne_out: Tensor

    def __init__(self, size: int, groups: Sequence[Sequence[int]]):
        super().__init__()
        self.angles = [group[0] for group in groups if len(group) == 1]
        self.wholes = [list(group) for group in groups if len(group) > 1]
        if any(len(group) not in (3, 4) for group in self.wholes):
            raise ValueError(f"orientations {self.wholes} must have 1, 3 or 4 numbers")
        self.register_buffer("turn", torch.zeros(size))  # of angles; 0 of all other numbers
        self.register_buffer("borne_out", torch.zeros(len(self.wholes), dtype=torch.bool))

    @torch.no_grad()
    def fit(self, values: Tensor) -> Tensor:
        """See which orientations values [N, size] bear out, in whose order a robot came from one to the next;
        their mean [size], whatever way each is told.
        """
        values = values.to(self.turn.device)
        sizes = {number: values[:, number].abs() for number in self.angles}
        self.turn.zero_()
        for number, size in sizes.items():
            self.turn[number] = _TURN * bool((size <= _TURN).all())
        circular = torch.atan2(values.sin().mean(0), values.cos().mean(0))
        middle = torch.where(self.turn > 0, circular, values.mean(0))
        for which, group in enumerate(self.wholes):
            some, norm = values[:, group], values[:, group].norm(dim=-1)
            fits = norm <= _TURN if len(group) == 3 else (norm - 1).abs() <= _UNIT
            self.borne_out[which] = bool(fits.all())
            if len(values) and self.borne_out[which]:
                middle[group] = _vector(_axis(_quaternion(some))) if len(group) == 3 else _axis(some)
        told, back = self.nearest(values, middle), self.nearest(values[1:], values[:-1])
        for number, size in sizes.items():
            if not _in_radians(values[:, [number]], size, told[:, [number]], back[:, [number]]):
                self.turn[number], middle[number] = 0.0, values[:, number].mean()
        for which, group in enumerate(self.wholes):
            some = values[:, group]
            if len(group) == 3 and not _in_radians(some, some.norm(dim=-1), told[:, group], back[:, group]):
                self.borne_out[which], middle[group] = False, some.mean(0)
        return middle + (self.nearest(values, middle) - middle).mean(0)

    def nearest(self, values: Tensor, to: Tensor) -> Tensor:
        """Values [..., size] whose orientations are told as near to those of others [..., size] as may be."""
        if self.angles:
            turn = self.turn
            values = values - turn * ((values - to) / torch.where(turn > 0, turn, 1.0)).round()
        if self.wholes:
            values = values.clone()
        for group, borne_out in zip(self.wholes, self.borne_out, strict=True):
            some = values[..., group]
            along = (some * to[..., group]).sum(-1, keepdim=True)
            if len(group) == 4:
                factor = torch.where(along < 0, -1.0, 1.0)
            else:
                norm = some.norm(dim=-1, keepdim=True).clamp(min=1e-6)
                factor = 1 - _TURN / norm * ((norm - along / norm) / _TURN).round()
            values[..., group] = some * torch.where(borne_out, factor, 1.0).to(some)
        return values


def _in_radians(values: Tensor, sizes: Tensor, told: Tensor, back: Tensor) -> bool:
    """Whether angles [N, 1] or rotation vectors [N, 3] of at most a turn are in radians, not a few degrees.

    Robots tell half a turn at most. What lies beyond was counted on, so it either needs no other way to be
    told, or jumps by whole turns, which degrees that pass a number of no meaning to them do not.

    Args:
        sizes: of the values, [N].
        told: the values, nearest to their mean.
        back: all but the first, nearest to the one before.
    """
    if bool((sizes <= _HALF).all()) or bool((told == values).all()):
        return True
    before, after = values[:-1], values[1:]
    jumps = (after - before).norm(dim=-1) > math.pi
    whole = (back - before).norm(dim=-1) < _STEP
    return bool(jumps.any()) and 2 * int((jumps & whole).sum()) > int(jumps.sum())


def _axis(quaternions: Tensor) -> Tensor:
    """The mean [4] of quaternions [N, 4], whatever their signs; the largest number is positive."""
    mean = torch.linalg.eigh(quaternions.double().T @ quaternions.double())[1][:, -1]
    return (mean * mean[mean.abs().argmax()].sign()).to(quaternions)


def _quaternion(vectors: Tensor) -> Tensor:
    """Quaternions [N, 4], w first, of rotation vectors [N, 3]."""
    norm = vectors.norm(dim=-1, keepdim=True)
    return torch.cat(((norm / 2).cos(), vectors / norm.clamp(min=1e-6) * (norm / 2).sin()), -1)


def _vector(quaternion: Tensor) -> Tensor:
    """The rotation vector [3] of a quaternion [4], w first."""
    sine = quaternion[1:].norm()
    return 2 * torch.atan2(sine, quaternion[0]) * quaternion[1:] / sine.clamp(min=1e-6)
