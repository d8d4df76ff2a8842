"""Whoever answers questions about pictures: the protocol, and what can go wrong."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Question:
    """Words and the pictures that they speak of, uint8 [H, W, 3] each, RGB."""

    text: str
    pictures: tuple[NDArray[np.uint8], ...]


@dataclass(frozen=True)
class Reply:
    """What was answered, and the tokens that it took to read the question and to write the answer; 0 where
    the server does not say how many.
    """

    text: str
    prompt_tokens: int
    completion_tokens: int

    @property
    def counted(self) -> bool:
        """Whether the server said how many tokens it took: no question has none, nor have words."""
        return self.prompt_tokens > 0 and (self.completion_tokens > 0 or not self.text)


class Unanswered(RuntimeError):
    """A try that came to no answer; the message says why.

    Args:
        why: in words; it holds no key.
        wait: seconds after which to come again, if the server said so.
        paid: whether the model may have worked on it.
        again: whether the same question may fare better at another time.
    """

    def __init__(self, why: str, wait: float = 0.0, paid: bool = True, again: bool = True):
        super().__init__(why)
        self.wait, self.paid, self.again = wait, paid, again


class Chat(Protocol):
    """A vision-language model."""

    @property
    def name(self) -> str:
        """What answers depend on beside the question: the model and how it is sampled. It holds no key."""
        ...

    async def greet(self) -> None:
        """Called once before the first question.

        Raises:
            JudgeError: if nobody is there, or the model is not.
        """
        ...

    async def ask(self, question: Question, vote: int) -> Reply:
        """One try at a question; equal votes on equal questions are answered alike as far as the model can.

        Raises:
            Unanswered: if it came to nothing.
            JudgeError: if no question can.
        """
        ...
