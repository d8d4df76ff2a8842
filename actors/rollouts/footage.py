"""What hosts show to people of the episodes that learners learn from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from tensordict import TensorDict

from envs.specs import SUCCESS
from envs.world import WorldEnv


@dataclass(frozen=True)
class Footage:
    """The end of an imagined episode.

    Args:
        frames: uint8 [T, V, 3, H, W].
        imagined: how many of them, the last ones, were generated; those before are recorded.
        success: whether the judge says that it has succeeded by the last one.
        fps: frames per second.
    """

    frames: NDArray[np.uint8]
    imagined: int
    success: bool
    fps: float


def footage(world: WorldEnv, rollout: TensorDict, episodes: int) -> tuple[Footage, ...]:
    """The first so many slots' newest episodes, each after a chunk of recorded frames at most.

    Args:
        world: which has just run the rollout.
        rollout: [B, T], judged.
    """
    succeeded = rollout["next", SUCCESS][:episodes, -1].flatten().tolist()
    imagined = world.elapsed[:episodes].tolist()
    return tuple(
        Footage(world.video(slot)[-(made + world.chunk) :].numpy(), made, won, world.spec.fps)
        for slot, (made, won) in enumerate(zip(imagined, succeeded, strict=True))
    )
