"""worldloop gradients: how much RL can learn from imagined decisions, beside recorded ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from actors.fleets.fleet import EpisodeLedger
from actors.fleets.launch import build_fleet
from actors.policies.contract import device_of, trained_part
from actors.rollouts.host import trained_weights
from envs.files import write_json
from envs.rng import order_generator
from envs.targets import ConfigError
from learners.rl.feed import build_feed
from learners.rl.ppo import PPO
from pipeline.commands.worlds.subject import round_inputs
from pipeline.evaluation.trust.gradients import PER, Measured, alignment, policy_gradient, signal
from pipeline.loop import build_loop
from pipeline.stages.rl import Imagination, begin, rl

LAMS = (0.0, 0.5, 0.8, 0.95)  # and the one in use; the largest hardly leans on the critic
_PARTS = 16  # of the recorded decisions


@dataclass
class Gradients:
    """Of the policy that RL of a round begins with, by lambda of GAE; None is an algorithm without one.

    Args:
        imagined: [M, P] of M batches of `decisions` imagined decisions; recorded: [16, P] of parts of
            `recorded_decisions` each, {} where there are none.
    """

    imagined: dict[float | None, torch.Tensor]
    decisions: int
    recorded: dict[float | None, torch.Tensor]
    recorded_decisions: int


def gradients(cfg: Mapping[str, Any], root: Path, number: int, batches: int) -> str:
    """A table of what imagined and recorded decisions of a round tell RL, and gradients-<round>.json.

    Args:
        cfg: the resolved config.
        root: the run's folder.
        number: of the round.
        batches: rollouts of rl.envs episodes each.

    Raises:
        ConfigError: if the run has not come so far.
    """
    if batches < 3:
        raise ConfigError(f"batches={batches}: what batches share is told by 3 of them at least")
    graph = build_loop(cfg, root)
    inputs = round_inputs(graph, root, number, "rl")
    name = f"rl-{number}"
    ready = begin(rl.view(name, graph.cfg, graph.nodes[name].settings), inputs)
    found = measured(ready, batches)
    rows = compared(found)
    used = ready.algorithm.config.lam if isinstance(ready.algorithm, PPO) else None
    kept = [
        {key: asdict(cell) if isinstance(cell, Measured) else cell for key, cell in row.items()}
        for row in rows
    ]
    about = {"decisions": found.decisions, "recorded_decisions": found.recorded_decisions}
    write_json(root / f"gradients-{number}.json", {**about, "rows": kept})
    return table(rows, batches, found.decisions, used)


def measured(ready: Imagination, batches: int) -> Gradients:
    """Gradients of so many imagined batches and of all recorded decisions, none of which is a step."""
    algorithm, policy = ready.algorithm, trained_part(ready.policy)
    settings = replace(ready.settings, schedule="sync")
    lams: tuple[float | None, ...] = (None,)
    if isinstance(algorithm, PPO):
        lams = tuple(sorted({*LAMS, algorithm.config.lam}))
    imagined: dict[float | None, list[torch.Tensor]] = {lam: [] for lam in lams}
    device = device_of(algorithm.modules())
    fleet = build_fleet(ready.recipe)
    try:
        fleet.ledger = EpisodeLedger()
        feed, weights = build_feed(fleet, algorithm, settings, ready.starts), trained_weights(ready.policy)
        for number in tqdm(range(batches), desc="imagined batches", unit="batch", dynamic_ncols=True):
            batch, _ = feed.gather(number, weights)
            for lam in lams:
                data, _ = algorithm.prepare(_credited(algorithm, lam, batch.to(device)))
                imagined[lam].append(policy_gradient(algorithm, policy, data, settings.minibatch))
    finally:
        fleet.close()
    stacked = {lam: torch.stack(some) for lam, some in imagined.items()}
    decisions, rollout = ready.true.decisions, ready.rollout
    if decisions is None or rollout is None or len(decisions) < 2 * _PARTS:
        return Gradients(stacked, len(data), {}, 0)
    recorded = {}
    for lam in tqdm(lams, desc="recorded decisions", unit="lambda", dynamic_ncols=True):
        assert isinstance(algorithm, PPO), "whoever learns from recorded decisions has a critic"
        algorithm.credit(lam if lam is not None else algorithm.config.lam)
        algorithm.value(rollout)
        decisions.revalue(rollout)
        every = decisions.sample(len(decisions), data, order_generator(settings.seed))
        parts = (every[part::_PARTS] for part in range(_PARTS))
        recorded[lam] = torch.stack(
            [policy_gradient(algorithm, policy, part, settings.minibatch) for part in parts]
        )
    return Gradients(stacked, len(data), recorded, len(decisions) // _PARTS)


def _credited(algorithm: Any, lam: float | None, batch: Any) -> Any:
    """A copy of the batch, of which the algorithm will share out returns by `lam`."""
    if lam is not None:
        algorithm.credit(lam)
    return batch.clone()


def compared(found: Gradients) -> list[dict[str, Any]]:
    """Rows by lambda: signals of imagined and recorded decisions, and cosines of their true directions with
    that of recorded ones at the largest lambda.
    """
    rows: list[dict[str, Any]] = []
    for lam, imagined in found.imagined.items():
        row: dict[str, Any] = {"lam": lam, "imagined": signal(imagined, found.decisions)}
        if found.recorded:
            last = list(found.recorded)[-1]
            mine, truth = found.recorded[lam], found.recorded[last]
            row |= {
                "recorded": signal(mine, found.recorded_decisions),
                "imagined_with_recorded": alignment(imagined, truth),
                "recorded_with_recorded": None if lam == last else alignment(mine, truth, apart=False),
            }
        rows.append(row)
    return rows


def table(rows: Sequence[Mapping[str, Any]], batches: int, decisions: int, used: float | None) -> str:
    """Markdown, and what follows for the lambda in use."""
    lines = [
        f"What the gradients of {batches} batches of {decisions} imagined decisions have in common, per {PER}"
        " decisions [95% interval]",
        "",
        "| lambda | signal of imagined | of recorded | imagined along recorded | recorded along themselves |",
        "| --- | --- | --- | --- | --- |",
    ]
    for row in rows:
        cells = (row["imagined"], row.get("recorded"), row.get("imagined_with_recorded"))
        said = [_said(cell) for cell in (*cells, row.get("recorded_with_recorded"))]
        lam = "none" if row["lam"] is None else f"{row['lam']:g}"
        lines.append(f"| {lam}{' (in use)' if used == row['lam'] else ''} | {' | '.join(said)} |")
    (mine,) = (row for row in rows if row["lam"] == used)
    return "\n".join([*lines, "", *_follows(mine, decisions)])


def _follows(row: Mapping[str, Any], decisions: int) -> list[str]:
    """What a row means for who sets rl.envs and rl.recorded."""
    imagined, recorded = row["imagined"], row.get("recorded")
    if not imagined.found:
        least = PER / max(imagined.value + 2 * imagined.error, 1e-9)
        return [
            f"No signal was found in imagined decisions: a gradient that is half signal takes {least:.0f} of"
            f" them at least, and an iteration has {decisions}. More rl.envs or rounds.iterations, or a"
            " truer world."
        ]
    lines = [
        f"A gradient that is half signal takes {PER / imagined.value:.0f} imagined decisions (the gradient"
        f" noise scale); an iteration has {decisions}."
    ]
    along = row.get("imagined_with_recorded")
    if recorded is not None and recorded.found and along is not None and along.value > 0:
        each = recorded.value / (imagined.value * along.value**2)
        lines.append(
            f"One recorded decision tells as much of the true direction as {each:.1f} imagined ones."
        )
    return lines


def _said(cell: Measured | None) -> str:
    if cell is None:
        return "-"
    return f"{cell.value:.3f} [{cell.value - 2 * cell.error:.3f}, {cell.value + 2 * cell.error:.3f}]"
