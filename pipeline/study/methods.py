"""How a row of a study comes to its policy: by cloning, by the loop with or without RL, by RL in physics.

Each builds the graph that it needs in the same folder, and a stage lies in a folder named by its key, so what
two rows have in common is computed once.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from actors.world_config import rewards_of
from pipeline.graph.graph import Graph
from pipeline.loop import build_loop, deployed_episodes, imagined_iterations
from pipeline.stages import rl

Cfg = Mapping[str, Any]
Equal = Literal["episodes", "steps"]
EQUAL: tuple[Equal, ...] = ("episodes", "steps")


@dataclass(frozen=True)
class Made:
    """A policy and the graph that holds its stages.

    Args:
        graph: to which the stages that measure it are added.
        policy: name of the stage whose weights it is.
    """

    graph: Graph
    policy: str

    @property
    def finished(self) -> bool:
        """Whether the policy is there."""
        return self.graph.finished(self.policy)

    def physics_episodes(self) -> dict[str, int]:
        """Physics episodes behind the policy, scripted ones and those of policies themselves."""
        spent: Counter[str] = Counter()
        for manifest in self._behind():
            spent.update(manifest["result"].get("physics_episodes", {}))
        return dict(spent)

    def seconds(self) -> float:
        """Work behind the policy, as if no other row had shared any of it."""
        return float(sum(manifest["seconds"] for manifest in self._behind()))

    def _behind(self) -> list[dict[str, Any]]:
        names = self.graph.needs(self.policy)
        return [self.graph.manifest(name) for name in self.graph.nodes if name in names]


class Method(ABC):
    """A way to a policy; a row of a study names one by `_target_`."""

    @abstractmethod
    def make(self, cfg: Cfg, root: Path) -> Made:
        """The stages that lead to the policy.

        Args:
            cfg: of the row and the seed, resolved.
            root: the study's folder.
        """

    def note(self, cfg: Cfg) -> str:
        """What must be known to compare the row with others; "" for nothing."""
        return ""


class Imitation(Method):
    """The policy that the loop begins with, cloned from demonstrations."""

    def make(self, cfg: Cfg, root: Path) -> Made:
        """See Method.make."""
        return Made(build_loop(cfg, root), "imitation")


class Loop(Method):
    """The loop's last policy.

    Args:
        rl: false leaves the iterations of RL out of every round: what is deployed is what was cloned, from as
            many physics episodes.
    """

    def __init__(self, rl: bool = True):
        self.rl = rl

    def make(self, cfg: Cfg, root: Path) -> Made:
        """See Method.make."""
        graph = build_loop(cfg, root, with_rl=self.rl)
        return Made(graph, str(graph.nodes["evaluate-after"].inputs["policy"]))


class RLInPhysics(Method):
    """The same RL from the same first policy, in physics instead of imagination.

    Args:
        equal: it takes as many "episodes" as the loop deploys, or as many environment "steps" as it imagines.
    """

    def __init__(self, equal: Equal):
        self.equal = equal

    def make(self, cfg: Cfg, root: Path) -> Made:
        """See Method.make."""
        graph = build_loop(cfg, root)
        return Made(graph, add_rl_in_physics(graph, cfg, self.equal))

    def note(self, cfg: Cfg) -> str:
        """See Method.note."""
        return privileged_note(cfg)


def add_rl_in_physics(graph: Graph, cfg: Cfg, equal: Equal) -> str:
    """Add RL in physics from the loop's first policy, and return its name."""
    few = max(1, round(deployed_episodes(cfg) / cfg["rl"]["envs"]))
    iterations = {"episodes": few, "steps": imagined_iterations(cfg)}[equal]
    name = f"rl-in-physics-equal-{equal}"
    return graph.add(name, rl.rl_in_physics, {"policy": "imitation"}, iterations=iterations)


def privileged_note(cfg: Cfg) -> str:
    """What RL in physics is rewarded by."""
    told = "progress and success" if rewards_of(cfg).progress else "success"
    return f"rewarded by the suite's true {told}, which are privileged, not by a judge"
