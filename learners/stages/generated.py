"""Generated frames beside the recorded ones that the same actions led to."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torch import Tensor

from envs.episodes.clips import ClipStore
from envs.simulators.base import Simulator
from envs.simulators.replay import replay


def generated_frames(
    simulator: Simulator, store: ClipStore, episodes: Tensor, bf16: bool, alone: int | None = None
) -> TensorDict:
    """Frames that a simulator generates under the recorded actions of some episodes.

    Judges learn from them what generated video looks like, labelled by what truly happened; policies learn to
    act on them as on recorded ones.

    Args:
        alone: see replay.

    Returns:
        TensorDict [N] with frames uint8 [V, 3, H, W], row int64, that of the recorded frame, and episode
        int64.
    """
    if not len(episodes):
        views = (0, store.spec.views, 3, *store.spec.size)
        none = torch.zeros(0, dtype=torch.int64)
        frames = torch.zeros(views, dtype=torch.uint8)
        return TensorDict({"frames": frames, "row": none, "episode": none}, [0])
    made = replay(simulator, store, episodes, bf16=bf16, alone=alone)
    keep = (made.valid & store.arrays["present"][made.rows]).flatten()
    owner = episodes.repeat_interleave(made.valid.shape[1])
    return TensorDict(
        {
            "frames": made.frames.flatten(0, 1)[keep],
            "row": made.rows.flatten()[keep],
            "episode": owner[keep],
        },
        [int(keep.sum())],
    )
