"""Instructions as policies learn from them: with words between that mean nothing, and some words missing.

A policy learns from few different texts, so that any other word moves its encoded instruction to where it has
never been. What is learned under such noise hangs on the words that decide, wherever they stand.
"""

from __future__ import annotations

import string

import torch
from torch import Tensor

from envs.specs import TEXT_BYTES, bytes_to_text, text_to_bytes

REWORDED = 0.5  # share of the instructions
DROPPED = 0.1  # of their words
BETWEEN = 4  # most words that are put between
LETTERS = (2, 8)  # of such a word


def reworded(text: Tensor, generator: torch.Generator) -> Tensor:
    """Instructions uint8 [N, TEXT_BYTES], about half of them in other words; see the module's docstring.

    Everything is drawn from the generator, on the CPU. What would be too long, or have no word left, stays.
    """
    chosen = torch.rand(len(text), generator=generator) < REWORDED
    said = bytes_to_text(text[chosen.to(text.device)])
    out = text.clone()
    out[chosen.to(text.device)] = text_to_bytes([_reworded(one, generator) for one in said]).to(text.device)
    return out


def _reworded(said: str, generator: torch.Generator) -> str:
    words = said.split()
    there = torch.rand(len(words), generator=generator) >= DROPPED
    kept = [word for word, stays in zip(words, there.tolist(), strict=True) if stays] or words
    for _ in range(_below(BETWEEN + 1, generator)):
        kept.insert(_below(len(kept) + 1, generator), _meaningless(generator))
    new = " ".join(kept)
    return new if len(new.encode()) <= TEXT_BYTES else said


def _meaningless(generator: torch.Generator) -> str:
    letters = torch.randint(
        26, (LETTERS[0] + _below(LETTERS[1] - LETTERS[0] + 1, generator),), generator=generator
    )
    return "".join(string.ascii_lowercase[letter] for letter in letters.tolist())


def _below(count: int, generator: torch.Generator) -> int:
    return int(torch.randint(count, (), generator=generator))
