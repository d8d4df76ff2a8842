"""Generated frames beside the recorded ones that the same actions led to, and a simulator's features of
either.
"""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torch import Tensor

from envs.episodes.clips import ClipStore
from envs.initial_states import decision_points
from envs.simulators.base import Simulator
from envs.simulators.features import features_of_chunks, pooled_size
from envs.simulators.replay import replay


def generated_frames(
    simulator: Simulator, store: ClipStore, episodes: Tensor, bf16: bool, alone: int | None = None
) -> TensorDict:
    """Frames that a simulator generates under the recorded actions of some episodes.

    Judges learn from them what generated video looks like, labelled by what truly happened.

    Args:
        alone: see replay.

    Returns:
        TensorDict [N] with frames uint8 [V, 3, H, W], row int64, that of the recorded frame, episode int64,
        and of the chunk that made the frame features float32 [D], pooled, and offset int64, the frame's place
        in it.
    """
    episodes = episodes[store.length[episodes] > 1]  # nothing follows the first frame of others
    if not len(episodes):
        views = (0, store.spec.views, 3, *store.spec.size)
        none = torch.zeros(0, dtype=torch.int64)
        frames = torch.zeros(views, dtype=torch.uint8)
        known = {"features": torch.zeros(0, pooled_size(simulator.feature_shape)), "offset": none}
        return TensorDict({"frames": frames, "row": none, "episode": none, **known}, [0])
    made = replay(simulator, store, episodes, bf16=bf16, alone=alone)
    keep = (made.valid & store.arrays["present"][made.rows]).flatten()
    at = torch.arange(made.valid.shape[1])
    return TensorDict(
        {
            "frames": made.frames.flatten(0, 1)[keep],
            "row": made.rows.flatten()[keep],
            "episode": episodes.repeat_interleave(len(at))[keep],
            "features": made.features[:, at // store.spec.chunk].flatten(0, 1)[keep],
            "offset": (at % store.spec.chunk).repeat(len(episodes))[keep],
        },
        [int(keep.sum())],
    )


def recorded_features(simulator: Simulator, store: ClipStore, episodes: Tensor, bf16: bool) -> TensorDict:
    """What a simulator's features say of the recorded frames of some episodes: each frame's own chunk of
    recorded actions, and for frames that begin a chunk also one that would change nothing, which is all that
    there is before the first action.

    Returns:
        TensorDict [N] with row int64, features float32 [D], pooled, and offset int64, the frame's place in
        the chunk.
    """
    chunk = store.spec.chunk
    episode, begin = decision_points(store, episodes)
    led = features_of_chunks(simulator, store, episode, begin, bf16)
    still = features_of_chunks(simulator, store, episode, begin, bf16, still=True)
    ahead = begin[:, None] + 1 + torch.arange(chunk)
    keep = (ahead < store.length[episode][:, None]).flatten()
    rows = store.start[episode]
    after = {
        "row": (rows[:, None] + ahead).flatten()[keep],
        "features": led.repeat_interleave(chunk, 0)[keep],
        "offset": torch.arange(chunk).repeat(len(episode))[keep],
    }
    now = {"row": rows + begin, "features": still, "offset": torch.zeros_like(begin)}
    return torch.cat([TensorDict(after, [int(keep.sum())]), TensorDict(now, begin.shape)])
