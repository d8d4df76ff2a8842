"""From texts to yes and no, strictly, and from votes to a majority."""

from __future__ import annotations

import re
from dataclasses import dataclass

from envs.judges.vlm.chat import Reply
from envs.ranges import Count
from envs.specs import Status

# A line of its own; markdown's stars and a full stop do no harm.
_LINE = re.compile(r"[*_`#>\s]*answer[*_`\s]*:[*_`\s]*(yes|no)[*_`\s.]*", re.IGNORECASE)


def parse(text: str) -> bool | None:
    """Whether a text ends with the line "Answer: Yes" or "Answer: No"; None where it does not, or where other
    lines of it say the opposite.
    """
    lines = [line for line in text.splitlines() if line.strip()]
    found = [match[1].lower() for line in lines if (match := _LINE.fullmatch(line))]
    if not found or not _LINE.fullmatch(lines[-1]) or len(set(found)) > 1:
        return None
    return found[-1] == "yes"


@dataclass(frozen=True)
class Votes:
    """How often a question is asked.

    Args:
        count: times at most; more than half of them must say the same, or the judge abstains.
        calibrate: set the threshold on the share of yes over recorded video. Every vote is then asked;
            without it, none that cannot change the majority.
    """

    count: Count
    calibrate: bool


@dataclass
class Tally:
    """Votes on a question that may be asked `count` times."""

    count: int
    yes: int = 0
    no: int = 0
    unusable: int = 0
    unanswered: int = 0

    def add(self, reply: Reply | None) -> bool:
        """Count an answer, None if there is none; whether it says yes or no."""
        vote = None if reply is None else parse(reply.text)
        self.unanswered += reply is None
        self.unusable += reply is not None and vote is None
        self.yes += vote is True
        self.no += vote is False
        return vote is not None

    @property
    def votes(self) -> int:
        """Votes so far."""
        return self.yes + self.no + self.unusable + self.unanswered

    @property
    def missing(self) -> int:
        """Votes by which the leading answer may have its majority; 0 if it has, or if none can have one."""
        short, left = self.count // 2 + 1 - max(self.yes, self.no), self.count - self.votes
        return short if 0 < short <= left else 0

    @property
    def share(self) -> float:
        """Of yes among the usable answers, 0..1; 0 without any."""
        return self.yes / max(1, self.yes + self.no)

    @property
    def status(self) -> Status:
        """OK with a majority; else ERROR if an answer is missing, ABSTAIN if some were unusable or even."""
        if max(self.yes, self.no) > self.count // 2:
            return Status.OK
        return Status.ERROR if self.unanswered else Status.ABSTAIN
