"""Each pixel is one of its sources: remembered, moved, or drawn.

A mixture with one component a source, learned by its likelihood. A mean over sources would fade whatever it
is not sure of, and what has faded once is gone for the rest of an episode; a choice keeps things sharp.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

DRAWN = 4  # maps of the drawn source: its logit and its colour
LOGIT_GAIN = 3.0  # on the choice between sources, so that it soon becomes one
_REACH = 8.0  # pixels that one unit of flow moves
_CHANGE = 0.25  # of 0..1: a pixel that differs by so much counts as changed in full
_SPREAD = 0.1  # of the mixture's Laplace densities, over the three channels' summed difference, of 0..1
_APART = 0.3  # summed difference from which two colours are simply different


def compose(maps: Tensor, flow: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
    """What each pixel may be, and how likely.

    Args:
        maps: [B, K, M + 1 + DRAWN, H, W]: logits of the M remembered frames, the moved and the drawn one,
            then the drawn colour in about -1..1.
        flow: [B, K, 2, H, W] from a frame to the last remembered one (x, y).
        memory: [B, M, 3, H, W] remembered frames in 0..1, the last one last.

    Returns:
        Colours [B, K, M + 2, 3, H, W] in about 0..1, and their log-probabilities [B, K, M + 2, H, W].
    """
    count, chunk, height, width = memory.shape[1], maps.shape[1], *maps.shape[-2:]
    # Split, not sliced: the gradient of a slice is a full map of zeros.
    logits, colour = maps.split((count + 2, 3), 2)
    step = 2 * _REACH / torch.tensor([width, height], device=maps.device)
    grid = torch.addcmul(pixel_grid(height, width, maps.device), flow.permute(0, 1, 3, 4, 2), step)
    # All frames of a chunk are sampled from one picture: stack them as rows of one tall grid.
    moved = F.grid_sample(memory[:, -1], grid.flatten(1, 2), padding_mode="border", align_corners=False)
    moved = moved.unflatten(2, (chunk, height)).transpose(1, 2)
    known = memory[:, None].expand(-1, chunk, -1, -1, -1, -1)
    colours = torch.cat((known, moved[:, :, None], 0.5 + 0.5 * colour[:, :, None]), 2)
    return colours, (LOGIT_GAIN * logits).log_softmax(2)


def surprise(colours: Tensor, logs: Tensor, frames: Tensor) -> Tensor:
    """Negative log-likelihood [B, K, 1, H, W] of frames [B, K, 3, H, W] in nats, but for a constant."""
    gap = (colours - frames[:, :, None]).abs().sum(3) / _SPREAD
    return -(logs - gap).logsumexp(2, keepdim=True)


def choose(colours: Tensor, logs: Tensor) -> Tensor:
    """Frames [B, K, 3, H, W]: of every pixel's sources the one that the others agree with most.

    The likeliest alone would be wrong: sources that say the same, as all do of a background, share their
    probability. Gradients are those of the mixture's mean.
    """
    likely = logs.exp()
    with torch.no_grad():
        frames, least = colours[:, :, 0], None
        for colour in colours.unbind(2):
            apart = (colours - colour[:, :, None]).abs_().sum(3).mul_(1 / _APART).clamp_(max=1)
            cost = (likely * apart).sum(2, keepdim=True)  # torch's argmin takes longer than all of this
            frames = colour if least is None else torch.where(cost < least, colour, frames)
            least = cost if least is None else torch.minimum(cost, least)
    mean = (colours * likely[:, :, :, None]).sum(2)
    return frames.detach() + (mean - mean.detach())


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
