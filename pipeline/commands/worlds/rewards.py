"""worldloop rewards: rewards side by side along the same episodes, of seen scenes and of unseen ones.

RoboScape-R compares its reward with a rule, a head on the simulator's features and a network on pictures by
their curves along an episode of an unseen scene. Here each judge is fitted to the data of a run's first
round, as that run's own judge is, and asked about episodes that none of them has learned from.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from actors.factory import build_judge, build_simulator, open_clips
from envs.episodes.clips import ClipStore
from envs.files import write_json, write_text
from envs.judges.base import Judge
from envs.judges.rule import RuleJudge
from envs.simulators.base import Simulator
from envs.simulators.replay import Replay, replay
from envs.targets import ConfigError
from pipeline.evaluation.judging import Scores, judge_both, labelled
from pipeline.evaluation.measurement import followed
from pipeline.evaluation.rewards.figures import BY_PHYSICS, Truth, by_rule, chosen, curve, figures, truth_of
from pipeline.evaluation.rewards.page import build_page, table_text
from pipeline.graph.graph import Graph
from pipeline.graph.kept import Kept
from pipeline.graph.stage import WEIGHTS
from pipeline.loop import build_loop
from pipeline.stages.given import datasets, open_store
from pipeline.stages.variant import variant_episodes
from pipeline.track import Tracker

RULE = "rule"  # the reward that asks physics; it has no weights and no config
SEEN = "seen"
JUDGE = "judge-1"  # later rounds' data hang on what the first judge rewarded
Cfg = Mapping[str, Any]


@dataclass(frozen=True)
class Plan:
    """What is compared on what.

    Args:
        configs: of each reward, by name: the run's with another section judge; that of the rule is any.
        episodes: of each domain, at most.
        variants: of the task, beside the scenes that are learned from.
        drawn: successes, and as many failures, whose curves are drawn in each domain.
    """

    configs: Mapping[str, Cfg]
    episodes: int
    variants: Sequence[str]
    drawn: int = 3


def compare_rewards(cfg: Cfg, root: Path, plan: Plan, tracker: Tracker | None = None) -> str:
    """Fit the judges that are not fitted yet, ask all of them; writes rewards.json and rewards.html.

    Args:
        cfg: the run's config.
        root: its folder.

    Returns:
        The table as Markdown.

    Raises:
        ConfigError: for variants that the task does not have, and data of which nobody knows success, or
            true progress if the rule is among the rewards; before anything is fitted.
    """
    unknown = sorted(set(plan.variants) - set(cfg["task"].get("variants", {})))
    if unknown:
        raise ConfigError(f"variants={unknown}: task.variants are {sorted(cfg['task'].get('variants', {}))}")
    base = build_loop(cfg, root)
    base.run(base.nodes[JUDGE].inputs["data"], tracker)
    seen = _seen(cfg, base, plan)
    base.run(base.nodes[JUDGE].inputs["simulator"], tracker)
    judges = dict(_judges(cfg, root, plan, tracker))
    weights = base.inputs(JUDGE).weights("simulator")
    assert weights is not None
    simulator, kept = build_simulator(base.cfg, weights).eval(), Kept(root / "rewards")
    bf16 = cfg["simulator"]["bf16"]

    def replayed(domain: Domain) -> Replay:
        name, store, episodes, stages = domain
        # Folders of stages are named by all that they hang on, code included.
        identity = {"stages": [weights.parent.name, *stages], "episodes": episodes.tolist(), "bf16": bf16}
        made = kept.get(name, identity, lambda: replay(simulator, store, episodes, bf16=bf16)._asdict())
        return Replay(**made)

    domains = {
        domain.name: _domain(cfg, judges, simulator, domain, replayed(domain), plan.drawn)
        for domain in chain([seen], _unseen(cfg, base, plan, tracker))
    }
    about = {"name": cfg["name"], "simulator": cfg["simulator"]["_target_"].rpartition(".")[2]}
    result = {**about, "domains": domains}
    write_json(root / "rewards.json", result)
    write_text(root / "rewards.html", build_page(result))
    return table_text(result)


def _judges(cfg: Cfg, root: Path, plan: Plan, tracker: Tracker | None) -> Iterator[tuple[str, Judge]]:
    # What progress and success are worth is known to whoever acted in physics: with other worth the data
    # would be out of date.
    worth = cfg["judge"]["rewards"]
    for name, other in plan.configs.items():
        if name == RULE:
            yield name, RuleJudge(hold=1)
            continue
        mine = {**other, "judge": {**other["judge"], "rewards": worth}}
        graph = build_loop(mine, root)
        graph.run(JUDGE, tracker)
        yield name, build_judge(graph.cfg, graph.folder(JUDGE) / WEIGHTS).eval()


class Domain(NamedTuple):
    """Episodes of one kind of scenes: their store, which of it, and the stages' folders that hold them."""

    name: str
    store: ClipStore
    episodes: Tensor
    stages: list[str]


