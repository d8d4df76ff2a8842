"""Loss weights from pixels alone."""

from __future__ import annotations

from torch import Tensor


def foreground_weight(frames: Tensor, gain: float) -> Tensor:
    """Loss weights [..., 1, H, W] that lift whatever differs from the picture's median colour, most of all in
    hue.

    Things to be moved cover one per cent of the pixels, arms ten: unweighted losses are won by the background
    alone, and losses that ask for any difference by the arms.

    Args:
        frames: float [..., 3, H, W] in 0..1.
        gain: weight of a pixel of a fully different hue, above the 1 of the median colour; a grey difference
            gets a twelfth.
    """
    gap = frames - frames.flatten(-2).median(-1).values[..., None, None]
    grey = gap.mean(-3, keepdim=True)
    hue = ((gap - grey).abs().amax(-3, keepdim=True) * 4).clamp(max=1.0)
    return 1.0 + gain * (hue + (grey.abs() * 2.5).clamp(max=1.0) / 12)
