"""Recorded episodes as a rollout: what a critic can learn of the true world before it judges its first
imagined one.
"""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torch import Tensor

from actors.policies.vla import VISUAL_FEATURES, Perception
from envs.episodes.clips import ClipStore
from envs.specs import STATE, Rewards


@torch.no_grad()
def looked_at(
    perception: Perception, store: ClipStore, rows: Tensor, tokens: Tensor, batch: int = 512
) -> Tensor:
    """What perception makes of frames of a store, rows [N], with instructions tokens [N, WORDS]: float32 [N,
    out_features].
    """
    return torch.cat(
        [
            perception(store.frames(some), words)
            for some, words in zip(rows.split(batch), tokens.split(batch), strict=True)
        ]
    )


@torch.no_grad()
def dataset_rollout(
    perception: Perception, store: ClipStore, episodes: Tensor, rewards: Rewards, chunk: int
) -> TensorDict:
    """Episodes of a store, decision by decision, as a rollout that GAE reads.

    Args:
        perception: of the policy, as it will stay.
        episodes: numbers [N].
        chunk: frames per decision, K.

    Returns:
        TensorDict [N, T] with what is seen and the joint state of each decision and of what followed, reward,
        ends, and
        `valid` bool [N, T], false past an episode's end.
    """
    last = store.length[episodes] - 1
    steps = int((last.max() + chunk - 1) // chunk)
    # [N, T + 1]; past the end the last frame stays
    at = torch.minimum(torch.arange(steps + 1) * chunk, last[:, None])
    rows = store.start[episodes][:, None] + at
    seen = looked_at(
        perception, store, rows.flatten(), store.tokens[episodes].repeat_interleave(steps + 1, 0)
    ).unflatten(0, rows.shape)
    states, progress, success = (
        store.arrays[name][rows].float() for name in ("states", "progress", "success")
    )
    valid, over = at[:, :-1] < last[:, None], at[:, 1:] == last[:, None]
    won = (success[:, 1:] > 0.5) & over
    out = TensorDict(
        {VISUAL_FEATURES: seen[:, :-1], STATE: states[:, :-1], "valid": valid}, [len(rows), steps]
    )
    out["next"] = TensorDict(
        {
            VISUAL_FEATURES: seen[:, 1:],
            STATE: states[:, 1:],
            "reward": rewards(progress[:, :-1, None], progress[:, 1:, None], won[..., None]),
            "done": over[..., None],
            "terminated": won[..., None],
        },
        out.shape,
    )
    return out
