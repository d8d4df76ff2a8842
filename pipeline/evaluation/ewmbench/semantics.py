"""What a video tells in words (EWMBench: motion semantics): its caption against the instruction (BLEU), its
steps against those of the recording, and logical errors, by a vision-language model.

The model is that of the judge (judge=vlm, judge=vlm_local), with its client, its cache and its budget.
Without one there are no such figures.
"""

from __future__ import annotations

import asyncio
import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from string import Template
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor
from torchmetrics.functional.text import bleu_score

from envs.judges.vlm.asking import Asker, background_loop
from envs.judges.vlm.chat import Question
from envs.judges.vlm.judge import VLMJudge
from envs.judges.vlm.pictures import Pictures
from envs.judges.vlm.prompt import text_file
from envs.targets import ConfigError
from pipeline.evaluation.ewmbench.features import TextExtractor, words_of

_FOLDER = Path(__file__).parent / "prompts"
_FIELDS = ("count", "cameras", "errors")
_STEP = re.compile(r"[\s*_>#-]*\d+[.):]\s*(.+)")
_ERRORS = re.compile(r"[*_`#>\s]*errors[*_`\s]*:[*_`\s]*(.*?)[*_`\s.]*", re.IGNORECASE)
_GRAMS = 4


@dataclass(frozen=True)
class LogicalError:
    """Something that cannot be, and what it costs."""

    name: str
    penalty: float
    about: str


@dataclass(frozen=True)
class VideoReport:
    """What the model said of a video; None of what it did not answer, or not as it was asked to.

    Args:
        caption: the task in a sentence.
        steps: what is done, one after the other.
        errors: names of logical errors.
    """

    caption: str | None
    steps: tuple[str, ...] | None
    errors: tuple[str, ...] | None

    @property
    def whole(self) -> bool:
        """Whether everything was answered."""
        return None not in (self.caption, self.steps, self.errors)


class Reader:
    """Asks the judge's model about videos.

    Args:
        asker, pictures, views: of a VLMJudge.
        prompts: names of the folder prompts/, or paths of text files, by caption, steps, logic and errors.
        names: of the cameras, in the order in which they are shown.

    Raises:
        ConfigError: if a prompt is missing or cannot be read.
    """

    def __init__(
        self,
        asker: Asker,
        pictures: Pictures,
        views: tuple[int, ...],
        prompts: Mapping[str, str],
        names: Sequence[str],
    ):
        self.asker, self.pictures, self.views = asker, pictures, views
        self.errors = read_errors(prompts["errors"])
        several = f" Each shows {len(names)} cameras side by side, from left to right: {', '.join(names)}."
        self._fields = {
            "cameras": several if len(names) > 1 else "",
            "errors": "\n".join(f"- {error.name}: {error.about}" for error in self.errors),
        }
        self._templates = {key: _template(prompts[key], key) for key in ("caption", "steps", "logic")}

    @classmethod
    def of(cls, judge: VLMJudge, prompts: Mapping[str, str]) -> Reader:
        """That of a judge."""
        names = [judge.spec.embodiment.views[view] for view in judge.views]
        return cls(judge.asker, judge.pictures, judge.views, prompts, names)

    @property
    def identity(self) -> dict[str, Any]:
        """What answers depend on beside the pictures."""
        texts = {key: template.template for key, template in self._templates.items()}
        shown = {"every": self.pictures.every, "side": self.pictures.side, "views": list(self.views)}
        return {"model": self.asker.chat.name, **texts, **self._fields, **shown}

    def read(self, videos: Sequence[NDArray[Any]]) -> list[VideoReport]:
        """What the model says of videos uint8 [T, V, 3, H, W].

        Raises:
            JudgeError: if the budget is spent or nobody can answer; what was answered is kept.
        """
        work = asyncio.run_coroutine_threadsafe(self._all(videos), background_loop())
        return work.result()

    async def _all(self, videos: Sequence[NDArray[Any]]) -> list[VideoReport]:
        questions = [self._ask(video, key) for video in videos for key in self._templates]
        answers = await asyncio.gather(*questions, return_exceptions=True)
        for answer in answers:  # raised when all has come to an end, so that what was paid for is kept
            if isinstance(answer, BaseException):
                raise answer
        return [self._report(answers[n : n + 3]) for n in range(0, len(answers), 3)]

    async def _ask(self, video: NDArray[Any], key: str) -> str | None:
        frames = [0, *(k for k in self.pictures.shown(range(len(video))) if k)]
        drawn = tuple(self.pictures.draw(video[k], self.views) for k in frames)
        words = self._templates[key].substitute(count=len(drawn), **self._fields)
        reply = await self.asker.ask(Question(words, drawn), 0)
        return None if reply is None else reply.text

    def _report(self, answers: Sequence[Any]) -> VideoReport:
        caption, steps, errors = answers
        report = VideoReport(
            None if caption is None else parse_caption(caption),
            None if steps is None else parse_steps(steps),
            None if errors is None else parse_errors(errors, self.errors),
        )
        parsed = (answer for answer in (report.caption, report.steps, report.errors))
        unusable = sum(a is not None and b is None for a, b in zip(answers, parsed, strict=True))
        self.asker.ledger.add("unusable", unusable)
        return report


