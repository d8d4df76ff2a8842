"""How a model is asked: remembered answers first, some questions at a time, each with a deadline, again with
growing pauses, within the budget.
"""

from __future__ import annotations

import asyncio
import os
import threading
import time
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from envs.judges.base import JudgeError
from envs.judges.vlm.cache import AnswerCache
from envs.judges.vlm.chat import Chat, Question, Reply, Unanswered
from envs.judges.vlm.ledger import Budget, ledger_of
from envs.ranges import Count, Natural, NonNegative, Positive
from envs.targets import ConfigError

_SHOWN = 120  # last letters of an answer in a message


@dataclass(frozen=True)
class Asking:
    """How questions are asked.

    Args:
        cache: folder of answers, and of what they cost.
        in_flight: questions asked at once.
        deadline_s: seconds that one try may take.
        retries: tries after the first.
        pause_s: seconds before the second try; doubles with each.
        longest_pause_s: longest pause, and longest time that a server may ask to be left alone.
        stop_after: questions in a row without any answer, or with answers that nobody can use, after which
            the run stops, instead of dropping all episodes.
    """

    cache: str
    in_flight: Count
    deadline_s: Positive
    retries: Natural
    pause_s: NonNegative
    longest_pause_s: NonNegative
    stop_after: Count


class Asker:
    """Asks one model. All but the constructor runs in the event loop of `background_loop`.

    Args:
        chat: the model.
        options: how.
        budget: of the process.
    """

    def __init__(self, chat: Chat, options: Asking, budget: Budget):
        self.chat, self.options, self.budget = chat, options, budget
        self.cache = AnswerCache(Path(options.cache))
        self.ledger = ledger_of(Path(options.cache))
        self._room = asyncio.Semaphore(options.in_flight)
        self._door = asyncio.Lock()
        self._greeted = False
        self._over: JudgeError | ConfigError | None = None  # why nobody is asked any more
        self._quiet_until = 0.0  # seconds of the monotonic clock: one refusal slows down all questions
        self._failures = self._unusable = 0
        self._under_way: dict[str, asyncio.Task[Reply | None]] = {}

    async def ask(self, question: Question, vote: int) -> Reply | None:
        """The answer to a vote on a question; None if every try came to nothing.

        Raises:
            JudgeError: if the budget is spent or nobody can answer.
        """
        key = self.cache.key(question, self.chat.name, vote)
        if key not in self._under_way:
            known = self.cache.get(key)
            if known is not None:
                self.ledger.add("remembered")
                return known
            task = asyncio.create_task(self._fresh(key, question, vote))
            self._under_way[key] = task
            task.add_done_callback(lambda _: self._under_way.pop(key))
        return await self._under_way[key]

    async def _fresh(self, key: str, question: Question, vote: int) -> Reply | None:
        """An answer that nobody remembers; what is under way when the run must stop still comes in."""
        async with self._room:
            if self._over is not None:
                raise type(self._over)(str(self._over))
            try:
                await self._meet()
                reply = await self._tries(question, vote)
            except Unanswered as error:
                self._failed(error)
                return None
            except (JudgeError, ConfigError) as error:
                self._over = error
                raise
            self._failures = 0
            self.cache.put(key, reply)
            self.ledger.pay(reply)
            if self.budget.tokens and not reply.counted:
                raise JudgeError(
                    "the server does not say how many tokens it used, so judge.budget.tokens="
                    f"{self.budget.tokens} cannot be kept; set it to 0 and judge.budget.calls instead"
                )
            return reply

    async def _meet(self) -> None:
        """Greet the model before the first question."""
        async with self._door:
            if not self._greeted:
                await self.chat.greet()
                self._greeted = True

    async def _tries(self, question: Question, vote: int) -> Reply:
        """The first answer that comes of all tries."""
        options, attempt = self.options, 0
        while True:
            await asyncio.sleep(max(0.0, self._quiet_until - time.monotonic()))
            self.ledger.book(self.budget)
            try:
                return await asyncio.wait_for(self.chat.ask(question, vote), options.deadline_s)
            except asyncio.TimeoutError:
                limit = f"judge.asking.deadline_s={options.deadline_s:g}"
                error = Unanswered(f"no answer within {limit}")
            except Unanswered as found:
                error = found
            self.ledger.add("unanswered")
            if not error.paid:
                self.ledger.unbook()
            if error.wait > options.longest_pause_s:
                raise Unanswered(
                    f"{error}; it asks to be left alone for {error.wait:g} s, longer than"
                    f" judge.asking.longest_pause_s={options.longest_pause_s:g}"
                )
            if not error.again or attempt >= options.retries:
                raise error
            self._quiet_until = max(self._quiet_until, time.monotonic() + error.wait)
            await asyncio.sleep(min(options.longest_pause_s, options.pause_s * 2**attempt))
            attempt += 1

    def heard(self, usable: bool, text: str, option: str) -> None:
        """Count an answer that its asker could use, or could not.

        Args:
            option: the config key of the prompt, and its value.

        Raises:
            JudgeError: where too many in a row were of no use; remembered ones count, too.
        """
        self._unusable = 0 if usable else self._unusable + 1
        if self._unusable >= self.options.stop_after:
            self.ledger.write()
            end = text.strip()[-_SHOWN:]
            self._over = JudgeError(
                f"{self._unusable} answers in a row say nothing usable (judge.asking.stop_after="
                f"{self.options.stop_after}): they must end as {option} asks, and the last ends with"
                f" {end!r}. Choose another prompt or another model (judge.chat), or raise"
                " judge.chat.max_tokens where answers are cut off; answers are remembered in"
                f" judge.asking.cache={self.options.cache}"
            )
            raise self._over

    def _failed(self, error: Unanswered) -> None:
        self.ledger.write()
        self._failures += 1
        if self._failures >= self.options.stop_after:
            self._over = JudgeError(
                f"{self._failures} questions in a row came to no answer (judge.asking.stop_after="
                f"{self.options.stop_after}); the last: {error}. What was answered before is kept:"
                " set it right and start the same command again"
            )
            raise self._over


def background_loop() -> asyncio.AbstractEventLoop:
    """The event loop in which this process asks, in a thread that dies with it: whoever is told to stop does
    not wait for servers.
    """
    return _loop_of(os.getpid())


@cache
def _loop_of(process: int) -> asyncio.AbstractEventLoop:
    loop = asyncio.new_event_loop()
    threading.Thread(target=loop.run_forever, name="judge", daemon=True).start()
    return loop
