"""Which policy the loop goes on with, round by round: the part of the graph that tries and chooses."""

from __future__ import annotations

from dataclasses import dataclass

from pipeline.graph.graph import Graph
from pipeline.stages import keep


@dataclass(frozen=True)
class Choice:
    """The policy that was kept so far.

    Args:
        policy: stage that has its weights; "" before there is one.
        stage: the one that says how good it is by its mode: a trial, or what compared trials.
    """

    policy: str = ""
    stage: str = ""

    @property
    def compared(self) -> bool:
        """Whether it stood a comparison."""
        return self.policy == self.stage != ""

    def or_better(self, graph: Graph, policy: str, number: int) -> Choice:
        """The policy of round `number`, unless by its trial it got worse. One that nothing has changed is not
        tried again.
        """
        if policy == self.policy:
            return self
        tried = graph.add(f"trial-{number}", keep.trial, {"policy": policy}, number=number)
        if not self.stage:
            return Choice(policy, tried)
        roles = {"candidate": policy, "tried": tried, "incumbent": self.policy, "best": self.stage}
        kept = graph.add(f"keep-{number}", keep.keep, roles)
        return Choice(kept, kept)
