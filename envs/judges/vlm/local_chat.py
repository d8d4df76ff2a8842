"""A vision-language model in this process, from a folder of weights in the layout of `transformers`."""

from __future__ import annotations

import asyncio
import functools
import hashlib
import json
import threading
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from envs.encoders.pretrained import read_pretrained
from envs.judges.vlm.chat import Question, Reply
from envs.ranges import Count, NonNegative
from envs.rng import vote_generator
from envs.targets import ConfigError

_SLICE = 1 << 20  # bytes of a part of a file of weights that is read to tell it from others
_SLICES = 16  # of these, spread over the file


class LocalChat:
    """Answers by the folder's own processor, chat template and model; nothing is fetched, no code of the
    folder is run.

    Args:
        path: folder with config.json, weights as safetensors, processor and chat template.
        device: auto, cpu, or cuda.
        dtype: of the weights; auto is what the folder says.
        max_tokens: of an answer.
        temperature: of sampling; at 0 all votes say the same.

    Raises:
        ConfigError: if the folder holds no such model.
    """

    def __init__(
        self,
        path: str,
        device: Literal["auto", "cpu", "cuda"],
        dtype: Literal["auto", "float32", "bfloat16", "float16"],
        max_tokens: Count,
        temperature: NonNegative,
    ):
        folder = Path(path)
        if not path or not (folder / "config.json").is_file() or not list(folder.glob("*.safetensors")):
            raise ConfigError(
                f"judge.chat.path={path!r} must be a folder with config.json and weights (*.safetensors) of a"
                " vision-language model, as `save_pretrained` of transformers leaves it"
            )
        if device == "cuda" and not torch.cuda.is_available():
            raise ConfigError("judge.chat.device=cuda, but this machine has no CUDA device; say auto or cpu")
        self.folder, self.dtype = folder, dtype
        self.device = ("cuda" if torch.cuda.is_available() else "cpu") if device == "auto" else device
        self.max_tokens, self.temperature = max_tokens, temperature
        self._parts: tuple[Any, Any] | None = None  # processor and model, loaded when they are needed
        self._lock = threading.Lock()

    @property
    def name(self) -> str:
        """See Chat.name: what the folder holds, wherever it lies."""
        return json.dumps([self._mark, self.dtype, self.max_tokens, self.temperature])

    @functools.cached_property
    def _mark(self) -> str:
        """A hash of the folder's configs and templates, and of parts of its weights."""
        found = hashlib.sha256()
        texts = [path for kind in ("*.json", "*.jinja") for path in self.folder.glob(kind)]
        for path in sorted(texts):
            found.update(f"{path.name}:{path.stat().st_size}:".encode() + path.read_bytes())
        for path in sorted(self.folder.glob("*.safetensors")):
            size = path.stat().st_size
            found.update(f"{path.name}:{size}:".encode())
            with path.open("rb") as file:
                for n in range(_SLICES):
                    file.seek(max(0, size - _SLICE) * n // (_SLICES - 1))
                    found.update(file.read(_SLICE))
        return found.hexdigest()

    async def greet(self) -> None:
        """See Chat.greet; loads the model."""
        await asyncio.to_thread(self._load)

    async def ask(self, question: Question, vote: int) -> Reply:
        """See Chat.ask; questions are answered one after another."""
        return await asyncio.to_thread(self._answer, question, vote)

    def _load(self) -> tuple[Any, Any]:
        with self._lock:
            if self._parts is None:
                self._parts = _load(self.folder, self.dtype, self.device)
            return self._parts

    def _answer(self, question: Question, vote: int) -> Reply:
        from PIL import Image

        processor, model = self._load()
        shown = [{"type": "image", "image": Image.fromarray(picture)} for picture in question.pictures]
        messages = [{"role": "user", "content": [{"type": "text", "text": question.text}, *shown]}]
        with self._lock, torch.no_grad():
            inputs = processor.apply_chat_template(
                messages, add_generation_prompt=True, tokenize=True, return_dict=True, return_tensors="pt"
            ).to(model.device, model.dtype)
            # Samples by noise on the logits (Gumbel-max) from a generator of its own: torch's global numbers
            # belong to whoever rolls out policies meanwhile.
            noise = [_Noise(self.temperature, vote)] if self.temperature else []
            out = model.generate(
                **inputs, max_new_tokens=self.max_tokens, do_sample=False, logits_processor=noise
            )
        read = inputs["input_ids"].shape[1]
        text = processor.decode(out[0, read:], skip_special_tokens=True)
        return Reply(text, read, out.shape[1] - read)


class _Noise:
    """Turns greedy decoding into sampling at a temperature.

    Args:
        temperature: above 0.
        vote: whose numbers are drawn.
    """

    def __init__(self, temperature: float, vote: int):
        self.temperature, self.generator = temperature, vote_generator(vote)

    def __call__(self, tokens: Tensor, scores: Tensor) -> Tensor:
        uniform = torch.rand(scores.shape, generator=self.generator, dtype=torch.float64).clamp(min=1e-300)
        gumbel = -torch.log(-torch.log(uniform)).to(scores.device)
        return (scores.double() / self.temperature + gumbel).to(scores.dtype)


def _load(folder: Path, dtype: str, device: str) -> tuple[Any, Any]:
    """Processor and model of a folder.

    Raises:
        ConfigError: if transformers is missing, or cannot make them.
    """
    try:
        from transformers import AutoModelForImageTextToText, AutoProcessor
    except ImportError as error:
        raise ConfigError(
            f"judge.chat runs a model of transformers, which does not import ({error}): pip install -c"
            ' constraints.txt "worldloop[vlm]"'
        ) from error
    try:
        processor = AutoProcessor.from_pretrained(folder, local_files_only=True)
        model: Any = read_pretrained(AutoModelForImageTextToText, folder, "judge.chat.path", dtype=dtype)
    except ConfigError:
        raise
    except (OSError, ValueError, ImportError, KeyError) as error:
        raise ConfigError(f"judge.chat.path={folder}: transformers cannot load it: {error}") from error
    if getattr(processor, "chat_template", None) is None:
        raise ConfigError(f"judge.chat.path={folder} holds no chat template, by which questions are put")
    return processor, model.to(device)
