"""Values of candidates on the same starts: true ones in physics, estimated ones in an imagined world."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from actors.factory import build_world
from envs.episodes.clips import ClipStore
from envs.initial_states import InitialStates
from envs.manifest import mark_of
from envs.targets import ConfigError
from pipeline.evaluation.by_task import evenly, groups_of_episodes
from pipeline.evaluation.value.agreement import Cell
from pipeline.evaluation.value.candidates import Candidate
from pipeline.evaluation.value.trials import COUNT, Imagination, Physics
from pipeline.evaluation.value.whole import Onlooker
from pipeline.graph.kept import Kept, Tensors
from pipeline.outside import fingerprint

Cfg = Mapping[str, Any]
_SIDE_BY_SIDE = 64  # imagined episodes
_ALIKE = 12.0  # mean grey levels between a recorded picture and its start rendered anew; encoding costs some
_NEARER = 0.5  # mean grey levels, more than encoding a picture changes its distance to others


@dataclass(frozen=True)
class Comparison:
    """Who is compared on what.

    Args:
        cfg: the resolved config.
        data: the data sets behind the store.
        store: recorded episodes.
        starts: numbers int64 [N] of those in whose first frames all begin, by task.
        candidates: everybody.
        spread: float32 [A], see candidates.action_spread.

    Attributes:
        counted: what the judge counted in `imagined`, of parts that were kept as well (see trials.counted).
    """

    cfg: Cfg
    data: Sequence[Path]
    store: ClipStore
    starts: Mapping[str, Tensor]
    candidates: Sequence[Candidate]
    spread: Tensor
    counted: Counter[str] = field(default_factory=Counter, init=False)

    @property
    def count(self) -> int:
        """Candidates over all tasks."""
        return len(self.starts) * len(self.candidates)

    def true(self, identity: Mapping[str, Any], kept: Kept) -> dict[tuple[str, str], Tensors]:
        """Outcomes in physics by task and candidate, see Physics.outcome.

        Args:
            identity: what tells this physics from others.

        Raises:
            ConfigError: if physics lays out other starts than those that were recorded.
        """
        physics = Physics(self.cfg, identity, kept, self.spread)
        out: dict[tuple[str, str], Tensors] = {}
        try:
            with self._bar("true values") as bar:
                for task, episodes in self.starts.items():
                    seeds = [int(self.store.episodes[n]["seed"]) for n in episodes.tolist()]
                    first = self.store.frames(self.store.start[episodes])
                    check_starts(physics.strangeness(seeds, first, self._where(episodes)), episodes, seeds)
                    for candidate in self.candidates:
                        about = self._about(candidate)
                        out[task, candidate.name] = physics.outcome(candidate, about, seeds)
                        bar.update()
        finally:
            physics.close()
        return out

    def imagined(
        self,
        parts: tuple[Any, Any, Any],
        identity: Mapping[str, Any],
        kept: Kept,
        true: Mapping[tuple[str, str], Tensors],
    ) -> list[Cell]:
        """What comes of every candidate in every task in imagination, beside its true outcomes.

        Args:
            parts: simulator, state expert on it, and judge.
            identity: what tells this world from others.
            true: see `true`; {} where there is no physics.
        """
        # repeats are to draw other noise, whatever the run's episodes share
        drawn = {**self.cfg, "simulator": {**self.cfg["simulator"], "shared_noise": False}}
        simulator, decoder, judge = parts
        whole = self.cfg["policy_value"]["judged"] == "whole"
        if whole:
            judge = Onlooker(judge, self.cfg["task"]["horizon"] // self.cfg["task"]["chunk"])
            rewards = {**self.cfg["judge"]["rewards"], "progress": 0.0}
            drawn["judge"] = {**self.cfg["judge"], "rewards": rewards}
        cells = []
        with self._bar("imagined values") as bar:
            for task, episodes in self.starts.items():
                first = InitialStates.of(self.store, episodes)
                env = build_world(drawn, simulator, decoder, judge, first, min(_SIDE_BY_SIDE, len(episodes)))
                mine = {**identity, **self._where(episodes), **({"judged": "whole"} if whole else {})}
                imagination = Imagination(self.cfg, env, mine, kept, self.spread)
                for candidate in self.candidates:
                    known = true.get((task, candidate.name))
                    about = self._about(candidate)
                    made = [
                        imagination.outcome(candidate, about, repeat, known)
                        for repeat in range(self.cfg["policy_value"]["repeats"])
                    ]
                    for one in made:
                        told = ((name, int(value)) for name, value in one.items() if name.startswith(COUNT))
                        self.counted.update({name.removeprefix(COUNT): value for name, value in told})
                    won, judged = (torch.stack([one[key] for one in made]) for key in ("success", "judged"))
                    success = known["success"] if known else None
                    cells.append(Cell(candidate.name, task, candidate.inside, won, judged, success))
                    bar.update()
        return cells

    def _bar(self, title: str) -> tqdm:
        return tqdm(total=self.count, desc=title, unit="cell", dynamic_ncols=True)

    def _where(self, episodes: Tensor) -> dict[str, Any]:
        """What tells recorded starts from others."""
        mark = fingerprint([str(path) for path in self.data], "imagined.data")
        return {"data": mark, "episodes": episodes.tolist()}

    def _about(self, candidate: Candidate) -> dict[str, Any]:
        """What tells a candidate's behaviour from others'; names are none of it."""
        about = {key: value for key, value in asdict(candidate).items() if key not in ("name", "weights")}
        weights = "" if candidate.weights is None else mark_of(candidate.weights)
        unit = [round(value, 6) for value in self.spread.tolist()] if candidate.noise else []
        stochastic = self.cfg["policy_value"]["stochastic"]
        return {**about, "weights": weights, "stochastic": stochastic, "spread": unit}


def starts_of(cfg: Cfg, store: ClipStore, held: Tensor) -> dict[str, Tensor]:
    """Numbers int64 [N] of held-out episodes by task, policy_value.starts of each at most.

    Where words alone tell tasks apart (see groups_of_episodes) it is so many of all together, of each
    instruction as many as of the others.
    """
    count, groups = cfg["policy_value"]["starts"], groups_of_episodes(cfg, store, held)
    group = dict(zip(held.tolist(), groups, strict=True))
    if not cfg["task"].get("suite"):
        held = evenly(cfg, store, held, count)
    tasks = [group[number] for number in held.tolist()]
    mine = {task: held[torch.tensor([one == task for one in tasks])] for task in sorted(set(tasks))}
    return {task: episodes[:count] for task, episodes in mine.items()}


def check_starts(off: Tensor, episodes: Tensor, seeds: Sequence[int]) -> None:
    """See that physics lays out the starts that were recorded: data without seeds say their numbers instead.

    Args:
        off: see Physics.strangeness.

    Raises:
        ConfigError: if a recorded first picture is more like another's start than like its own.
    """
    own = off.diagonal()
    wrong = ((own > _ALIKE) | (own > off.amin(1) + _NEARER)).nonzero().flatten().tolist()
    if wrong:
        n = wrong[0]
        raise ConfigError(
            f"physics lays out other starts than {len(wrong)} of {len(seeds)} held-out episodes had: from"
            f" seed {seeds[n]} another picture than the first of episode {int(episodes[n])}"
            f" ({float(own[n]):.1f} grey levels apart), so nobody knows their true values; name data sets"
            " that this task's physics recorded by imagined.data=[folder], or a task without a suite"
        )


def task_of(cfg: Cfg) -> dict[str, Any]:
    """What tells a task from others."""
    task = {key: cfg["task"].get(key) for key in ("suite", "name", "size", "chunk", "horizon", "mode")}
    return {"task": task, "seed": cfg["seed"]}
