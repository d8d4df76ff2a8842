"""The judge that asks a vision-language model whether the task is done (WPE judges rollouts so: every n-th
frame, the task's text, five votes).

A judge is handed clips: a chunk at a time while a policy learns, whole episodes where it is measured. One
question is about a span of frames (a chunk, or the clip) and shows the episode's first frame, every n-th
frame of the span and its last. What happened between the first frame and the span is not shown: a chunk is
all that a judge is handed, and so an answer depends on nothing that came before. The question is whether the
task is done by the last picture; its answer, the share of yes among the votes, holds for all frames of the
span. `hold` therefore counts spans' frames: up to the length of a span, one yes is a success, and with more,
several spans in a row must say so.

Spans of a clip are asked about in order, and none after the first success or after one that nobody could
judge: there an imagined episode would have ended, too. Frames that repeat the one before to the clip's end
show nothing new and take its answer.
"""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine, Mapping, Sequence
from concurrent.futures import Future
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from envs.judges.base import Judge, Judgement
from envs.judges.vlm.answers import Tally, Votes
from envs.judges.vlm.asking import Asker, Asking, background_loop
from envs.judges.vlm.chat import Question
from envs.judges.vlm.ledger import Budget, spent
from envs.judges.vlm.pictures import Pictures, new_frames
from envs.judges.vlm.prompt import Prompt, prompt_file
from envs.ranges import Count
from envs.specs import Status, WorldSpec
from envs.targets import OptionsOf, build
from envs.targets import options as options_of

_SERVED = ("url", "key")  # of chat; answers are remembered without them, too
_ASKED = ("asking", "budget")


class Ticket(NamedTuple):
    """Clips that are being judged, on their way to shares [T] and a status each."""

    answers: Future[list[Answer]]
    device: torch.device


class Answer(NamedTuple):
    """What came of a clip: the share of yes in each frame [T], and whether it is worth anything."""

    shares: list[float]
    status: Status


