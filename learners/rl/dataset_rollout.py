"""Recorded episodes as a rollout: what a critic can learn of the true world before it judges its first
imagined one.

Rewards are those that a perfect judge would have given: from the recorded success and time alone.
"""

from __future__ import annotations

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase

from actors.policies.contract import VISUAL_FEATURES, feature_part, inputs_for, writes_features
from envs.episodes.clips import ClipStore
from envs.judges.labels import progress_to_success
from envs.specs import IMAGE, INSTRUCTION_UTF8, STATE, Rewards
from learners.stages.observed import observe

_AT_ONCE = 512  # frames per pass


@torch.no_grad()
def dataset_rollout(
    policy: TensorDictModuleBase,
    store: ClipStore,
    episodes: torch.Tensor,
    rewards: Rewards,
    discount: float,
) -> TensorDict:
    """Episodes of a store, decision by decision, as a rollout that GAE reads.

    Args:
        policy: whose visual features the critic reads; of one that writes none, pictures and text are given.
        episodes: labelled ones, int64 [N].
        discount: per frame, of progress towards success; the judge's, if it learns progress by one.

    Returns:
        TensorDict [N, T] with what critics read of each decision and of what followed, reward, ends, `row`
        int64 [N, T], the decision's frame, `valid` bool [N, T], false past an episode's end, and `whole` bool
        [N, T], true where the chunk was carried out to its end.

    Raises:
        ValueError: if nobody said whether an episode succeeded.
    """
    if not bool(store.arrays["labelled"][episodes].all()):
        raise ValueError("a critic learns from episodes that were labelled with success; choose those")
    chunk, last = store.spec.chunk, store.length[episodes] - 1
    steps = int((last.max() + chunk - 1) // chunk)
    at = torch.minimum(torch.arange(steps + 1) * chunk, last[:, None])  # past the end the last frame stays
    rows = store.start[episodes][:, None] + at
    seen = _observed(policy, store, rows)
    success, progress = _labels(store, episodes, discount)
    success, progress = success.gather(1, at), progress.gather(1, at)
    over = at[:, 1:] == last[:, None]
    won = (success[:, 1:] > 0.5) & over
    out = seen[:, :-1].copy()
    out["row"], out["valid"] = rows[:, :-1], at[:, :-1] < last[:, None]
    out["whole"] = at[:, :-1] + chunk <= last[:, None]
    out["next"] = seen[:, 1:].copy()
    out["next", "reward"] = rewards(progress[:, :-1, None], progress[:, 1:, None], won[..., None])
    out["next", "done"], out["next", "terminated"] = over[..., None], won[..., None]
    return out


def _labels(store: ClipStore, episodes: torch.Tensor, discount: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Success and progress of every frame, float32 [N, longest], the last one repeated."""
    length = store.length[episodes]
    frame = torch.minimum(torch.arange(int(length.max())), length[:, None] - 1)
    success = store.arrays["success"][store.start[episodes][:, None] + frame].float()
    return success, progress_to_success(success, discount)


def _observed(policy: TensorDictModuleBase, store: ClipStore, rows: torch.Tensor) -> TensorDict:
    """What critics read of frames [N, T], as a TensorDict [N, T]."""
    parts = []
    for some in rows.flatten().split(_AT_ONCE):
        part = observe(store, some)
        if writes_features(policy):
            features = feature_part(policy)(inputs_for(part, policy))[VISUAL_FEATURES].cpu()
            part = part.select(STATE)
            part[VISUAL_FEATURES] = features
        else:
            part = part.select(IMAGE, INSTRUCTION_UTF8, STATE)
        parts.append(part)
    return torch.cat(parts).reshape(*rows.shape)
