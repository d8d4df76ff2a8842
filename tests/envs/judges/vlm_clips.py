"""What the tests of judge=vlm show it, and how they ask."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from envs.judges import Judgement
from envs.judges.vlm import VLMJudge
from envs.judges.vlm.ledger import _ledger
from tests.embodiments import ARM_DELTAS, world_spec
from tests.moving_square import SIZE, picture

SPEC = world_spec(ARM_DELTAS.at(SIZE), SIZE)  # two cameras, chunks of four frames
FIRST = torch.from_numpy(picture(np.zeros(2), 2))
DONE, FAR = 0.95, 0.2  # places of the square
Make = Callable[..., VLMJudge]


def new_command() -> None:
    """What a process knows is gone; what lies on disk stays."""
    _ledger.cache_clear()


def clip(*places: float) -> Tensor:
    """Frames uint8 [1, T, 2, 3, 32, 32] with the square at these places of the diagonal."""
    return torch.from_numpy(np.stack([picture(np.array([at, at]), 2) for at in places]))[None]


def score(judge: VLMJudge, *clips: Tensor) -> Judgement:
    frames = torch.cat(clips)
    return judge.score(frames, FIRST.expand(len(frames), -1, -1, -1, -1), ["move the square"] * len(frames))
