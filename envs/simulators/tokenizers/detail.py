"""What an autoencoder loses of a picture, kept for the pictures that follow it."""

from __future__ import annotations

from torch import Tensor


def restore_detail(made: Tensor, seen: Tensor, last: Tensor) -> Tensor:
    """Frames that follow a known one: the known one itself, and what the decoder says has changed since.

    What stands still stays as it was. Decoded as they are, all frames would be no sharper than the
    autoencoder, and a world that knows everything no better than its reconstruction.

    Args:
        made: float [B, K, V, 3, H, W] in 0..1, the frames as decoded.
        seen: [B, 1, V, 3, H, W], the known frame encoded and decoded.
        last: [B, 1, V, 3, H, W], the known frame.
    """
    return made + (last - seen)
