"""A video of what a simulator draws, every now and then while it learns."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from envs.episodes.clips import ClipStore
from envs.episodes.video import write_video
from envs.files import atomic
from envs.simulators.base import Simulator
from envs.simulators.replay import replay
from learners.training.parallel import leads

_CHUNKS = 16  # of a video at most, for recordings may be long
_HEIGHT = 192  # pixels of a view, about


@dataclass(frozen=True)
class Film:
    """Replays the first held-out episode, or the first one if none is held out, and leaves a video of it:
    media/held-out-step000400.mp4 or media/learned-from-step000400.mp4, imagined above, recorded below.

    Args:
        simulator: which learns.
        store: of recordings.
        folder: of the stage.
        bf16: as in `replay`.
    """

    simulator: Simulator
    store: ClipStore
    folder: Path
    bf16: bool

    def __call__(self, step: int) -> None:
        """Film what it draws after so many steps; every worker calls."""
        held = self.store.split("held_out")
        label, episode = ("held-out", held[:1]) if len(held) else ("learned-from", torch.tensor([0]))
        if int(self.store.length[episode]) < 2:
            return  # nothing follows its first picture
        made = replay(self.simulator, self.store, episode, bf16=self.bf16, most=_CHUNKS)
        valid = made.valid[0]
        recorded = self.store.frames(made.rows[0][valid])
        if leads():
            pictures = _stacked(made.frames[0][valid], recorded)
            with atomic(self.folder / f"media/{label}-step{step:06d}.mp4") as part:  # trackers send all mp4
                write_video(part, pictures, self.store.fps, crf=20, browser=True)


def _stacked(imagined: Tensor, recorded: Tensor) -> list[NDArray[np.uint8]]:
    """Pictures [H, W, 3] of even size of frames uint8 [T, V, 3, H, W], all views side by side."""
    scale = max(1, round(_HEIGHT / imagined.shape[-2]))
    both = torch.stack((imagined, recorded), 1).permute(0, 1, 4, 2, 5, 3)  # [T, 2, H, V, W, 3]
    rows = both.reshape(len(both), 2 * imagined.shape[-2], -1, 3)
    big = rows.repeat_interleave(scale, 1).repeat_interleave(scale, 2)
    return list(big[:, : big.shape[1] // 2 * 2, : big.shape[2] // 2 * 2].numpy())
