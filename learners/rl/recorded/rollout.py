"""Recorded episodes as a rollout: what a critic can learn of the true world before it judges its first
imagined one.

Success is the recorded one. Progress is what the judge sees in a frame, as in imagination, and not how soon
this episode truly succeeds: that depends on what the policy did next, so paying its change takes from an
action what it achieves itself, and the slower of two successes would be worth more.
"""

from __future__ import annotations

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase

from actors.policies.contract import VISUAL_FEATURES, feature_part, inputs_for, writes_features
from envs.episodes.clips import ClipStore
from envs.judges.base import Judge, ask
from envs.specs import IMAGE, INSTRUCTION_UTF8, STATE, Rewards, Status
from learners.stages.observed import observe

_AT_ONCE = 512  # frames per pass
_SIDE_BY_SIDE = 32  # episodes that a judge is shown


@torch.no_grad()
def dataset_rollout(
    policy: TensorDictModuleBase,
    store: ClipStore,
    episodes: torch.Tensor,
    rewards: Rewards,
    judge: Judge | None = None,
    features: torch.Tensor | None = None,
) -> TensorDict:
    """Episodes of a store, decision by decision, as a rollout that GAE reads.

    Args:
        policy: whose visual features the critic reads; of one that writes none, pictures and text are given.
        episodes: labelled ones, int64 [N].
        judge: says how far the task is wherever a decision is taken; where the record says success, progress
            is 1. None, and where progress is worth nothing: success alone is paid.
        features: float32 [N, 1 + C, D] of a judge that reads them: of the first frame, while nothing is done,
            then of the C chunks of the longest episode; see simulators.features.

    Returns:
        TensorDict [N, T] with what critics read of each decision and of what followed, reward, ends, `row`
        int64 [N, T], the decision's frame, `valid` bool [N, T], false past an episode's end, and `whole` bool
        [N, T], true where the chunk was carried out to its end.

    Raises:
        ValueError: if nobody said whether an episode succeeded.
    """
    paid = paid_decisions(store, episodes, rewards, judge, features)
    seen = _observed(policy, store, paid["row"])
    out = seen[:, :-1].copy()
    out["row"], out["valid"], out["whole"] = paid["row"][:, :-1], paid["valid"], paid["whole"]
    out["next"] = seen[:, 1:].copy()
    for key in ("reward", "done", "terminated"):
        out["next", key] = paid[key][..., None]
    return out


def paid_decisions(
    store: ClipStore,
    episodes: torch.Tensor,
    rewards: Rewards,
    judge: Judge | None = None,
    features: torch.Tensor | None = None,
) -> dict[str, torch.Tensor]:
    """What was paid for the decisions of recorded episodes; arguments and errors are dataset_rollout's.

    Returns:
        By name: row int64 [N, T + 1], of each decision's frame and of the last one's outcome; progress
        float32 [N, T], that the judge sees there; reward float32 [N, T]; done, terminated, valid and
        whole bool [N, T].
    """
    if not bool(store.arrays["labelled"][episodes].all()):
        raise ValueError("a critic learns from episodes that were labelled with success; choose those")
    chunk, last = store.spec.chunk, store.length[episodes] - 1
    steps = int((last.max() + chunk - 1) // chunk)
    at = torch.minimum(torch.arange(steps + 1) * chunk, last[:, None])  # past the end the last frame stays
    rows = store.start[episodes][:, None] + at
    over = at[:, 1:] == last[:, None]
    won = (store.arrays["success"][rows[:, 1:]] > 0.5) & over
    progress = torch.zeros(at.shape)
    after = progress[:, 1:]
    if judge is not None and rewards.progress:
        progress = _seen_progress(judge, store, episodes, at, features)
        after = torch.where(won, 1.0, progress[:, 1:])
    return {
        "row": rows,
        "progress": progress[:, :-1],
        "reward": rewards(progress[:, :-1, None], after[..., None], won[..., None]).squeeze(-1),
        "done": over,
        "terminated": won,
        "valid": at[:, :-1] < last[:, None],
        "whole": at[:, :-1] + chunk <= last[:, None],
    }


def _seen_progress(
    judge: Judge, store: ClipStore, episodes: torch.Tensor, at: torch.Tensor, features: torch.Tensor | None
) -> torch.Tensor:
    """Progress float32 [N, T] that a judge sees in frames `at` int64 [N, T] of episodes; where it knows
    nothing it stays what it was, 0 at first.
    """
    parts = []
    for some in torch.arange(len(episodes)).split(_SIDE_BY_SIDE):
        mine, when, opening = episodes[some], at[some], store.start[episodes[some]][:, None]
        if features is None:
            parts.append(_told(judge, store, mine, opening + when))
            continue
        read = features[some]  # of whole chunks, all frames of which are shown
        first = _told(judge, store, mine, opening, read[:, :1])
        others = _told(judge, store, mine, store.whole(mine)[0], read[:, 1:])
        parts.append(torch.cat((first, others), 1).gather(1, when))
    out = torch.cat(parts)
    out[:, 0] = torch.nan_to_num(out[:, 0])
    for t in range(1, out.shape[1]):
        out[:, t] = torch.where(torch.isfinite(out[:, t]), out[:, t], out[:, t - 1])
    return out


def _told(
    judge: Judge,
    store: ClipStore,
    episodes: torch.Tensor,
    rows: torch.Tensor,
    features: torch.Tensor | None = None,
) -> torch.Tensor:
    """Progress float32 [N, T] in recorded frames `rows` [N, T]; NaN where the judge does not know."""
    device = judge.threshold.device
    first, texts = store.frames(store.start[episodes]), [store.instructions[n] for n in episodes.tolist()]
    read = () if features is None else (features.to(device),)
    said = ask(judge, store.frames(rows).to(device), first.to(device), texts, *read)
    known = (said.status == Status.OK.value)[:, None].cpu() & store.arrays["present"][rows]
    return torch.where(known, said.progress.float().cpu(), torch.nan)


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