def _seen(cfg: Cfg, base: Graph, plan: Plan) -> Domain:
    """What was held out of the run's data.

    Raises:
        ConfigError: if these do not say what the rewards are compared with.
    """
    store = open_store(cfg, base.inputs(JUDGE))
    held = labelled(store, followed(store, store.split("held_out")))
    if not len(held):
        raise ConfigError("no held-out episode of the data says whether it succeeded (next.success)")
    spread = torch.linspace(0, len(held) - 1, min(plan.episodes, len(held))).round().long()
    if RULE in plan.configs and truth_of(store, held[spread]).source != BY_PHYSICS:
        raise ConfigError("rewards=[rule] asks physics, and these recordings have none; leave it out")
    return Domain(SEEN, store, held[spread], [path.name for path in base.inputs(JUDGE).folders("data")])


def _unseen(cfg: Cfg, base: Graph, plan: Plan, tracker: Tracker | None) -> Iterator[Domain]:
    """Each variant."""
    for name in plan.variants:
        node = base.add(f"variant-{name}", variant_episodes, variant=name, episodes=plan.episodes)
        base.run(node, tracker)
        other = open_clips(cfg, datasets([base.folder(node)]))
        yield Domain(name, other, torch.arange(len(other)), [base.folder(node).name])


def _domain(
    cfg: Cfg,
    judges: Mapping[str, Judge],
    simulator: Simulator,
    domain: Domain,
    made: Replay,
    drawn: int,
) -> dict[str, Any]:
    """The entry of rewards.json for some episodes, which `made` replays."""
    _, store, episodes, _ = domain
    truth, bf16 = truth_of(store, episodes), cfg["simulator"]["bf16"]
    rows, curves = {}, dict[str, dict[str, Tensor]](progress={}, success={})
    for name, judge in judges.items():
        if name == RULE:
            videos = {"recorded": by_rule(truth)}
        else:
            views = judge_both(judge, simulator, store, episodes, made, bf16)
            videos = {video: _cut(scores, truth) for video, scores in views._asdict().items()}
        found = {video: figures(judge, scores, truth, cfg["seed"]) for video, scores in videos.items()}
        rows[name] = {"facts": judge.facts(), "figures": found}
        curves["progress"][name] = videos["recorded"].progress
        curves["success"][name] = videos["recorded"].success
    if RULE not in judges:
        curves["progress"] = {"true": truth.progress, **curves["progress"]}
    return {
        "episodes": len(episodes),
        "successes": int(truth.success.sum()),
        "truth": truth.source,
        "rewards": rows,
        "drawn": [
            {
                "outcome": outcome,
                "seed": store.episodes[int(episodes[n])]["seed"],
                "instruction": store.instructions[int(episodes[n])],
                "curves": {
                    part: {name: curve(values, truth, n) for name, values in some.items()}
                    for part, some in curves.items()
                },
            }
            for outcome, numbers in chosen(truth, drawn).items()
            for n in numbers
        ],
    }


def _cut(scores: Scores, truth: Truth) -> Scores:
    """Scores of the frames that the longest episode has; whole chunks were generated."""
    count = truth.valid.shape[1]
    return Scores(scores.success[:, :count], scores.progress[:, :count], scores.status)
