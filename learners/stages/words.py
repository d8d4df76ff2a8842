"""Instructions as policies learn from them: with words between that mean nothing.

A policy learns from few different texts, so that any other word moves its encoded instruction to where it
has never been. What is learned under such noise hangs less on the words around those that decide, and on
where they stand. No word is left out: that was tried, and cost success where words alone tell tasks apart
(docs/results/tabletop.md).
"""

from __future__ import annotations

import string

import torch
from torch import Tensor

from envs.specs import TEXT_BYTES, bytes_to_text, text_to_bytes

REWORDED = 0.5  # share of the instructions
BETWEEN = 4  # most words that are put between
LETTERS = (2, 8)  # of such a word


def reworded(text: Tensor, generator: torch.Generator) -> Tensor:
    """Instructions uint8 [N, TEXT_BYTES], about half of them with up to BETWEEN words more.

    Everything is drawn from the generator, on the CPU. What would be too long stays as it is.
    """
    chosen = (torch.rand(len(text), generator=generator) < REWORDED).to(text.device)
    said = [_reworded(one, generator) for one in bytes_to_text(text[chosen])]
    out = text.clone()
    out[chosen] = text_to_bytes(said).to(text.device)
    return out


def _reworded(said: str, generator: torch.Generator) -> str:
    words = said.split()
    for _ in range(_below(BETWEEN + 1, generator)):
        words.insert(_below(len(words) + 1, generator), _meaningless(generator))
    new = " ".join(words)
    return new if len(new.encode()) <= TEXT_BYTES else said


def _meaningless(generator: torch.Generator) -> str:
    count = LETTERS[0] + _below(LETTERS[1] - LETTERS[0] + 1, generator)
    letters = torch.randint(26, (count,), generator=generator).tolist()
    return "".join(string.ascii_lowercase[letter] for letter in letters)


def _below(count: int, generator: torch.Generator) -> int:
    return int(torch.randint(count, (), generator=generator))
