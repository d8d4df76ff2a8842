"""What an autoencoder loses of a picture, kept for the pictures that follow it."""

from __future__ import annotations

from torch import Tensor

_GONE = 0.12  # change of a decoded pixel by which nothing of what was there is left


def restore_detail(made: Tensor, seen: Tensor, last: Tensor) -> Tensor:
    """Frames that follow a known one, with what the decoder had lost of that one wherever it stays.

    What stands still stays as it was; where the decoder says that something else has come, it has the word
    alone, or what was there before would shine through. Decoded as they are, all frames would be no sharper
    than the autoencoder, and a world that knows everything no better than its reconstruction.

    Args:
        made: float [B, K, V, 3, H, W] in 0..1, the frames as decoded.
        seen: [B, 1, V, 3, H, W], the known frame encoded and decoded.
        last: [B, 1, V, 3, H, W], the known frame.
    """
    stays = (1 - (made - seen).abs().amax(3, keepdim=True) / _GONE).clamp(min=0)
    return made + stays * (last - seen)
