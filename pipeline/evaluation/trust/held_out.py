"""Whether what RL learns from recorded decisions holds on episodes that it did not learn from.

What a policy gains over the one that RL began with is told, to first order, by decisions of the latter:
E[(r - 1) A], with likelihood ratios r and advantages A (Kakade and Langford 2002). On decisions that were
learned from the noise of A counts as gain, for the policy has learned it; on episodes left out it does not.
Decisions that the policy did not draw, but took at its mode, do not count: r is no ratio of densities there.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from envs.rng import order_generator
from envs.specs import LOG_PROB
from learners.rl.algorithm import Algorithm, RLConfig
from learners.rl.recorded.decisions import RecordedDecisions
from learners.training.parallel import clip_gradients
from pipeline.evaluation.trust.gradients import Measured

_OF_EPISODES = ("learned", "learned_tasks", "left_out", "left_out_tasks")
_AT_MOST = 10.0  # of a ratio, above which single decisions would decide


@dataclass(frozen=True)
class Moment:
    """What was learned after some steps, of all folds together.

    Args:
        steps: of learning.
        learned, left_out: gain per episode float32 [N], of those learned from and of those left out.
        learned_tasks, left_out_tasks: their tasks' numbers, int64 [N].
        kl: nats by which the policy has moved on decisions left out.
    """

    steps: int
    learned: Tensor
    learned_tasks: Tensor
    left_out: Tensor
    left_out_tasks: Tensor
    kl: float


def gains(ratio: Tensor, advantage: Tensor, task: Tensor, episode: Tensor) -> tuple[Tensor, Tensor]:
    """Gain float32 [E] and task int64 [E] of each episode, by its decisions [N]; advantages count beside the
    mean of their task's, so that no task gains by decisions that are likelier on the whole.
    """
    centred = advantage.float().clone()
    for each in task.unique():
        centred[task == each] -= centred[task == each].mean()
    each, place = episode.unique(return_inverse=True)
    total = torch.zeros(len(each)).index_add(0, place, (ratio.clamp(max=_AT_MOST) - 1) * centred)
    tasks = torch.zeros(len(each), dtype=torch.int64).index_copy(0, place, task)
    return total, tasks


def mean_gain(found: Tensor) -> Measured | None:
    """Mean of gains [N] of episodes and its standard error; None of fewer than two."""
    if len(found) < 2:
        return None
    return Measured(float(found.mean()), float(found.std() / len(found) ** 0.5))


def folds_of(episode: Tensor, own: Tensor, folds: int, seed: int) -> Tensor:
    """The fold int64 [N] of each decision, by its episode's number [N]; -1 of those that are not `own`
    bool [N], which are never left out.
    """
    fold, mine = torch.full_like(episode, -1), episode[own].unique()
    for place, number in enumerate(torch.randperm(len(mine), generator=order_generator(seed)).tolist()):
        fold[episode == mine[number]] = place % folds
    return fold


def learned_without(
    algorithm: Algorithm,
    decisions: RecordedDecisions,
    config: RLConfig,
    episode: Tensor,
    task: Tensor,
    left_out: Tensor,
    steps: Sequence[int],
) -> list[Moment]:
    """Learn from recorded decisions alone, as RL does beside imagined ones; the algorithm is left as it was.

    Args:
        episode, task: of each decision, int64 [N].
        left_out: of which nothing is learned, bool [N].
        steps: after which is looked, rising; the last ends it.
    """
    before = copy.deepcopy(algorithm.modules().state_dict())
    advantage, out = decisions.known["advantage"].squeeze(-1), []
    known = (~left_out).nonzero().squeeze(-1)
    drawn = decisions.drawn()
    counted = [(side & drawn).nonzero().squeeze(-1) for side in (~left_out, left_out)]
    for step in _learned(algorithm, decisions, config, known, steps):
        moved = decisions.likelihood() - decisions.known[LOG_PROB]
        sides = [gains(moved[some].exp(), advantage[some], task[some], episode[some]) for some in counted]
        out.append(Moment(step, *sides[0], *sides[1], kl=float(-moved[counted[1]].mean())))
    algorithm.modules().load_state_dict(before)
    return out


def packed(moments: Sequence[Moment]) -> dict[str, Tensor]:
    """Moments as files of tensors hold them."""
    out = {
        "steps": torch.tensor([moment.steps for moment in moments]),
        "kl": torch.tensor([moment.kl for moment in moments], dtype=torch.float64),
    }
    for place, moment in enumerate(moments):
        out |= {f"{name}-{place}": getattr(moment, name) for name in _OF_EPISODES}
    return out


def unpacked(held: Mapping[str, Tensor]) -> list[Moment]:
    """Moments out of what `packed` made of them."""
    steps, kl = held["steps"].tolist(), held["kl"].tolist()
    return [
        Moment(steps[place], **{name: held[f"{name}-{place}"] for name in _OF_EPISODES}, kl=kl[place])
        for place in range(len(steps))
    ]


def joined(folds: Sequence[Sequence[Moment]]) -> list[Moment]:
    """Moments of all folds together."""
    out = []
    for parts in zip(*folds, strict=True):
        found = {name: torch.cat([getattr(part, name) for part in parts]) for name in _OF_EPISODES}
        out.append(Moment(parts[0].steps, **found, kl=sum(part.kl for part in parts) / len(parts)))
    return out


def _learned(
    algorithm: Algorithm, decisions: RecordedDecisions, config: RLConfig, known: Tensor, steps: Sequence[int]
) -> Iterator[int]:
    """Learn from the decisions `known`; says when so many steps are done."""
    optimiser = torch.optim.Adam(algorithm.groups(config.lr), lr=config.lr, eps=1e-5)
    rates = [group["lr"] for group in optimiser.param_groups]
    draw = order_generator(config.seed)
    for step in range(steps[-1]):
        for group, rate in zip(optimiser.param_groups, rates, strict=True):
            group["lr"] = rate * (1 - step / steps[-1])
        pick = torch.randint(len(known), (config.minibatch,), generator=draw)
        optimiser.zero_grad(set_to_none=True)
        loss, _ = algorithm.loss(decisions.taken(known[pick]))
        loss.backward()
        for group in optimiser.param_groups:
            clip_gradients(group["params"], config.clip)
        optimiser.step()
        if step + 1 in steps:
            yield step + 1
