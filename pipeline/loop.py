"""The whole loop as a graph: collect, imitate, then rounds of deploy -> refresh the world -> RL in it, from
the policy that did best in physics, then the proof.

Reading this file top to bottom is reading the method. What each stage does is in pipeline/stages.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from envs.episodes.formats.lerobot.columns import SUCCESS
from envs.episodes.formats.lerobot.files import read_info
from envs.targets import ConfigError, target
from pipeline.acting import acting
from pipeline.choice import Choice
from pipeline.graph.graph import Graph
from pipeline.graph.workers import learners_of
from pipeline.outside import CHECKPOINT, KINEMATICS, STATE_CHECKPOINT, files_at, fingerprint, judge_files
from pipeline.stages import collect, imitation, pace, prove, rl, show, world
from pipeline.stages.given import imagined_chunks
from pipeline.stages.judging import stage as judging
from pipeline.stages.measured import explore
from pipeline.stages.measured import worth as measured_worth

Cfg = Mapping[str, Any]
T = TypeVar("T")


@dataclass
class World:
    """Names of the stages that make the imagined world; "" before there is one.

    Policies act in `simulator`, which is `teacher`, or its few-step student.
    """

    teacher: str = ""
    simulator: str = ""
    state: str = ""
    judge: str = ""
    text_world: str = ""  # whose weights are the judge's, once it has learned
    pace: str = ""  # that says how many steps are so many seconds, if time is what counts

    def roles(self) -> dict[str, str]:
        """Inputs of whatever runs in it."""
        return {"simulator": self.simulator, "state": self.state, "judge": self.judge}


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
    graph = Graph(acting(cfg), root / "stages")
    if has_physics(cfg):
        _physics_loop(graph, cfg, with_rl)
    else:
        _data_loop(graph, cfg)
    return graph


def has_physics(cfg: Cfg) -> bool:
    """Whether the task is one that can be tried; else there are recordings only (task.data)."""
    return bool(cfg["task"].get("suite"))


def check_physics(cfg: Cfg, who: str) -> None:
    """Refuse a task that is known from recordings alone, for `who` plays the task.

    Raises:
        ConfigError: saying what to choose.
    """
    if not has_physics(cfg):
        raise ConfigError(f"{who} records its own episodes; choose a task with a suite (task=push)")


def check_labels(cfg: Cfg, graph: Graph, until: str = "") -> None:
    """See that recordings say what the judge is taught by, hours before it is its turn.

    Args:
        until: the last node that is wanted; "" wants all.

    Raises:
        ConfigError: naming the column and the fix.
    """
    wanted = graph.needs(until) if until else graph.nodes
    if any(name.startswith("judge-") for name in wanted) and not can_be_taught(cfg):
        raise ConfigError(
            f"judge={cfg['judge']['_target_']} learns from success, which no data set of"
            f" task.data={cfg['task']['data']} says; record {SUCCESS}, or choose a judge that needs none, as"
            " judge=golden_goal, judge=goal_image judge.picture=<file> or judge=vlm"
        )


def can_be_taught(cfg: Cfg) -> bool:
    """Whether somebody tells the judge of success, if it learns from that."""
    judge: Any = target(cfg["judge"], "judge")
    if has_physics(cfg) or not judge.needs_labels:
        return True
    return any(SUCCESS in read_info(Path(folder))["features"] for folder in cfg["task"]["data"])


def last_round(cfg: Cfg) -> int:
    """Number of the last round; recordings do not grow, so without physics there is one."""
    return int(cfg["rounds"]["count"]) if has_physics(cfg) else 1


def of_round(values: Sequence[T], number: int) -> T:
    """The entry of round `number`; the last one repeats."""
    return values[min(number, len(values)) - 1]


def deployed_episodes(cfg: Cfg) -> int:
    """Physics episodes of all rounds: of deployments, and of trials, of which one more is of what the last
    round has learned.
    """
    rounds = last_round(cfg)
    trials = (rounds + 1) * int(cfg["rounds"]["trial"])
    return trials + sum(of_round(cfg["rounds"]["deploy"], n) for n in range(1, rounds + 1))


def imagined_iterations(cfg: Cfg) -> int:
    """Iterations of RL whose episodes, if they were whole, would take as many steps as all rounds imagine."""
    iterations = sum(of_round(cfg["rounds"]["iterations"], n) for n in range(1, last_round(cfg) + 1))
    whole = cfg["task"]["horizon"] // cfg["task"]["chunk"]
    return max(1, round(iterations * imagined_chunks(cfg) / whole))


def _physics_loop(graph: Graph, cfg: Cfg, with_rl: bool) -> None:
    data = add_episodes(graph, cfg)
    first = add_imitation(graph, cfg, data)
    policy = _explore(graph, cfg, first, data)
    starts = _extra_starts(graph, cfg) if with_rl else []
    made, choice = World(), Choice()
    for number in range(1, last_round(cfg) + 1):
        deployed = _deploy(graph, cfg, policy, number)
        data = [*data, deployed]
        made = add_world(graph, cfg, data, made, number)
        inputs = {"data": data, **made.roles()}
        graph.add(f"gap-{number}", prove.gap, {**inputs, "policy": policy}, number=number)
        choice = choice.or_better(graph, policy, number)
        policy = choice.policy
        known = choice.stage if choice.compared else deployed
        if number <= cfg["rounds"]["clone"]:
            roles = {"data": data, "policy": policy, "known": known}
            policy = graph.add(f"clone-{number}", imitation.clone, roles)
        if with_rl:
            policy = _learn(graph, cfg, data, made, policy, number, starts, known)
    last = last_round(cfg) + 1
    policy = choice.or_better(graph, policy, last).policy
    before = graph.add("evaluate-before", prove.evaluate_physics, {"policy": first})
    after = graph.add("evaluate-after", prove.evaluate_physics, {"policy": policy})
    _conclude(graph, data, made, first, policy, {"physics_before": before, "physics_after": after})


def _explore(graph: Graph, cfg: Cfg, policy: str, data: list[str]) -> str:
    """The policy that explores as widely as physics lets it, if it can be told to; its trials are data."""
    kind: Any = target(cfg["policy"], "policy")
    if not cfg["explore"]["levels"] or not hasattr(kind, "scale_exploration"):
        return policy
    data.append(graph.add("explore", explore.explore, {"policy": policy}))
    return "explore"


def _deploy(graph: Graph, cfg: Cfg, policy: str, number: int) -> str:
    episodes = of_round(cfg["rounds"]["deploy"], number)
    return graph.add(f"deploy-{number}", collect.deploy, {"policy": policy}, number=number, episodes=episodes)


def _extra_starts(graph: Graph, cfg: Cfg) -> list[str]:
    """The stages that hold the first frames of which nothing more was recorded."""
    section = cfg["extra_starts"]
    out = [
        graph.add(f"starts-{variant}", collect.first_frames, variant=variant)
        for variant in section["variants"]
    ]
    if section["data"]:
        mark = fingerprint(section["data"], "extra_starts.data")
        out.append(graph.add("starts-recorded", collect.recorded_starts, fingerprint=mark))
    return out


def _data_loop(graph: Graph, cfg: Cfg) -> None:
    data = add_episodes(graph, cfg)
    first = add_imitation(graph, cfg, data)
    made = add_world(graph, cfg, data, World(), 1)
    starts = _extra_starts(graph, cfg)
    policy = _learn(graph, cfg, data, made, first, 1, starts, known="")
    _conclude(graph, data, made, first, policy, {})


def add_episodes(graph: Graph, cfg: Cfg) -> list[str]:
    """The stage of the first episodes: scripted ones where there is physics, else the recordings."""
    if has_physics(cfg):
        return [graph.add("collect", collect.collect)]
    return [graph.add("recordings", collect.recordings, fingerprint=fingerprint(cfg["task"]["data"]))]


def add_imitation(graph: Graph, cfg: Cfg, data: list[str]) -> str:
    """The stage that clones the first policy."""
    return graph.add("imitation", imitation.imitation, {"data": data}, **files_at(cfg, KINEMATICS))


def add_world(graph: Graph, cfg: Cfg, data: list[str], before: World, number: int) -> World:
    """The stages that train the imagined world on all data so far, from its predecessor if there is one."""
    phase, warm = ("refresh", before.teacher) if before.teacher else ("first", "")
    learning = graph.under(cfg)  # with the simulator as it is, not as it is acted in
    speeds = before.pace
    if cfg["equal_time"]["seconds"] and not speeds:
        speeds = learning.add("pace", pace.pace, {"data": data})
    released = files_at(cfg, CHECKPOINT, KINEMATICS)
    time = {part: pace.seconds_of(cfg, part, phase) for part in ("tokenizer", "simulator", "state")}
    if not warm and "codec" in cfg["simulator"]:
        roles = {"data": data, "pace": speeds}
        warm = learning.add("tokenizer", world.tokenizer, roles, **time["tokenizer"], **released)
    roles = {"data": data, "warm": warm, "pace": speeds}
    simulator = teacher = learning.add(
        f"simulator-{number}", world.simulator, roles, phase=phase, **time["simulator"], **released
    )
    if cfg["distill"]["steps"]:
        roles = {"data": data, "simulator": teacher, "warm": before.simulator}
        simulator = learning.add(f"student-{number}", world.student, roles, phase=phase)
    inputs = {"data": data, "simulator": simulator}
    roles = {**inputs, "warm": before.state, "pace": speeds}
    files = files_at(cfg, STATE_CHECKPOINT)
    state = graph.add(f"state-{number}", world.state, roles, phase=phase, **time["state"], **files)
    golden = ""
    if "text_world" in cfg["judge"]:
        roles = {"data": data, "warm": before.text_world}
        golden = graph.add(
            f"text_world-{number}", judging.text_world, roles, phase=phase, **judge_files(cfg, "text_world")
        )
    kind: Any = target(cfg["judge"], "judge")
    mixed = state if kind.reads_features else ""  # it mixes the features that such a judge reads
    roles = {**inputs, "warm": before.judge, "text_world": golden, "state": mixed}
    judge = graph.add(f"judge-{number}", judging.judge, roles, phase=phase, **judge_files(cfg))
    return World(teacher, simulator, state, judge, golden, speeds)


def _learn(
    graph: Graph,
    cfg: Cfg,
    data: list[str],
    made: World,
    policy: str,
    number: int,
    starts: list[str],
    known: str,
) -> str:
    """RL in the imagined world, of which it is measured first what it is worth where there are episodes of
    deployed policies; `known` says how good the policy is, "" if it was not deployed.
    """
    inputs, worth = {"data": data, **made.roles(), "policy": policy}, ""
    if known and cfg["worth"]["moments"] and cfg["rl"]["imagined"]:
        before = f"worth-{number - 1}" if number > 1 else ""
        worth = graph.add(
            f"worth-{number}", measured_worth.worth, {**inputs, "before": before}, number=number
        )
    return graph.add(
        f"rl-{number}",
        rl.rl,
        {**inputs, "starts": starts, "known": known, "worth": worth},
        number=number,
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
