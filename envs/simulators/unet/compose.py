"""Each pixel is one of its sources: remembered, moved, or drawn.

A mixture with one component a source, learned by its likelihood. A mean over sources would fade whatever it
is not sure of, and what has faded once is gone for the rest of an episode; a choice keeps things sharp.
"""

from __future__ import annotations

from itertools import combinations
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

DRAWN = 4  # maps of the drawn source: its logit and its colour
LOGIT_GAIN = 3.0  # on the choice between sources, so that it soon becomes one
_REACH = 8.0  # pixels that one unit of flow moves
_CHANGE = 0.25  # of 0..1: a pixel that differs by so much counts as changed in full
_SPREAD = 0.1  # of the mixture's Laplace densities, over the three channels' summed difference, of 0..1
_APART = 0.3  # summed difference from which two colours are simply different
_MORE = 1e-4  # doubt by which a source loses to a later one; of equal ones rounding would choose


class Sources(NamedTuple):
    """What the pixels of a chunk may be, and how likely.

    colours: of each source float [B, K, 3, H, W] in about 0..1, or [B, 1, 3, H, W] if all frames share it;
    logs: log-probabilities [B, K, len(colours), H, W].
    flow: see compose.
    """

    colours: list[Tensor]
    logs: Tensor
    flow: Tensor


def compose(maps: Tensor, flow: Tensor, memory: Tensor) -> Sources:
    """The sources of a chunk's pixels.

    Args:
        maps: [B, K, M + 1 + DRAWN, H, W]: logits of the M remembered frames, the moved and the drawn one,
            then the drawn colour in about -1..1.
        flow: [B, K, 2, H, W] from a frame to the last remembered one (x, y).
        memory: [B, M, 3, H, W] remembered frames in 0..1, the last one last.
    """
    count = memory.shape[1]
    # Split, not sliced: the gradient of a slice is a full map of zeros.
    logits, colour = maps.split((count + 2, 3), 2)
    known, moved = [memory[:, number, None] for number in range(count)], move(memory[:, -1], flow, 1)
    return Sources([*known, moved, 0.5 + 0.5 * colour], (LOGIT_GAIN * logits).log_softmax(2), flow)


def move(picture: Tensor, flow: Tensor, scale: int) -> Tensor:
    """A picture [B, 3, scale H, scale W] along the flow [B, K, 2, H, W] of each frame: [B, K, 3, scale H,
    scale W].
    """
    chunk, height, width = flow.shape[1], *flow.shape[-2:]
    step = 2 * _REACH / torch.tensor([width, height], device=flow.device)  # of the picture's extent, 2
    if scale > 1:
        larger = F.interpolate(flow.flatten(0, 1), scale_factor=scale, mode="bilinear", align_corners=False)
        flow, height, width = larger.unflatten(0, flow.shape[:2]), scale * height, scale * width
    grid = torch.addcmul(pixel_grid(height, width, flow.device), flow.permute(0, 1, 3, 4, 2), step)
    # All frames of a chunk are sampled from one picture: stack them as rows of one tall grid.
    moved = F.grid_sample(picture, grid.flatten(1, 2), padding_mode="border", align_corners=False)
    return moved.unflatten(2, (chunk, height)).transpose(1, 2)


def surprise(sources: Sources, frames: Tensor) -> Tensor:
    """Negative log-likelihood [B, K, 1, H, W] of frames [B, K, 3, H, W] in nats, but for a constant."""
    gaps = torch.stack([_apart(colour, frames) for colour in sources.colours], 2)
    return -torch.sub(sources.logs, gaps, alpha=1 / _SPREAD).logsumexp(2, keepdim=True)


