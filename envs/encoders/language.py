"""Instructions as numbers: words as bags of hashed character n-grams (Bojanowski et al. 2017, fastText).

No vocabulary and no download: a word that training never saw lies near the known words it shares n-grams
with. Rollouts carry the text as bytes (specs.text_to_bytes); whoever needs numbers encodes them here.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from envs.rng import constant_generator
from envs.specs import TEXT_BYTES, text_to_bytes

BUCKETS = 4096  # rows of the fixed random table that n-grams are hashed into
FEATURES = 128  # numbers of a row
GRAMS = (3, 4, 5)  # characters of an n-gram, word ends included; whole words count beside them
_SEED = 20240229
_PRIME = 1_099_511_628_211  # of FNV-1a
_SEPARATOR = 32


class TextEncoder(nn.Module):
    """Instructions to learned vectors: fixed features of words and their order, through a linear map.

    A word is the mean of fixed random rows, one for each of its n-grams and one for itself; an instruction is
    the mean of its words. Half of the features are weighted by where a word stands, each with a frequency of
    its own, so that "the cup onto the plate" differs from "the plate onto the cup".

    Args:
        out_features: size of the vector, D.

    Forward takes texts as uint8 UTF-8 bytes [..., TEXT_BYTES] and returns float32 [..., D].

    Examples:
        >>> encoder = TextEncoder(16)
        >>> encoder.encode(["open the drawer", "close the drawer"]).shape
        torch.Size([2, 16])
    """

    table: Tensor
    powers: Tensor
    waves: Tensor

    def __init__(self, out_features: int):
        super().__init__()
        self.out_features = out_features
        draw = constant_generator(_SEED)
        self.register_buffer("table", torch.randn(BUCKETS, FEATURES, generator=draw), persistent=False)
        powers = [1]
        for _ in range(TEXT_BYTES + 2):
            powers.append(_wrap(powers[-1] * _PRIME))
        self.register_buffer("powers", torch.tensor(powers), persistent=False)
        still = torch.zeros(FEATURES - FEATURES // 2)
        waves = torch.cat((still, torch.logspace(-0.5, 0.5, FEATURES // 2)))
        self.register_buffer("waves", waves, persistent=False)
        self.map = nn.Linear(FEATURES, out_features)

    def forward(self, text: Tensor) -> Tensor:
        rows = text.reshape(-1, text.shape[-1])
        # A batch holds few different texts, each many times: those alone are hashed.
        prints = (rows.long() * self.powers[1 : 1 + rows.shape[-1]]).sum(-1)
        _, first, place = _first_of_each(prints)
        return self.map(self.features(rows[first]))[place].reshape(*text.shape[:-1], -1)

    def encode(self, texts: Sequence[str]) -> Tensor:
        """Vectors float32 [N, D] of texts."""
        return self(text_to_bytes(texts).to(self.table.device))

    @torch.no_grad()
    def features(self, text: Tensor) -> Tensor:
        """Fixed features float32 [N, FEATURES], each about unit variance, of bytes uint8 [N, TEXT_BYTES]."""
        code = _letters(text)
        inside = code != _SEPARATOR
        begins = inside & ~torch.roll(inside, 1, 1)  # column 0 and the last are separators
        word = begins.long().cumsum(1) - 1  # of every letter, its word's number
        words = int(begins.sum(1).max().clamp(min=1))
        total = self.table.new_zeros(len(code), words, FEATURES)
        count = self.table.new_zeros(len(code), words)
        for size in GRAMS:
            windows, owners = code.unfold(1, size, 1), word[:, 1 : code.shape[1] - size + 2]
            hashed = (windows * self.powers[1 : 1 + size]).sum(-1) + size
            whole = inside.unfold(1, size, 1)[..., 1:-1].all(-1)  # within one word, its ends included
            self._add(hashed, owners, whole, total, count)
        start = torch.where(begins, torch.arange(code.shape[1], device=code.device), 0).cummax(1).values
        offset = torch.arange(code.shape[1], device=code.device) - start
        letters = torch.where(inside, code * self.powers[1 + offset], 0)
        hashed = torch.zeros(len(code), words, dtype=torch.int64, device=code.device)
        hashed.scatter_add_(1, word.clamp(min=0), letters)
        numbers = torch.arange(words, device=code.device).expand(len(code), -1)
        there = numbers < begins.sum(1, keepdim=True)
        self._add(hashed, numbers, there, total, count)
        vectors = total / count.clamp(min=1).sqrt()[..., None]
        vectors = vectors * torch.cos(numbers[..., None] * self.waves)
        return vectors.sum(1) / there.sum(1, keepdim=True).clamp(min=1).sqrt()

    def _add(self, hashed: Tensor, owners: Tensor, valid: Tensor, total: Tensor, count: Tensor) -> None:
        """Add the rows of hashes [N, L], where valid, to their words' totals [N, W, F] and counts [N, W]."""
        row, at = valid.nonzero(as_tuple=True)
        bucket = _mix(hashed[row, at]) % BUCKETS
        words = owners[row, at]
        total.index_put_((row, words), self.table[bucket], accumulate=True)
        count.index_put_((row, words), torch.ones_like(words, dtype=count.dtype), accumulate=True)


def _letters(text: Tensor) -> Tensor:
    """Lower-case bytes int64 [N, L + 2] of uint8 [N, L]: all that is no letter or digit separates words."""
    code = text.long()
    code = torch.where((code >= 65) & (code <= 90), code + 32, code)
    letter = ((code >= 97) & (code <= 122)) | ((code >= 48) & (code <= 57)) | (code >= 128)
    return nn.functional.pad(torch.where(letter, code, _SEPARATOR), (1, 1), value=_SEPARATOR)


def _first_of_each(prints: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Different values of [N], where each stands first, and for every row which it is."""
    values, place = torch.unique(prints, return_inverse=True)
    rows = torch.arange(len(prints), device=prints.device)
    first = torch.full_like(values, len(prints)).scatter_reduce_(0, place, rows, "amin")
    return values, first, place


def _mix(hashed: Tensor) -> Tensor:
    """Spreads int64 hashes over all bits; not negative."""
    hashed = (hashed ^ ((hashed >> 29) & 0x7_FFFF_FFFF)) * 0x9E3779B97F4A7C1
    return (hashed >> 20) & 0x7FF_FFFF_FFFF


def _wrap(value: int) -> int:
    """As int64 arithmetic leaves it."""
    return (value + 2**63) % 2**64 - 2**63
