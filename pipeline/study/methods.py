"""How a row of a study comes to what it is about: to a policy, by cloning, by the loop with or without RL, by
RL in physics; or to an imagined world.

Each builds the graph that it needs in the same folder, and a stage lies in a folder named by its key, so what
two rows have in common is computed once.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from annotated_types import Gt, Le

from actors.world_config import rewards_of
from envs.targets import ConfigError, target
from pipeline.acting import acting
from pipeline.graph.graph import Graph, Names
from pipeline.graph.stage import Stage
from pipeline.loop import (
    World,
    add_imitation,
    add_world,
    build_loop,
    deployed_episodes,
    imagined_iterations,
    last_round,
)
from pipeline.stages import collect, prove, rl
from pipeline.stages.variant import fewer_episodes

Cfg = Mapping[str, Any]
Equal = Literal["episodes", "steps"]
EQUAL: tuple[Equal, ...] = ("episodes", "steps")


@dataclass(frozen=True)
class Made:
    """What a row is about, and the graph that holds its stages.

    Args:
        graph: to which the stages that measure it are added.
        policy: name of the stage whose weights are the policy.
        ends: names of the stages with which all is there that the row is about; () is the policy alone.
    """

    graph: Graph
    policy: str
    ends: tuple[str, ...] = ()

    @property
    def finished(self) -> bool:
        """Whether what the row is about is there."""
        return all(self.graph.finished(name) for name in self.ends or (self.policy,))

    def add_once(self, name: str, stage: Stage, inputs: Names, **settings: Any) -> str:
        """Add a node to the graph, unless one that does the same is there; returns the name of either."""
        for other, node in self.graph.nodes.items():
            if node.stage is stage and node.inputs == dict(inputs) and node.settings == settings:
                return other
        return self.graph.add(name, stage, inputs, **settings)

    def physics_episodes(self) -> dict[str, int]:
        """Physics episodes behind it, scripted ones and those of policies themselves."""
        spent: Counter[str] = Counter()
        for manifest in self._behind():
            spent.update(manifest["result"].get("physics_episodes", {}))
        return dict(spent)

    def seconds(self) -> float:
        """Work behind it, as if no other row had shared any of it."""
        return float(sum(manifest["seconds"] for manifest in self._behind()))

    def _behind(self) -> list[dict[str, Any]]:
        names = self.graph.needs(self.ends or self.policy)
        return [self.graph.manifest(name) for name in self.graph.nodes if name in names]


class Method(ABC):
    """A way to a policy or a world; a row of a study names one by `_target_`."""

    @abstractmethod
    def make(self, cfg: Cfg, root: Path) -> Made:
        """The stages that lead to it.

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
        rl: false leaves the iterations of RL out of every round: what is deployed is what was cloned.

        kept: the last policy, or the one before if a last trial says that it got worse; false takes what
            the last round's RL left, and tries it no more.

    Raises:
        ConfigError: for what RL left, without RL.
    """

    def __init__(self, rl: bool = True, kept: bool = True):
        if not rl and not kept:
            raise ConfigError("rl=false leaves no policy of RL's to take; say kept=true")
        self.rl, self.kept = rl, kept

    def make(self, cfg: Cfg, root: Path) -> Made:
        """See Method.make."""
        graph = build_loop(cfg, root, with_rl=self.rl)
        last = graph.nodes["evaluate-after"].inputs["policy"] if self.kept else f"rl-{last_round(cfg)}"
        return Made(graph, str(last))


class RLInPhysics(Method):
    """The same algorithm from the same first policy, in physics instead of imagination.

    Args:
        equal: it takes as many "episodes" as the loop deploys and tries, or as many environment "steps" as it
            imagines.
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


class WorldFrom(Method):
    """A first imagined world from a share of the scripted episodes, and the policy of imitation, of which the
    world has seen nothing.

    Args:
        share: of the episodes that its parts learn from; what is held out is the same with any.
        judge: whether the row is about the judge alone, for which not all of the world is needed.
    """

    def __init__(self, share: Annotated[float, Gt(0), Le(1)] = 1.0, judge: bool = False):
        self.share, self.judge = share, judge

    def make(self, cfg: Cfg, root: Path) -> Made:
        """See Method.make."""
        graph = Graph(acting(cfg), root / "stages")
        data = graph.add("collect", collect.collect)
        add_imitation(graph, cfg, [data])
        if self.share < 1:
            data = graph.add("fewer", fewer_episodes, {"data": data}, share=self.share)
        world = add_world(graph, cfg, [data], World(), 1)
        graph.add("measure", prove.measure, {"data": [data], **world.roles()})
        roles = world.roles()
        return Made(graph, "imitation", (roles["judge"],) if self.judge else tuple(roles.values()))


def add_rl_in_physics(graph: Graph, cfg: Cfg, equal: Equal) -> str:
    """Add RL in physics from the loop's first policy, and return its name."""
    if equal == "episodes":
        amount = {"episodes": deployed_episodes(cfg)}
    else:
        amount = {"iterations": imagined_iterations(cfg)}
    name = f"rl-in-physics-equal-{equal}"
    first = "explore" if "explore" in graph.nodes else "imitation"
    return graph.add(name, rl.rl_in_physics, {"policy": first}, **amount)


def privileged_note(cfg: Cfg) -> str:
    """What RL in physics is rewarded by, and how else it differs from the loop's."""
    rewarded = "progress and success" if rewards_of(cfg).progress else "success"
    note = (
        f"rewarded by the suite's true {rewarded}, which are privileged, not by a judge; it has no anchor to"
        " cloned episodes (rl.anchor)"
    )
    if hasattr(target(cfg["algorithm"], "algorithm"), "warm_up"):
        note += ", its critic is not warmed up, and no recorded decisions are learned from (rl.recorded)"
    return note