def choose(sources: Sources) -> tuple[Tensor, Tensor]:
    """Frames [B, K, 3, H, W]: of every pixel's sources the one that the others agree with most; and its
    position among them, int64 [B, K, H, W], which `enlarge` asks for. Of sources that say the same it is the
    first: at full size they may differ.

    The likeliest alone would be wrong: sources that say the same, as all do of a background, share their
    probability. Gradients are those of the mixture's mean.
    """
    colours, likely = sources.colours, sources.logs.exp()
    share = likely.unbind(2)
    with torch.no_grad():
        cost: list[Any] = [0.0] * len(colours)
        for one, other in combinations(range(len(colours)), 2):
            apart = _apart(colours[one], colours[other]).mul_(1 / _APART).clamp_(max=1)
            cost[one] = cost[one] + share[other] * apart
            cost[other] = cost[other] + share[one] * apart
        frames, least = colours[0].detach().expand(-1, likely.shape[1], -1, -1, -1), cost[0]
        chosen = torch.zeros_like(least, dtype=torch.int64)
        for number, (colour, doubt) in enumerate(zip(colours[1:], cost[1:], strict=True), 1):
            better = doubt < least - _MORE  # torch's argmin takes longer
            frames = torch.where(better[:, :, None], colour, frames)
            chosen.masked_fill_(better, number)
            least = torch.where(better, doubt, least)
    if not torch.is_grad_enabled():
        return frames, chosen
    mean = torch.stack([p[:, :, None] * colour for p, colour in zip(share, colours, strict=True)]).sum(0)
    return frames + (mean - mean.detach()), chosen


def enlarge(frames: Tensor, chosen: Tensor, flow: Tensor, memory: Tensor) -> Tensor:
    """Frames [B, K, 3, H, W] of a view at full size [B, K, 3, 2 H, 2 W]: what is remembered or has moved
    with all of their detail, what is drawn interpolated. Interpolation alone would blur a picture again in
    every chunk, for of what comes out a world sees the mean of each four pixels.

    Args:
        chosen: see choose.
        flow: of the sources, see compose.
        memory: remembered frames at full size, bytes [B, M, 3, 2 H, 2 W], the sources that come first.
    """
    size, lead = memory.shape[-2:], frames.shape[:2]
    smooth = F.interpolate(frames.flatten(0, 1), size, mode="bilinear", align_corners=False)
    smooth = smooth.unflatten(0, lead)
    with torch.no_grad():
        known = memory.float().div(255)
        where = F.interpolate(chosen.flatten(0, 1)[:, None].float(), size).unflatten(0, lead)
        # Four pixels of what has moved are on average what was chosen.
        moved = move(known[:, -1], flow, 2)
        lost = frames.flatten(0, 1) - F.avg_pool2d(moved.flatten(0, 1), 2)
        moved = moved + F.interpolate(lost, size).unflatten(0, lead)
        full = torch.where(where == known.shape[1], moved, smooth)
        for number, picture in enumerate(known.unbind(1)):
            full = torch.where(where == number, picture[:, None], full)
    return full + (smooth - smooth.detach()) if torch.is_grad_enabled() else full


def _apart(one: Tensor, other: Tensor) -> Tensor:
    """Summed difference [B, K, H, W] of colours [B, K, 3, H, W]."""
    return (one - other).abs().sum(2)


def changed(frames: Tensor, last: Tensor) -> Tensor:
    """How much pixels of frames [B, K, 3, H, W] differ from the frame before, [B, 3, H, W]: 0..1, [B, K, 1,
    H, W].
    """
    return ((frames - last[:, None]).abs().amax(2, keepdim=True) / _CHANGE).clamp(max=1)


def pixel_grid(height: int, width: int, device: torch.device) -> Tensor:
    """Middles of all pixels [H, W, 2] as (x, y) in -1..1, as grid_sample has them without aligned corners."""
    x = (torch.arange(width, device=device) * 2 + 1) / width - 1
    y = (torch.arange(height, device=device) * 2 + 1) / height - 1
    return torch.stack(torch.meshgrid(y, x, indexing="ij")[::-1], -1)
