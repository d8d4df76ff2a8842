"""Instructions as numbers: each word is hashed into a small table, so any words of any task have a place."""

from __future__ import annotations

import zlib

import torch
from torch import Tensor

WORDS = 12  # tokens per instruction; longer ones are cut
VOCABULARY = 1024  # 0 is padding


def tokenize(text: str) -> Tensor:
    """Token numbers int64 [WORDS] of an instruction in any language that separates words by blanks."""
    words = text.lower().replace(",", " ").replace(".", " ").split()[:WORDS]
    numbers = [1 + zlib.crc32(word.encode()) % (VOCABULARY - 1) for word in words]
    return torch.tensor(numbers + [0] * (WORDS - len(numbers)))
