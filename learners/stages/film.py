"""A video of what a simulator draws, every now and then while it learns."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch

from envs.episodes.clips import ClipStore
from envs.episodes.filming import side_by_side, tiled, titled, write_film
from envs.simulators.base import Simulator
from envs.simulators.replay import replay
from learners.training.parallel import leads

_CHUNKS = 16  # of a video at most, for recordings may be long


@dataclass(frozen=True)
class Film:
    """Replays the first held-out episode that begins with a picture, or the first such of all if none is held
    out, and leaves a video of it: media/held-out-step000400.mp4 or media/learned-from-step000400.mp4,
    imagined above, recorded below.

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
        label, some = ("held-out", held) if len(held) else ("learned-from", torch.arange(len(self.store)))
        begun = self.store.arrays["present"][self.store.start[some]]
        episode = some[begun & (self.store.length[some] > 1)][:1]
        if not len(episode):
            return  # of none there is a first picture that something follows
        made = replay(self.simulator, self.store, episode, bf16=self.bf16, most=_CHUNKS)
        valid = made.valid[0]
        videos = (made.frames[0][valid], self.store.frames(made.rows[0][valid]))
        if leads():
            pictures = [
                titled(side_by_side(video.numpy()), words)
                for video, words in zip(videos, ("imagined", "recorded"), strict=True)
            ]
            path = self.folder / f"media/{label}-step{step:06d}.mp4"
            write_film(path, tiled(pictures), self.store.fps)