def parse_caption(text: str) -> str | None:
    """The first line that says anything, without quotation marks; None without one."""
    lines = [line.strip(" \t\"'*_`") for line in text.splitlines()]
    return next((line for line in lines if words_of(line)), None)


def parse_steps(text: str) -> tuple[str, ...] | None:
    """The numbered lines of a text; None if there are none."""
    found = tuple(match[1].strip(" *_`") for line in text.splitlines() if (match := _STEP.fullmatch(line)))
    return found or None


def parse_errors(text: str, known: Sequence[LogicalError]) -> tuple[str, ...] | None:
    """Names in the last line, which must be "Errors: ..."; None if it is not, or says a name that is
    unknown.
    """
    lines = [line for line in text.splitlines() if line.strip()]
    match = _ERRORS.fullmatch(lines[-1]) if lines else None
    if match is None:
        return None
    listed = [" ".join(words_of(part)) for part in re.split(r"[,;]", match[1]) if words_of(part)]
    if listed == ["none"]:
        return ()
    names = {" ".join(words_of(error.name)): error.name for error in known}
    return (
        tuple(dict.fromkeys(names[one] for one in listed)) if listed and set(listed) <= set(names) else None
    )


def read_errors(name: str) -> tuple[LogicalError, ...]:
    """The list of logical errors of a file; see prompts/errors.txt.

    Raises:
        ConfigError: naming the line that is wrong.
    """
    path, out = text_file(_FOLDER, name, "ewmbench.prompts.errors"), []
    for number, line in enumerate(path.read_text().splitlines(), 1):
        if not line.strip() or line.startswith("#"):
            continue
        parts = [part.strip() for part in line.split("|")]
        try:
            error = LogicalError(parts[0], float(parts[1]), parts[2])
        except (ValueError, IndexError):
            error = LogicalError("", 0.0, "")
        if not words_of(error.name) or not 0 < error.penalty <= 1 or "," in error.name:
            raise ConfigError(
                f"ewmbench.prompts.errors: {path}:{number} should be: name | penalty, above 0 and up to 1"
                " | what"
                " it is"
            )
        out.append(error)
    if not out:
        raise ConfigError(f"ewmbench.prompts.errors: {path} holds no error: name | penalty | what it is")
    return tuple(out)


def bleu(caption: str, instruction: str, strict_parity: bool) -> float:
    """BLEU (Papineni et al. 2002) of a caption against the instruction, 0..1.

    Up to 4-grams, or as many words as the shorter of the two has, for a gram longer than either text is in
    neither, and one added to no counts would be a hit; small letters, no punctuation; one is added to the
    counts of pairs and longer grams (Lin and Och 2004), for instructions are a few words, and one gram that
    is missing would be 0. With strict_parity as in the public code: 4-grams of words as they stand between
    blanks, and nothing is added.
    """
    if strict_parity:
        return float(bleu_score([caption], [[instruction]], n_gram=_GRAMS))
    candidate, wanted = words_of(caption), words_of(instruction)
    if not set(candidate) & set(wanted):
        return 0.0
    longest, total = min(_GRAMS, len(wanted), len(candidate)), 0.0
    for length in range(1, longest + 1):
        found, due = (_grams(words, length) for words in (candidate, wanted))
        hits, more = sum((found & due).values()), int(length > 1)
        total += math.log((hits + more) / (sum(found.values()) + more))
    return math.exp(total / longest + min(0.0, 1 - len(wanted) / len(candidate)))


def _grams(words: Sequence[str], length: int) -> Counter[tuple[str, ...]]:
    """How often each run of so many words occurs."""
    return Counter(tuple(words[n : n + length]) for n in range(len(words) - length + 1))


def step_similarity(made: Sequence[str], true: Sequence[str], texts: TextExtractor) -> float:
    """How alike two descriptions are, step by step, 0..1: the largest sum of similarities of steps that are
    paired in order, over the number of steps of the longer one. What is left out or added counts 0.
    """
    return paired_in_order(texts.similarity(made, true)) / max(len(made), len(true))


def paired_in_order(similarity: Tensor) -> float:
    """The largest sum of entries [N, M] of which each later one is further down and further right."""
    count, width = similarity.shape
    best = torch.zeros(count + 1, width + 1, dtype=torch.float64)
    for n in range(1, count + 1):
        for m in range(1, width + 1):
            paired = best[n - 1, m - 1] + similarity[n - 1, m - 1]
            best[n, m] = max(paired, best[n - 1, m], best[n, m - 1])
    return float(best[-1, -1])


def logic(found: Sequence[str], known: Sequence[LogicalError]) -> float:
    """1 less the penalties of the errors found, 0 at least."""
    return max(0.0, 1 - sum(error.penalty for error in known if error.name in found))


def _template(name: str, key: str) -> Template:
    path = text_file(_FOLDER, name, f"ewmbench.prompts.{key}")
    template = Template(path.read_text())
    marks = [mark for mark in Template.pattern.finditer(template.template) if mark["escaped"] is None]
    found = {mark["named"] or mark["braced"] or "" for mark in marks}
    if found - set(_FIELDS) or (key == "logic" and "errors" not in found):
        raise ConfigError(
            f"ewmbench.prompts.{key}: {path} may say $count and $cameras, and logic must say $errors; found"
            f" {sorted(f'${field}' for field in found)} (a plain $ is written $$)"
        )
    return template
