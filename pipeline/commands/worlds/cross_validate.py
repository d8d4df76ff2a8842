"""worldloop cross-validate: whether what RL learns from recorded decisions holds on other episodes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from envs.files import write_json
from envs.targets import ConfigError
from learners.rl.algorithm import RLConfig
from pipeline.commands.worlds.subject import Keep, kept_of_round, round_inputs
from pipeline.evaluation.by_task import tasks_of_episodes
from pipeline.evaluation.trust.gradients import Measured, plain_row
from pipeline.evaluation.trust.held_out import (
    Moment,
    folds_of,
    joined,
    learned_without,
    mean_gain,
    packed,
    unpacked,
)
from pipeline.loop import build_loop
from pipeline.markdown import markdown_table
from pipeline.stages.given import deployed_in, imagined_chunks
from pipeline.stages.rl import Imagination, begin, recorded_episodes, rl

_LOOKS = (32, 16, 8, 4, 2, 1)  # parts of all steps after which is looked
_COLUMNS = ("on what was learned from", "on episodes left out")
_HOLDS = 0.5  # of what is learned, below which most of it is said to be noise


def cross_validate(cfg: Mapping[str, Any], root: Path, number: int, folds: int) -> str:
    """Tables of what learning from a round's recorded decisions brings, on those and on others, and
    cross-validate-<round>.json.

    Args:
        cfg: the resolved config.
        root: the run's folder.
        number: of the round.
        folds: parts of the newest episodes, each of which is left out once.

    Raises:
        ConfigError: if the run has not come so far, or nothing recorded is learned from.
    """
    if folds < 2:
        raise ConfigError(f"folds={folds}: to leave a part out there must be 2 of them at least")
    graph = build_loop(cfg, root)
    inputs, name = round_inputs(graph, root, number, "rl"), f"rl-{number}"
    ready = begin(rl.view(name, graph.cfg, graph.nodes[name].settings), inputs)
    if ready.true.decisions is None:
        raise ConfigError(
            f"rl-{number} learns from no recorded decisions, of which alone this tells: they need"
            " algorithm=ppo, a policy that is not scored on action tokens, and labelled episodes of a"
            " deployed policy"
        )
    keep = kept_of_round(graph, root / "cross-validate", number, learned_without.__module__)
    found = measured(graph.cfg, ready, deployed_in(inputs, "known"), folds, keep)
    write_json(root / f"cross-validate-{number}.json", {"round": number, "folds": folds, **plain(found)})
    return tables(found, folds)


@dataclass(frozen=True)
class Found:
    """What was measured of a round.

    Args:
        by_steps: rows with steps, kl, learned, left_out, after ever more steps.
        by_task: the same after all steps, with task; [] of a single task.
        decisions, own, episodes: all decisions, those of the policy that RL begins with, and its episodes.
    """

    by_steps: list[dict[str, Any]]
    by_task: list[dict[str, Any]]
    decisions: int
    own: int
    episodes: int


def measured(cfg: Mapping[str, Any], ready: Imagination, deployed: int, folds: int, keep: Keep) -> Found:
    """What is learned without each fold of the episodes of the policy that was deployed in round `deployed`;
    what was learned without one is kept.

    Raises:
        ConfigError: if those are fewer than folds.
    """
    decisions, settings = ready.true.decisions, ready.settings
    assert decisions is not None
    episode = torch.searchsorted(ready.store.start, decisions.known["row"], right=True) - 1
    own = torch.isin(episode, recorded_episodes(ready.store, deployed, 1))
    episodes = len(episode[own].unique())
    if episodes < folds:
        raise ConfigError(
            f"folds={folds}, but RL takes decisions of {episodes} episodes of the policy that it begins"
            " with; fewer folds, or more rounds.deploy"
        )
    played = episode.unique()
    told = dict(zip(played.tolist(), tasks_of_episodes(cfg, ready.store, played), strict=True))
    tasks = sorted(set(told.values()))
    task = torch.tensor([tasks.index(told[each]) for each in episode.tolist()])
    steps = looks(steps_of(settings, imagined_chunks(cfg)))
    fold = folds_of(episode, own, folds, settings.seed)
    parts = (ready.algorithm, decisions, settings, episode, task)

    def without(out: int) -> list[Moment]:
        made = keep(
            f"fold-{out}",
            {"fold": out, "folds": folds, "steps": steps},
            lambda: packed(learned_without(*parts, fold == out, steps)),
        )
        return unpacked(made)

    bar = tqdm(range(folds), desc="folds", unit="fold", dynamic_ncols=True)
    moments = joined([without(out) for out in bar])
    by_task = [{"task": each, **_row(moments[-1], place)} for place, each in enumerate(tasks)]
    rows = [_row(moment, None) for moment in moments]
    return Found(rows, by_task if len(tasks) > 1 else [], len(own), int(own.sum()), episodes)


def steps_of(settings: RLConfig, chunks: int) -> int:
    """Updates of a round: as many as imagined decisions fill, if no episode ends early."""
    minibatches = max(1, round(settings.envs * chunks / settings.minibatch))
    return settings.iterations * settings.epochs * minibatches


def looks(steps: int) -> list[int]:
    """After how many of all steps is looked, rising to all of them."""
    return sorted({max(1, steps // part) for part in _LOOKS})


def _row(moment: Moment, task: int | None) -> dict[str, Any]:
    def of(found: Tensor, tasks: Tensor) -> Measured | None:
        return mean_gain(found if task is None else found[tasks == task])

    return {
        "steps": moment.steps,
        "kl": moment.kl if math.isfinite(moment.kl) else None,  # nothing was drawn
        "learned": of(moment.learned, moment.learned_tasks),
        "left_out": of(moment.left_out, moment.left_out_tasks),
    }


def plain(found: Found) -> dict[str, Any]:
    """All of it as JSON takes it."""

    rows = {"by_steps": [*map(plain_row, found.by_steps)], "by_task": [*map(plain_row, found.by_task)]}
    return {**rows, "decisions": found.decisions, "own": found.own, "episodes": found.episodes}


def tables(found: Found, folds: int) -> str:
    """Markdown, and what follows."""
    title = (
        "Gain in return per episode, by decisions that were drawn [95% interval], from"
        f" {found.decisions} recorded decisions alone, of which {found.own} in {found.episodes} episodes are"
        f" the policy's own; each of {folds} parts of these is left out once"
    )
    rows = [
        [f"{row['steps']}", "-" if row["kl"] is None else f"{row['kl']:.3f}", *_gains(row)]
        for row in found.by_steps
    ]
    lines = [title, "", markdown_table(["steps", "KL, nats", *_COLUMNS], rows)]
    if found.by_task:
        rows = [[row["task"], *_gains(row)] for row in found.by_task]
        lines += ["", markdown_table(["task, after all steps", *_COLUMNS], rows)]
    return "\n".join([*lines, "", *_follows(found.by_steps)])


def _gains(row: Mapping[str, Any]) -> list[str]:
    learned, left_out = row["learned"], row["left_out"]
    return [
        "-" if learned is None else f"{learned.value:+.3f}",
        "-" if left_out is None else left_out.interval("+.3f"),
    ]


def _follows(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """What the rows mean for who sets RL's steps."""
    last = rows[-1]
    if last["learned"] is None or last["left_out"] is None:
        return []
    kept = last["left_out"].value / max(last["learned"].value, 1e-9)
    lines = [f"{100 * max(0.0, kept):.0f}% of what is learned holds on episodes that were not learned from."]
    if kept < _HOLDS:
        lines[0] += (
            " The rest is noise that the policy overfits; more episodes (rounds.deploy) tell it from what is"
            " true."
        )
    best = max((row for row in rows if row["left_out"] is not None), key=lambda row: row["left_out"].value)
    if best["left_out"].value > last["left_out"].value + 2 * last["left_out"].error:
        lines.append(f"After {best['steps']} steps it was more: fewer rl.epochs or rounds.iterations.")
    return lines
