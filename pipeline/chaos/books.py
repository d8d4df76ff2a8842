"""The books of a soak: what was done to which stage, and what came of it."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field


@dataclass
class Books:
    """What was done and what came of it.

    Args:
        events: disturbances so far, by the stage that they met and by kind; "start" is before any stage.
        answers: what came of them, by kind.
        launches: disturbances by launch.
        runs: disturbed runs that came through, equal to the reference.
        lives: processes that were started.
        undisturbed: lives that ended before their disturbance came.
        seconds: spent.
    """

    events: dict[str, dict[str, int]] = field(default_factory=dict)
    answers: dict[str, int] = field(default_factory=dict)
    launches: dict[str, int] = field(default_factory=dict)
    runs: int = 0
    lives: int = 0
    undisturbed: int = 0
    seconds: float = 0.0

    @property
    def count(self) -> int:
        """Disturbances so far."""
        return sum(sum(kinds.values()) for kinds in self.events.values())

    @property
    def kinds(self) -> Counter[str]:
        """Disturbances so far by kind, over all stages."""
        out: Counter[str] = Counter()
        for kinds in self.events.values():
            out.update(kinds)
        return out

    def note(self, stage: str, kind: str, launch: str, answer: str) -> None:
        """Enter a disturbance and its answer."""
        met = self.events.setdefault(stage, {})
        met[kind] = met.get(kind, 0) + 1
        for held, name in ((self.answers, f"{kind}: {answer}"), (self.launches, launch)):
            held[name] = held.get(name, 0) + 1
