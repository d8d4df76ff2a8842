"""Which tasks imagination may teach: not those in which it has been seen to be far kinder than the truth.

Before RL the deployed policy acts in imagination from starts whose true outcome is known (stage gap). Where
most succeeds that truly fails, whatever RL tries looks good, and what it learns moves the policy in all.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from envs.episodes.clips import ClipStore
from pipeline.evaluation.by_task import tasks_of_episodes
from pipeline.evaluation.result import result_of
from pipeline.graph.stage import Inputs
from pipeline.stages.given import Cfg


class Doubt:
    """What a gap, if there was one, says against imagining tasks.

    Args:
        gap: result of the stage gap, None without.
        least: how far the confidence interval of imagined success must lie above that of the true one.
    """

    def __init__(self, gap: Mapping[str, Any] | None, least: float):
        tasks = {} if gap is None else gap["tasks"] or {"": gap}  # "" for all starts, if there is one task
        self._kind = {
            task: one for task, one in tasks.items() if one["imagined"]["low"] - one["true"]["high"] > least
        }
        self._all = len(self._kind) == len(tasks)

    @classmethod
    def of(cls, inputs: Inputs, least: float) -> Doubt:
        """By the stage in the role gap, if somebody plays it."""
        return cls(result_of(inputs.folder("gap")) if "gap" in inputs.found else None, least)

    def trusted(self, cfg: Cfg, store: ClipStore, episodes: Tensor) -> Tensor:
        """Whether imagined episodes may begin in recorded ones int64 [N]: bool [N]; everywhere if all tasks
        are in doubt, for then there is nothing else to learn from.
        """
        if self._all or not self._kind:
            return torch.ones(len(episodes), dtype=torch.bool)
        return torch.tensor([task not in self._kind for task in tasks_of_episodes(cfg, store, episodes)])

    def alarms(self) -> list[str]:
        """What to know of tasks in doubt."""
        left = (
            "it is imagined all the same, as nothing else is"
            if self._all
            else "it is left out of imagination"
        )
        return [
            f"{task or 'the task'} succeeds in {_of(one['imagined'])} imagined and {_of(one['true'])} true"
            f" episodes from the same starts: {left} (rl.doubt); deploy more episodes (rounds.deploy), or"
            " train simulator and judge for longer (simulator_fit, judge_fit)"
            for task, one in self._kind.items()
        ]


def _of(entry: Mapping[str, Any]) -> str:
    return f"{entry['successes']} of {entry['episodes']}"


def chosen_among(numbers: Sequence[int], trusted: Tensor, first: int = 0) -> list[int]:
    """Those of the numbers of starts whose entry of bool [N] is true; entry 0 is of number `first`."""
    return [number for number in numbers if trusted[number - first]]
