"""What asking costs: counts of this process, kept beside the answers, and the budget that ends a run."""

from __future__ import annotations

import json
import os
import socket
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

from envs.files import write_json
from envs.judges.base import JudgeError
from envs.judges.vlm.chat import Reply
from envs.ranges import Natural, NonNegative

_FOLDER = "spent"
_COUNTS = (
    *("remembered", "calls", "unanswered", "unusable", "uncounted"),
    *("prompt_tokens", "completion_tokens"),
)


@dataclass(frozen=True)
class Budget:
    """What a process may spend before the run stops; remembered answers are free, so the same command goes on
    where it was. 0 for any number.

    Args:
        calls: of the model.
        tokens: read and written; answers that are under way when they are spent still come in.
        input_price, output_price: of a million tokens read or written, by which the cost is told.
    """

    calls: Natural
    tokens: Natural
    input_price: NonNegative
    output_price: NonNegative


@dataclass
class Ledger:
    """Counts of one process under one cache folder: answers remembered, calls, tries that came to nothing,
    answers that say neither yes nor no, answers of unknown tokens, and tokens.

    Args:
        folder: of the cache; the counts lie in a file of their own there.
    """

    folder: Path
    counts: dict[str, int] = field(default_factory=lambda: dict.fromkeys(_COUNTS, 0), init=False)

    def __post_init__(self) -> None:
        name = f"{socket.gethostname()}-{os.getpid()}-{time.time_ns()}.json"
        self._path = self.folder / _FOLDER / name

    def book(self, budget: Budget) -> None:
        """Count a call that is about to be made.

        Raises:
            JudgeError: if the budget does not allow it.
        """
        tokens = self.counts["prompt_tokens"] + self.counts["completion_tokens"]
        for key, limit, used in (
            ("calls", budget.calls, self.counts["calls"]),
            ("tokens", budget.tokens, tokens),
        ):
            if limit and used >= limit:
                raise JudgeError(
                    f"judge.budget.{key}={limit} is spent ({self.counts['calls']} calls, {tokens} tokens)."
                    f" What was answered lies in {self.folder} and costs nothing again: the same command goes"
                    " on with a fresh budget"
                )
        self.counts["calls"] += 1

    def unbook(self) -> None:
        """A call was turned away before anybody worked on it."""
        self.counts["calls"] -= 1

    def add(self, name: str, count: int = 1) -> None:
        """Count something that costs nothing."""
        self.counts[name] += count

    def pay(self, reply: Reply) -> None:
        """Count the tokens of an answer, or that nobody did, and write everything down."""
        self.counts["uncounted"] += not reply.counted
        self.counts["prompt_tokens"] += reply.prompt_tokens
        self.counts["completion_tokens"] += reply.completion_tokens
        self.write()

    def write(self) -> None:
        """Leave the counts where `spent` finds them."""
        write_json(self._path, self.counts)


@cache
def _ledger(folder: Path, process: int) -> Ledger:
    return Ledger(folder)


def ledger_of(folder: Path) -> Ledger:
    """The ledger of this process for a cache folder: judges that are built one after another share it, so a
    budget is that of a whole command.
    """
    return _ledger(folder.resolve(), os.getpid())


def spent(folder: Path, budget: Budget) -> dict[str, float]:
    """Counts of all processes that ever asked under a cache folder, and their cost; "uncounted" answers, of
    which no server said the tokens, are not in it.
    """
    total = dict.fromkeys(_COUNTS, 0.0)
    for path in (folder / _FOLDER).glob("[!.]*.json"):
        counts: Mapping[str, int] = json.loads(path.read_text())
        for name in _COUNTS:
            total[name] += counts.get(name, 0)  # one of an older version lacks some
    price = budget.input_price * total["prompt_tokens"] + budget.output_price * total["completion_tokens"]
    return {**total, "cost": price / 1e6}
