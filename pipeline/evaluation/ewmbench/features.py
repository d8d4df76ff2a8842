"""Features by which scenes, whole videos and sentences are compared. Every extractor has a name, and figures
of different extractors are never compared.

The defaults need no file and know no things. DINOv2 and CLIP are read from folders on disk in the layout of
`transformers`; nothing is fetched, no code of a folder is run.
"""

from __future__ import annotations

import hashlib
import re
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from torch import Tensor
from torch.nn import functional

from envs.encoders.pretrained import read_pretrained
from envs.judges.perceptual import PerceptualDistance
from envs.manifest import digest_of
from envs.targets import ConfigError
from pipeline.evaluation.fidelity.extractors import Extractor

_AT_ONCE = 64  # pictures
_SHOWN = 60  # letters of a text in a message


class PatchExtractor(ABC):
    """Features of the patches of a picture.

    Attributes:
        name: of the network and its weights.
    """

    name: str

    def compute_on(self, device: torch.device) -> None:
        """Compute there from now on, instead of on the CPU; what has no network stays where it is."""

    @abstractmethod
    def __call__(self, pictures: Tensor) -> Tensor:
        """Features float32 [N, P, D] of pictures uint8 [N, 3, H, W], both on the CPU."""


class PyramidPatches(PatchExtractor):
    """Bands of a normalised Laplacian pyramid (judges/perceptual.py), their signs, and colours, in a grid
    of patches: structure that moves or melts changes them, and light hardly does.

    Args:
        grid: patches of a row and of a column.
    """

    def __init__(self, grid: int = 8):
        self.name = f"Laplacian pyramid in {grid} x {grid} patches, no learned weights"
        self._grid, self._pyramid = grid, PerceptualDistance(levels=3)

    def __call__(self, pictures: Tensor) -> Tensor:
        """Features float32 [N, grid * grid, 12 * (bands + 1)]: four points of each band in each patch."""
        *bands, rest = self._pyramid.bands(pictures)
        centred = rest - torch.tensor([0.5, 0.0, 0.0])[:, None, None]
        out = []
        for band in (*bands, centred):
            fine = functional.adaptive_avg_pool2d(band, 2 * self._grid)
            out.append(functional.unfold(fine, 2, stride=2).transpose(1, 2))
        return torch.cat(out, -1)


class DinoPatches(PatchExtractor):
    """Patch tokens of a DINOv2 or DINOv3 network, as it was published or tuned on pictures of robots.

    Args:
        path: its folder, as `save_pretrained` of transformers leaves it.
        side: pixels of a picture's shorter side that the network sees.
    """

    def __init__(self, path: str, side: int = 224):
        self._network, config = pretrained(path, ("dinov2", "dinov2_with_registers", "dinov3_vit"), "DINOv2")
        self._patch, self._side = int(config.patch_size), side
        # the class token and registers stand before the patches
        self._before = 1 + int(getattr(config, "num_register_tokens", 0))
        self.name = f"{config.model_type} patches at {side} ({fingerprint(path)})"
        self._mean, self._spread = _colours([0.485, 0.456, 0.406]), _colours([0.229, 0.224, 0.225])

    def compute_on(self, device: torch.device) -> None:
        """See PatchExtractor.compute_on."""
        self._network = self._network.to(device)
        self._mean, self._spread = self._mean.to(device), self._spread.to(device)

    @torch.no_grad()
    def __call__(self, pictures: Tensor) -> Tensor:
        """Features float32 [N, P, D]."""
        height, width = pictures.shape[-2:]
        scale = self._side / min(height, width)
        size = [max(1, round(n * scale / self._patch)) * self._patch for n in (height, width)]
        out = []
        for some in pictures.split(_AT_ONCE):
            seen = _resized(some.to(self._mean.device).float() / 255, size)
            seen = (seen - self._mean) / self._spread
            out.append(self._network(pixel_values=seen).last_hidden_state[:, self._before :].float().cpu())
        return torch.cat(out)


class ClipFrames(Extractor):
    """CLIP's embedding of pictures.

    Args:
        path: folder of a CLIP model.
    """

    clips = False

    def __init__(self, path: str):
        self._network, config = pretrained(path, ("clip",), "CLIP")
        self._side = int(config.vision_config.image_size)
        self.name = f"CLIP pictures ({fingerprint(path)})"
        self._mean, self._spread = _colours([0.4815, 0.4578, 0.4082]), _colours([0.2686, 0.2613, 0.2758])

    def compute_on(self, device: torch.device) -> None:
        """See Extractor.compute_on."""
        self._network = self._network.to(device)
        self._mean, self._spread = self._mean.to(device), self._spread.to(device)

    @torch.no_grad()
    def __call__(self, pictures: Tensor) -> Tensor:
        """Features float32 [N, D]."""
        out = []
        for some in pictures.split(_AT_ONCE):
            seen = _resized(some.to(self._mean.device).float() / 255, [self._side, self._side])
            seen = (seen - self._mean) / self._spread
            out.append(_embedding(self._network.get_image_features(pixel_values=seen)).cpu())
        return torch.cat(out)


class TextExtractor(ABC):
    """How alike sentences are.

    Attributes:
        name: of what compares them.
    """

    name: str

    @abstractmethod
    def similarity(self, one: Sequence[str], other: Sequence[str]) -> Tensor:
        """float32 [N, M] in 0..1 of N and M sentences."""


