"""Instructions as tokens that condition a text world: by frozen encoders behind a learned map."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor, nn

from envs.encoders.language import FEATURES, TextEncoder
from envs.encoders.pretrained import read_pretrained
from envs.ranges import Count
from envs.simulators.row_linear import RowLinear
from envs.specs import TEXT_BYTES, text_to_bytes
from envs.targets import ConfigError

_SHOWN = 60  # letters of a text in a message


class WordEncoder(Protocol):
    """A frozen text encoder; a config names its class. It is given no text of more than TEXT_BYTES.

    Attributes:
        tokens: of every text.
        size: numbers of a token.
    """

    tokens: int
    size: int

    def check(self, texts: Sequence[str]) -> None:
        """Refuse texts that it would cut.

        Raises:
            ConfigError: naming the text and the fix.
        """

    def encode(self, texts: Sequence[str], device: torch.device) -> Tensor:
        """float32 [N, tokens, size] of texts, the same for one in any batch; zeros where it has no more."""


class HashedWords:
    """The fixed features of envs/encoders/language.py: a text is one token, and nothing is downloaded."""

    tokens, size = 1, FEATURES

    def __init__(self) -> None:
        with torch.device("cpu"):  # also where a model is built without memory: its table is no weight
            self._encoder = TextEncoder(1)  # of which only what is fixed is used

    def check(self, texts: Sequence[str]) -> None:
        """See WordEncoder; it reads every byte."""

    def encode(self, texts: Sequence[str], device: torch.device) -> Tensor:
        """See WordEncoder."""
        return self._encoder.features(text_to_bytes(texts))[:, None].to(device)


class T5Words:
    """The encoder of a T5 (Raffel et al. 2020) from a folder on disk, as in RoboScape-R.

    It is frozen and is no part of the weights of whoever uses it: those of T5-base alone are 440 MB.

    Args:
        folder: as transformers' save_pretrained writes it, with its tokenizer.
        max_tokens: of a text; longer ones are refused.

    Raises:
        ValueError: if the folder, or transformers, is not there.
    """

    def __init__(self, folder: str, max_tokens: Count):
        if not (Path(folder) / "config.json").is_file():
            raise ValueError(
                f"text_world.words.folder={folder!r} holds no T5 (config.json is not there); save one there,"
                " or use text_world.words._target_=envs.simulators.tokens.words.HashedWords, which needs none"
            )
        try:
            from transformers import AutoTokenizer, T5EncoderModel
        except ImportError as error:
            raise ValueError(
                f"T5 needs transformers, which does not import ({error}): pip install it"
            ) from error
        self.tokens = max_tokens
        self._cut: Any = AutoTokenizer.from_pretrained(folder, local_files_only=True)
        with torch.device("cpu"):  # also where a model is built without memory: it is no part of its weights
            model = read_pretrained(T5EncoderModel, folder, "text_world.words.folder")
        self._model: Any = model.requires_grad_(False)
        self.size = int(model.config.d_model)

    def check(self, texts: Sequence[str]) -> None:
        """See WordEncoder."""
        for text, numbers in zip(texts, self._cut(list(texts))["input_ids"], strict=True):
            if len(numbers) > self.tokens:
                raise ConfigError(
                    f"the instruction {text[:_SHOWN]!r}... has {len(numbers)} tokens, more than"
                    f" text_world.words.max_tokens={self.tokens}; raise it, or shorten the text"
                )

    @torch.no_grad()
    def encode(self, texts: Sequence[str], device: torch.device) -> Tensor:
        """See WordEncoder."""
        self._model.to(device)
        out = torch.zeros(len(texts), self.tokens, self.size, device=device)
        for row, text in zip(out, texts, strict=True):  # alone, so that no batch changes its last bits
            numbers = torch.tensor([self._cut(text)["input_ids"]], device=device)
            row[: numbers.shape[1]] = self._model(input_ids=numbers).last_hidden_state[0].float()
        return out


class WordReader(nn.Module):
    """Texts as tokens [B, 1, N, width] that condition a transformer.

    Args:
        words: the frozen encoder.
        width: numbers of a token.
        tokens: that a text becomes, if the encoder gives one for the whole of it.
    """

    def __init__(self, words: WordEncoder, width: int, tokens: int):
        super().__init__()
        self.words, self.each = words, tokens if words.tokens == 1 else 1
        self.map = nn.Sequential(RowLinear(words.size, width), nn.SiLU(), RowLinear(width, self.each * width))

    @property
    def device(self) -> torch.device:
        """Where its weights are."""
        return next(self.parameters()).device

    def check(self, texts: Sequence[str]) -> None:
        """Refuse texts that would be cut: by the encoder, or by those who carry them, for a text world that
        learns from clips reads what a rollout's judge reads.

        Raises:
            ConfigError: naming the text and the fix.
        """
        for text in texts:
            if len(text.encode()) > TEXT_BYTES:
                raise ConfigError(
                    f"the instruction {text[:_SHOWN]!r}... has {len(text.encode())} bytes, and clips and"
                    f" rollouts carry {TEXT_BYTES}; shorten it"
                )
        self.words.check(texts)

    def forward(self, texts: Sequence[str]) -> Tensor:
        different = sorted(set(texts))  # a batch holds few, each many times
        self.check(different)
        rows = self.map(self.words.encode(different, self.device))
        cond = rows.unflatten(-1, (self.each, -1)).flatten(1, 2)
        return cond[[different.index(text) for text in texts]][:, None]
