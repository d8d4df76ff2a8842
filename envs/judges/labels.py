"""Targets of judges and critics, from recorded success and time alone."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor


def success_labels(success: Tensor, hold: int) -> Tensor:
    """Which frames show success, float32 [..., T] in {0, 1}, from recorded success bool [..., T].

    Recorded success turns true once the task has been done for a while. The task counts as done from `hold -
    1` frames before that to the episode's end, so that `hold` frames in a row are successes when the record
    says so.
    """
    ever = success.to(torch.int64).cummax(-1).values.float()
    rows = ever.reshape(-1, ever.shape[-1])
    return F.pad(rows, (0, hold - 1), mode="replicate")[:, hold - 1 :].reshape(ever.shape)


def progress_to_success(success: Tensor, discount: float) -> Tensor:
    """How near success is, float32 [..., T] in 0..1, from success [..., T] of whole episodes.

    discount ** (frames until the first success), 1 from then on; 0 throughout episodes without success. This
    is the value of a reward of 1 at success under that discount, had the episode's policy been followed.

    Raises:
        ValueError: if discount is not in 0..1.
    """
    if not 0 < discount <= 1:
        raise ValueError(f"discount={discount} must be above 0 and at most 1")
    done = success > 0.5
    frames = done.shape[-1]
    begins = torch.where(done.any(-1), done.to(torch.int64).argmax(-1), frames)
    ahead = (begins[..., None] - torch.arange(frames, device=success.device)).clamp(min=0)
    return torch.where(done.any(-1, keepdim=True), discount ** ahead.float(), 0.0)
