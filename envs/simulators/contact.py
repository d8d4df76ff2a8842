"""Where commands push things: contact learned frame by frame, from a few numbers in each thing's own frame.

A pushed block is a matter of centimetres, and of which side is pushed at which angle. Told in the block's own frame,
turned so that the fingertip is always before the same side, and mirrored so that it is always on the same half of it,
all pushes of a data set are examples of a few. What several hands do adds up, and what no hand is near stays.
"""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from envs.geometry import eef_transforms, fingertips
from envs.simulators.sight import mean_gap, turn

_REACH = 0.13  # m between fingertip and thing beyond which nothing happens
_EDGE = 0.02  # m over which a push fades out there
_PAST = 3  # commands before the one to come that a push depends on: arms lag behind
_WILD = 2.0  # log of how many centimetres (tenths of a radian) a frame is at most in doubt by; exp() of more would overflow
_LEVER = 0.03  # m, what a wrong heading counts beside a wrong place: a radian is as bad as this far off


class Contact(nn.Module):
    """Moves things under commands.

    Args:
        sides: per object, see Sight.
        width: hidden size.

    Attributes:
        spread: what doubt is multiplied with, so that it fits episodes that were not learned from.
    """

    spread: Tensor
    sides: Tensor

    def __init__(self, sides: tuple[int, ...], width: int = 256):
        super().__init__()
        self.register_buffer("spread", torch.ones(()))
        self.register_buffer("sides", torch.tensor(sides), persistent=False)
        told = 2 * 3 * (_PAST + 1) + 3 + max(1, len(sides))
        last = nn.Linear(width, 5)
        self.layers = nn.Sequential(nn.Linear(told, width), nn.SiLU(), nn.Linear(width, width), nn.SiLU(), nn.Linear(width, width), nn.SiLU(), last)
        with torch.no_grad():
            last.weight.mul_(0.1)

    def push(self, places: Tensor, recent: Tensor, commands: Tensor, luck: Tensor) -> Tensor:
        """Where objects at `places` [B, S, 4] will be [B, K, S, 4] under `commands` [B, K, 14].

        Args:
            recent: [B, P, 14] commands before these, the one in force last.
            luck: [B, S, 3] how far, in standard deviations, each object strays from its likeliest way (x, y, heading).
                What decides a push (friction, an edge) is not all seen; a world in which every push goes the
                likeliest way is one that a policy learns to exploit.
        """
        return self.foresee(places, recent, commands, self.spread * luck)[0]

    @torch.autocast("cpu", enabled=False)
    @torch.autocast("cuda", enabled=False)  # positions need more than the eight bits of bfloat16
    def foresee(self, places: Tensor, recent: Tensor, commands: Tensor, luck: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """The way [B, K, S, 4], and the standard deviations [B, K, S, 2] of places (m) and headings (rad) that have added up; arguments as those of push."""
        told = torch.cat((recent[:, :1].expand(-1, max(0, _PAST - recent.shape[1]), -1), recent[:, -_PAST:], commands), 1)
        tips, hands = fingertips(told), eef_transforms(told)
        paddle = torch.atan2(hands[..., 1, 1], hands[..., 0, 1])  # fingers stand side by side along the flange's y
        grip = told.unflatten(-1, (2, 7))[..., 6]
        now, way, doubts = places, [], []
        doubt = torch.zeros((*places.shape[:2], 2), device=places.device)
        for step in range(commands.shape[1]):
            last = step + _PAST
            move, strayed = self._frame(now, tips[:, step : last + 1], paddle[:, last], grip[:, last])
            if luck is not None:
                move = move + luck * torch.cat((strayed[..., :1], strayed), -1)
            now = torch.cat((now[..., :2] + move[..., :2], now[..., 2:3], now[..., 3:] + move[..., 2:]), -1)
            doubt = doubt + strayed
            way.append(now)
            doubts.append(doubt)
        return torch.stack(way, 1), torch.stack(doubts, 1)

    def _frame(self, places: Tensor, tips: Tensor, paddle: Tensor, grip: Tensor) -> tuple[Tensor, Tensor]:
        """Motion [B, S, 3] (x, y, heading) over one frame and its standard deviations [B, S, 2].

        Args:
            tips: [B, P + 1, 2, 3] fingertips as commanded, the frame to come last; paddle, grip: [B, 2] the hands' headings and grippers.
        """
        gap = tips[:, None] - places[:, :, None, None, :3]  # [B, S, P + 1, 2, 3]
        around = torch.stack((gap[..., -2, :, :2], gap[..., -2:, :, :2].mean(-3), gap[..., -1, :, :2])).norm(dim=-1).amin(0)
        gate = ((_REACH - around) / _EDGE).clamp(0, 1)  # [B, S, 2]; NaN places pass nothing on
        moves, doubts = torch.zeros((*gate.shape, 3), device=gate.device), torch.zeros((*gate.shape, 2), device=gate.device)
        row, number, hand = (gate > 0).nonzero(as_tuple=True)
        if len(row):
            sides = self.sides[number]
            heading = torch.nan_to_num(places[row, number, 3]) * (sides > 0)
            near = gap[row, number, :, hand]  # [N, P + 1, 3]
            bearing = torch.atan2(near[:, -2, 1], near[:, -2, 0]) - heading
            front = heading + bearing - turn(bearing, sides)  # the direction of the side before which the fingertip is
            near = torch.cat((_rotated(near[..., :2], -front[:, None]), near[..., 2:]), -1)
            mirror = torch.where(near[:, -2, 1] < 0, -1.0, 1.0)
            near = near * torch.stack((torch.ones_like(mirror), mirror, torch.ones_like(mirror)), -1)[:, None]
            turned = 2 * (paddle[row, hand] - front)
            which = nn.functional.one_hot(number, gate.shape[1]).float()
            # Near the object millimetres count, far from it only the direction does.
            told = torch.cat((10 * near.flatten(1), (40 * near).clamp(-3, 3).flatten(1), turned.cos()[:, None], (mirror * turned.sin())[:, None], grip[row, hand][:, None], which), -1)
            out = self.layers(told)
            open_ = gate[row, number, hand][:, None]
            place = _rotated(torch.stack((out[:, 0], mirror * out[:, 1]), -1), front)
            moves = moves.index_put((row, number, hand), open_ * torch.cat((0.05 * place, 0.3 * mirror[:, None] * out[:, 2:3]), -1))
            doubts = doubts.index_put((row, number, hand), open_ * torch.tensor([0.01, 0.1], device=gate.device) * (out[:, 3:] - 2).clamp(max=_WILD).exp())
        return moves.sum(2), doubts.sum(2)

    def loss(self, objects: Tensor, motion: TensorDict) -> tuple[Tensor, dict[str, Tensor]]:
        """Centimetres by which objects are missed on their way, and how badly that was foreseen.

        Args:
            objects: [B, 1 + K, S, 4] now and ahead; motion: the commands of ClipStore.motions beside them.
        """
        begin = objects[:, 0]
        ahead = torch.where(torch.isfinite(begin[:, None, :, :3]).all(-1, keepdim=True), objects[:, 1:], torch.nan)
        way, doubt = self.foresee(torch.nan_to_num(begin), motion["recent"], motion["future", "commands"])
        moved = mean_gap(way[..., :3] - ahead[..., :3])
        askew = turn(way[..., 3] - ahead[..., 3], self.sides)
        known = torch.isfinite(askew) & (self.sides > 0)
        turned = (torch.nan_to_num(askew).abs() * known).sum() / known.sum().clamp(min=1)
        # The doubt is fitted to the error as it is; the other way round, doubt would excuse errors.
        there = torch.isfinite(ahead[..., :3]).all(-1)
        off = torch.nan_to_num(way[..., :2].detach() - ahead[..., :2]).square().sum(-1) / 2
        surprise = _surprise(off, doubt[..., 0], 1e-4, there) + _surprise(torch.nan_to_num(askew.detach()).square(), doubt[..., 1], 1e-3, known)
        return moved + 100 * _LEVER * turned + 0.1 * surprise, {"way_cm": moved.detach(), "turn_rad": turned.detach(), "surprise": surprise.detach()}

    @torch.no_grad()
    def calibrate(self, objects: Tensor, motion: TensorDict) -> None:
        """Set `spread` by motions that were not learned from; errors there are larger than in training. Arguments as those of loss."""
        way, doubt = self.foresee(torch.nan_to_num(objects[:, 0]), motion["recent"], motion["future", "commands"])
        strayed = ((way - objects[:, 1:])[:, -1, :, :2] / doubt[:, -1, :, :1]).square()
        # Only where something is in doubt: what lies still is foreseen to a hair either way.
        strayed = strayed[(doubt[:, -1, :, :1].expand_as(strayed) > 1e-3) & torch.isfinite(strayed)]
        self.spread.fill_(float(strayed.mean().sqrt().clamp(0.5, 3.0)) if len(strayed) else 1.0)


def _rotated(vectors: Tensor, angle: Tensor) -> Tensor:
    """Vectors [..., 2] turned by angles [...] in radians."""
    cos, sin = angle.cos(), angle.sin()
    return torch.stack((cos * vectors[..., 0] - sin * vectors[..., 1], sin * vectors[..., 0] + cos * vectors[..., 1]), -1)


def _surprise(error: Tensor, doubt: Tensor, floor: float, known: Tensor) -> Tensor:
    """Mean negative log-likelihood, but for a constant, of squared errors under doubts, where known."""
    value = (error / (doubt.square() + floor**2) / 2 + (doubt + floor).log()) * known
    return value.sum() / known.sum().clamp(min=1)
