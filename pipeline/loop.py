"""The whole loop as a graph: collect, imitate, then rounds of deploy -> refresh the world -> RL in it, from
the policy that did best in physics, then the proof.

Reading this file top to bottom is reading the method. What each stage does is in pipeline/stages.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from envs.manifest import digest_of
from envs.targets import target
from pipeline.graph.graph import Graph
from pipeline.graph.workers import learners_of
from pipeline.stages import collect, imitation, keep, prove, rl, show, world

Cfg = Mapping[str, Any]
T = TypeVar("T")


@dataclass
class World:
    """Names of the stages that make the imagined world; "" before there is one."""

    simulator: str = ""
    state: str = ""
    judge: str = ""

    def roles(self) -> dict[str, str]:
        """Inputs of whatever runs in it."""
        return dict(vars(self))


def build_loop(cfg: Cfg, root: Path, with_rl: bool = True) -> Graph:
    """The graph of an experiment.

    Args:
        cfg: the resolved config.
        root: the run's folder.
        with_rl: false leaves the iterations of RL out of every round, as a control of what they bring; the
            deployed policy is then the one that was cloned.

    Raises:
        ConfigError: for what can be seen to fail before anything starts.
    """
    learners_of(cfg)
    graph = Graph(cfg, root / "stages")
    if has_physics(cfg):
        _physics_loop(graph, cfg, with_rl)
    else:
        _data_loop(graph, cfg)
    return graph


def has_physics(cfg: Cfg) -> bool:
    """Whether the task is one that can be tried; else there are recordings only (task.data)."""
    return bool(cfg["task"].get("suite"))


def last_round(cfg: Cfg) -> int:
    """Number of the last round; recordings do not grow, so without physics there is one."""
    return int(cfg["rounds"]["count"]) if has_physics(cfg) else 1


def of_round(values: Sequence[T], number: int) -> T:
    """The entry of round `number`; the last one repeats."""
    return values[min(number, len(values)) - 1]


def _physics_loop(graph: Graph, cfg: Cfg, with_rl: bool) -> None:
    data: list[str] = [graph.add("collect", collect.collect)]
    first = policy = best = graph.add("imitation", imitation.imitation, {"data": data})
    made, known = World(), ""
    for number in range(1, last_round(cfg) + 1):
        deployed = _deploy(graph, cfg, policy, number)
        data = [*data, deployed]
        made = _refresh(graph, cfg, data, made, number)
        inputs = {"data": data, **made.roles()}
        graph.add(f"gap-{number}", prove.gap, {**inputs, "policy": policy}, number=number)
        policy, known = _keep(graph, policy, deployed, best, known, number)
        best = policy
        if number <= cfg["rounds"]["clone"]:
            policy = graph.add(
                f"clone-{number}",
                imitation.clone,
                {"data": data, "policy": policy, "simulator": made.simulator},
                number=number,
            )
        if with_rl:
            policy = _learn(graph, cfg, data, made, policy, number)
    last = last_round(cfg) + 1
    policy, _ = _keep(graph, policy, _deploy(graph, cfg, policy, last), best, known, last)
    before = graph.add("evaluate-before", prove.evaluate_physics, {"policy": first})
    after = graph.add("evaluate-after", prove.evaluate_physics, {"policy": policy})
    _conclude(graph, data, made, first, policy, {"physics_before": before, "physics_after": after})


def _deploy(graph: Graph, cfg: Cfg, policy: str, number: int) -> str:
    episodes = of_round(cfg["rounds"]["deploy"], number)
    return graph.add(f"deploy-{number}", collect.deploy, {"policy": policy}, number=number, episodes=episodes)


def _keep(graph: Graph, policy: str, deployed: str, best: str, known: str, number: int) -> tuple[str, str]:
    """The better of the policy just deployed and the best before, and what says how good it is."""
    if not known:
        return policy, deployed
    roles = {"candidate": policy, "tried": deployed, "incumbent": best, "known": known}
    kept = graph.add(f"keep-{number}", keep.keep, roles)
    return kept, kept


def _data_loop(graph: Graph, cfg: Cfg) -> None:
    mark = collect.fingerprint(cfg["task"]["data"])
    data = [graph.add("recordings", collect.recordings, fingerprint=mark)]
    made = _refresh(graph, cfg, data, World(), 1)
    first = graph.add("imitation", imitation.imitation, {"data": data})
    policy = _learn(graph, cfg, data, made, first, 1, deployed=0)
    _conclude(graph, data, made, first, policy, {})


def _refresh(graph: Graph, cfg: Cfg, data: list[str], before: World, number: int) -> World:
    """The stages that train the imagined world on all data so far, from its predecessor if there is one."""
    phase, warm = ("refresh", before.simulator) if before.simulator else ("first", "")
    if not warm and "codec" in cfg["simulator"]:
        warm = graph.add("tokenizer", world.tokenizer, {"data": data})
    simulator = graph.add(f"simulator-{number}", world.simulator, {"data": data, "warm": warm}, phase=phase)
    inputs = {"data": data, "simulator": simulator}
    state = graph.add(f"state-{number}", world.state, {**inputs, "warm": before.state}, phase=phase)
    inputs["warm"], files = before.judge, _judge_files(cfg)
    judge = graph.add(f"judge-{number}", world.judge, inputs, phase=phase, **files)
    return World(simulator, state, judge)


def _judge_files(cfg: Cfg) -> dict[str, Any]:
    """A setting with the hashes of files that decide what the judge says, if there are any: when one changes,
    what it judged is out of date.
    """
    kind: Any = target(cfg["judge"], "judge")
    found = {path.name: digest_of(path) for path in kind.files(cfg["judge"])}
    return {"files": found} if found else {}


def _learn(
    graph: Graph,
    cfg: Cfg,
    data: list[str],
    made: World,
    policy: str,
    number: int,
    deployed: int | None = None,
) -> str:
    """RL in the imagined world; `deployed` is the round whose successes anchor it, this one by default."""
    return graph.add(
        f"rl-{number}",
        rl.rl,
        {"data": data, **made.roles(), "policy": policy},
        number=number,
        deployed=number if deployed is None else deployed,
        iterations=of_round(cfg["rounds"]["iterations"], number),
    )


def _conclude(
    graph: Graph, data: list[str], made: World, first: str, last: str, proofs: dict[str, str]
) -> None:
    """What is measured at the end: success imagined, errors of world and judge, videos, and the report."""
    inputs, policies = {"data": data, **made.roles()}, {"before": first, "after": last}
    imagined = graph.add("evaluate-imagined", prove.evaluate_imagined, {**inputs, **policies})
    measured = graph.add("measure", prove.measure, inputs)
    shown = {"data": data, "simulator": made.simulator, "judge": made.judge, "measured": measured}
    if proofs:
        videos = graph.add("videos", show.videos, {**shown, **policies})
    else:
        videos = graph.add("videos", show.replays, shown)
    everything = list(graph.nodes)
    graph.add(
        "report",
        show.report,
        {**proofs, "imagined": imagined, "measured": measured, "videos": videos, "stages": everything},
    )