class WordGrams(TextExtractor):
    """Cosine of counts of words and of pairs of words; synonyms are strangers to it."""

    name = "words and pairs of words, no learned weights"

    def similarity(self, one: Sequence[str], other: Sequence[str]) -> Tensor:
        """See TextExtractor."""
        bags = [[_grams(text) for text in side] for side in (one, other)]
        out = torch.zeros(len(one), len(other))
        for n, a in enumerate(bags[0]):
            for m, b in enumerate(bags[1]):
                length = (sum(v * v for v in a.values()) * sum(v * v for v in b.values())) ** 0.5
                out[n, m] = sum(a[gram] * b[gram] for gram in a) / length if length else 0.0
        return out


class ClipTexts(TextExtractor):
    """Cosine of CLIP's embeddings of sentences.

    Args:
        path: folder of a CLIP model with its tokenizer.

    Raises:
        ConfigError: also by `similarity`, for a sentence that the model would cut.
    """

    def __init__(self, path: str):
        self._network, config = pretrained(path, ("clip",), "CLIP")
        from transformers import AutoTokenizer

        if not any((Path(path) / name).is_file() for name in ("tokenizer.json", "vocab.json")):
            raise ConfigError(f"path={path} holds no tokenizer (tokenizer.json), by which texts are read")
        try:
            self._tokenizer: Any = AutoTokenizer.from_pretrained(path, local_files_only=True)
        except (OSError, ValueError) as error:
            raise ConfigError(f"path={path}: its tokenizer cannot be loaded: {error}") from error
        self._longest = int(config.text_config.max_position_embeddings)
        self.name = f"CLIP texts ({fingerprint(path)})"

    @torch.no_grad()
    def similarity(self, one: Sequence[str], other: Sequence[str]) -> Tensor:
        """See TextExtractor."""
        sides = []
        for texts in (one, other):
            words = self._tokenizer(list(texts), return_tensors="pt", padding=True)
            for text, numbers in zip(texts, words["attention_mask"].sum(1).tolist(), strict=True):
                if numbers > self._longest:
                    raise ConfigError(
                        f"{self.name} takes {self._longest} tokens, and {text[:_SHOWN]!r}... has {numbers};"
                        " ask for shorter steps (ewmbench.prompts.steps), or compare words"
                        f" (ewmbench.texts._target_={__name__}.WordGrams)"
                    )
            inputs = {name: words[name] for name in ("input_ids", "attention_mask")}
            sides.append(functional.normalize(_embedding(self._network.get_text_features(**inputs)), dim=-1))
        return (sides[0] @ sides[1].T).clamp(0, 1)


def pretrained(path: str, kinds: Sequence[str], title: str) -> tuple[Any, Any]:
    """A network of `transformers` from a folder, and its configuration.

    Raises:
        ConfigError: if it is not there, or of another architecture.
    """
    folder = Path(path)
    if not (folder / "config.json").is_file() or not list(folder.glob("*.safetensors")):
        raise ConfigError(
            f"path={path!r} must be a folder with config.json and weights (*.safetensors) of {title}, as"
            " `save_pretrained` of transformers leaves it"
        )
    try:
        from transformers import AutoConfig, AutoModel
    except ImportError as error:
        raise ConfigError(
            f"{title} runs in transformers, which does not import ({error}): pip install -c constraints.txt"
            ' "worldloop[vlm]"'
        ) from error
    try:
        config: Any = AutoConfig.from_pretrained(folder, local_files_only=True)
        if config.model_type not in kinds:
            raise ConfigError(
                f"path={path} is of another architecture: {config.model_type}, and {title} is one of"
                f" {list(kinds)}; give its folder, or choose another extractor"
            )
        network: Any = read_pretrained(AutoModel, folder, "path")
    except (OSError, ValueError, RuntimeError, KeyError, SafetensorError) as error:
        if isinstance(error, ConfigError):
            raise
        raise ConfigError(f"path={path}: transformers cannot load {title} from it: {error}") from error
    return network, config


def fingerprint(path: str) -> str:
    """What tells the weights of a folder from others, eight characters; all of them are read, as one block
    that was tuned may lie anywhere.
    """
    files = [Path(path) / "config.json", *sorted(Path(path).glob("*.safetensors"))]
    marks = [f"{file.name}:{digest_of(file)}" for file in files]
    return hashlib.sha256(" ".join(marks).encode()).hexdigest()[:8]


def words_of(text: str) -> list[str]:
    """The words of a text, in small letters, without punctuation."""
    return re.findall(r"[\w']+", text.lower())


def _grams(text: str) -> Counter[str]:
    words = words_of(text)
    return Counter([*words, *(f"{a} {b}" for a, b in pairwise(words))])


def _colours(values: list[float]) -> Tensor:
    """One number a colour, float32 [3, 1, 1]."""
    return torch.tensor(values)[:, None, None]


def _resized(pictures: Tensor, size: list[int]) -> Tensor:
    return functional.interpolate(pictures, size, mode="bicubic", antialias=True, align_corners=False)


def _embedding(found: Any) -> Tensor:
    """The embedding [N, D] in what a CLIP model answers, which is a tensor or holds one."""
    return (found if isinstance(found, Tensor) else found.pooler_output).float()
