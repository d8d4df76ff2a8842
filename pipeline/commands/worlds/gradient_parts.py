"""Gradients of a round's imagined batches and of its recorded decisions, as they are kept."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor
from tqdm import tqdm

from actors.fleets.fleet import EpisodeLedger
from actors.fleets.launch import build_fleet
from actors.policies.contract import device_of, trained_part
from actors.rollouts.host import trained_weights
from envs.rng import order_generator
from envs.specs import EPISODE
from learners.rl.algorithm import sound
from learners.rl.feed import Feed, build_feed
from learners.rl.ppo import PPO
from learners.rl.recorded.decisions import RecordedDecisions
from pipeline.evaluation.by_task import tasks_of_episodes
from pipeline.evaluation.trust.gradients import policy_gradient
from pipeline.graph.kept import Tensors
from pipeline.stages.rl import Imagination

PARTS = 16  # of the recorded decisions
FEWEST = 2  # decisions of a part of which a gradient is taken
LAMBDA, TASK, COUNTS = "lambda ", "task ", "decisions of "  # begin the names of what is kept
Listed = dict[str, list[tuple[Tensor, int]]]


@contextmanager
def rollouts(ready: Imagination) -> Iterator[Callable[[int], TensorDict]]:
    """Gives imagined batches by number, of a fleet that begins with the first that is asked for."""
    settings = replace(ready.settings, schedule="sync")
    weights, feeds = trained_weights(ready.policy), list[Feed]()
    with ExitStack() as ended:

        def rollout(number: int) -> TensorDict:
            if not feeds:
                fleet = build_fleet(ready.recipe)
                ended.callback(fleet.close)
                fleet.ledger = EpisodeLedger()
                feeds.append(build_feed(fleet, ready.algorithm, settings, ready.starts))
            return feeds[0].gather(number, weights)[0].to(device_of(ready.algorithm.modules()))

        yield rollout


@dataclass(frozen=True)
class Parts:
    """Gradients of the policy that RL begins with, by name, and of how many decisions they are.

    Args:
        tasks: of the starts; [] of a single one.
    """

    ready: Imagination
    lams: Sequence[float | None]
    used: float | None
    tasks: Sequence[str]

    def imagined(self, batch: TensorDict) -> Tensors:
        """Of one batch."""
        out: Listed = {}
        for lam in self.lams:
            if lam is not None:
                self.ready.algorithm.credit(lam)  # type: ignore[attr-defined]
            data, _ = self.ready.algorithm.prepare(batch.clone())
            count, begun = self.ready.starts.count, batch[EPISODE]
            begun = (begun % count if count else begun).reshape(batch.shape)[sound(batch)]
            self._take(out, lam, data, begun)
        return _stacked(out)

    def recorded(self, cfg: Mapping[str, Any], decisions: RecordedDecisions) -> Tensors:
        """Of the recorded decisions, in parts."""
        algorithm, store, out = self.ready.algorithm, self.ready.store, Listed()
        order = torch.randperm(len(decisions), generator=order_generator(self.ready.settings.seed))
        episodes = torch.searchsorted(store.start, decisions.known["row"], right=True) - 1
        played, place = episodes.unique(return_inverse=True)
        named = replace(self, tasks=self.tasks and tasks_of_episodes(cfg, store, played))
        for lam in tqdm(self.lams, desc="recorded decisions", unit="lambda", leave=False):
            if isinstance(algorithm, PPO) and lam is not None:  # others keep the advantages that they gave
                algorithm.credit(lam)
                algorithm.value(self.ready.rollout)
                decisions.revalue(self.ready.rollout)
            for part in range(PARTS):
                some = order[part::PARTS]
                named._take(out, lam, decisions.taken(some), place[some])
        return _stacked(out)

    def _take(self, out: Listed, lam: float | None, data: TensorDict, begun: Tensor) -> None:
        """Add gradients of transitions [N], and of those of each task with the lambda in use.

        Args:
            begun: places in `tasks` of the transitions, int64 [N].
        """
        out.setdefault(f"{LAMBDA}{lam}", []).append(self._of(data))
        if lam is None or lam != self.used or not self.tasks:
            return
        known = [self.tasks[place] for place in begun.tolist()]
        for task in sorted(set(known)):
            mine = torch.tensor([number for number, name in enumerate(known) if name == task])
            if len(mine) >= FEWEST:
                out.setdefault(f"{TASK}{task}", []).append(self._of(data[mine]))

    def _of(self, data: TensorDict) -> tuple[Tensor, int]:
        policy = trained_part(self.ready.policy)
        minibatch = self.ready.settings.minibatch
        return policy_gradient(self.ready.algorithm, policy, data, minibatch), len(data)


def _stacked(listed: Listed) -> Tensors:
    """Gradients [M, P] by name, and of how many decisions each was, int64 [M]."""
    out: Tensors = {}
    for name, found in listed.items():
        out[name] = torch.stack([gradient for gradient, _ in found])
        out[f"{COUNTS}{name}"] = torch.tensor([count for _, count in found])
    return out