class VLMJudge(Judge):
    """Asks a model about pictures; success and progress are the share of yes.

    A span of which no answer has more than half of the votes is ABSTAIN, or ERROR where answers are missing.

    Args:
        spec: what frames show.
        hold: frames in a row that make an episode a success.
        cameras: which are shown: "all", "main", or names.
        chat: the model (chat.py): `_target_` and its options.
        prompt: a name of the folder prompts/, or the path of a text file (prompt.py).
        pictures, votes, asking, budget: see these classes.

    Raises:
        ConfigError: if the model, its key or the prompt are not there.
    """

    rehearsed = False  # a local model is read from its folder
    charges = True

    def __init__(
        self,
        spec: WorldSpec,
        hold: Count,
        cameras: str | Sequence[str],
        chat: Mapping[str, Any],
        prompt: str,
        pictures: Annotated[Mapping[str, Any], OptionsOf(Pictures)],
        votes: Annotated[Mapping[str, Any], OptionsOf(Votes)],
        asking: Annotated[Mapping[str, Any], OptionsOf(Asking)],
        budget: Annotated[Mapping[str, Any], OptionsOf(Budget)],
    ):
        super().__init__(hold)
        self.spec, self.views = spec, spec.embodiment.views_of(cameras)
        self.pictures = options_of(Pictures, pictures, "judge.pictures")
        self.votes = options_of(Votes, votes, "judge.votes")
        self.calibrates = self.votes.calibrate
        self._prompt_option = prompt
        self.prompt = Prompt(prompt, [spec.embodiment.views[view] for view in self.views])
        limits = options_of(Budget, budget, "judge.budget")
        self.asker = Asker(build(chat, "judge.chat"), options_of(Asking, asking, "judge.asking"), limits)

    @classmethod
    def check(cls, options: Mapping[str, Any]) -> None:
        """See Judge.check: the key, the model's name or folder, and the prompt are there."""
        build(options["chat"], "judge.chat")
        Prompt(options["prompt"], ())

    @classmethod
    def remedy(cls, options: Mapping[str, Any]) -> str:
        """See Judge.remedy."""
        return (
            f"more than half of judge.votes.count={options['votes']['count']} answers must end with the same"
            f" of two lines, as judge.prompt={options['prompt']} asks them to; choose another prompt or model"
            " (judge.chat), and see in judge_cost how many answers were unusable and how many did not come"
        )

    @classmethod
    def files(cls, options: Mapping[str, Any]) -> tuple[Path, ...]:
        """See Judge.files: the prompt."""
        return (prompt_file(options["prompt"]),)

    @classmethod
    def decisive(cls, options: Mapping[str, Any]) -> Mapping[str, Any]:
        """See Judge.decisive: not where the model is served, how patiently it is asked, or for how much."""
        chat = {key: value for key, value in options["chat"].items() if key not in _SERVED}
        return {key: value for key, value in options.items() if key not in _ASKED} | {"chat": chat}

    @classmethod
    def spent(cls, options: Mapping[str, Any]) -> dict[str, float]:
        """See Judge.spent: see ledger.py for what is counted."""
        limits = options_of(Budget, options["budget"], "judge.budget")
        return spent(Path(options["asking"]["cache"]), limits)

    def score(
        self, frames: Tensor, first: Tensor, instruction: list[str], features: Tensor | None = None
    ) -> Judgement:
        """See Judge.score.

        Raises:
            JudgeError: if the budget is spent, or nobody can answer.
        """
        return self.fetch(self.submit(frames, first, instruction))

    def submit(
        self, frames: Tensor, first: Tensor, instruction: list[str], features: Tensor | None = None
    ) -> Ticket:
        """See Judge.submit; the first questions are under way when it returns."""
        clips = zip(frames.cpu().numpy(), first.cpu().numpy(), list(instruction), strict=True)
        work = self._clips([self._clip(*clip) for clip in clips])
        return Ticket(asyncio.run_coroutine_threadsafe(work, background_loop()), frames.device)

    def fetch(self, ticket: Ticket) -> Judgement:
        """See Judge.fetch."""
        answers = ticket.answers.result()
        shares = torch.tensor([answer.shares for answer in answers], dtype=torch.float32)
        status = torch.tensor([answer.status.value for answer in answers], dtype=torch.int64)
        success = shares.to(ticket.device)
        return Judgement(success, success.clone(), status.to(ticket.device))

    async def _clips(self, work: list[Coroutine[Any, Any, Answer]]) -> list[Answer]:
        """What comes of clips; what it cost is written down even where it broke off."""
        try:
            return await _all(work)
        finally:
            self.asker.ledger.write()

    async def _clip(self, frames: NDArray[np.uint8], first: NDArray[np.uint8], instruction: str) -> Answer:
        """Judge a clip uint8 [T, V, 3, H, W] of the episode that began with `first` [V, 3, H, W]."""
        shares: list[float] = []
        run = 0
        for span in self.pictures.spans(new_frames(frames), self.spec.chunk):
            tally = await self._tally(self._question(frames, first, instruction, span))
            if tally.status is not Status.OK:
                return Answer([0.0] * len(frames), tally.status)
            shares += [tally.share] * len(span)
            run = run + len(span) if tally.share >= float(self.threshold) else 0
            if run >= self.hold and not self.calibrates:
                break
        return Answer([*shares, *[shares[-1]] * (len(frames) - len(shares))], Status.OK)

    def _question(
        self, frames: NDArray[np.uint8], first: NDArray[np.uint8], instruction: str, span: range
    ) -> Question:
        shown = [first, *(frames[k] for k in self.pictures.shown(span))]
        drawn = tuple(self.pictures.draw(frame, self.views) for frame in shown)
        return Question(self.prompt(instruction, len(drawn) - 1), drawn)

    async def _tally(self, question: Question) -> Tally:
        """The votes on a question: all if the threshold is to be set, else those that may decide."""
        tally = Tally(self.votes.count)
        while more := tally.count - tally.votes if self.calibrates else tally.missing:
            votes = range(tally.votes, tally.votes + more)
            for reply in await _all([self.asker.ask(question, vote) for vote in votes]):
                usable = tally.add(reply)
                if reply is not None:
                    self.asker.heard(usable, reply.text, f"judge.prompt={self._prompt_option}")
        self.asker.ledger.add("unusable", tally.unusable)
        return tally


async def _all(work: list[Coroutine[Any, Any, Any]]) -> list[Any]:
    """The results of work that is done side by side; an error is raised when all of it has come to an end, so
    that what was paid for is kept.
    """
    results = await asyncio.gather(*work, return_exceptions=True)
    for result in results:
        if isinstance(result, BaseException):
            raise result
    return results
