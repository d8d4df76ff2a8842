"""A vision-language model in this process: its votes are its own draws; clear words if it is missing."""

from __future__ import annotations

import asyncio
from pathlib import Path

import numpy as np
import pytest
import torch

from envs.judges.vlm import LocalChat
from envs.judges.vlm.chat import Question
from envs.targets import ConfigError
from tests.envs.judges.tiny_vlm import save_tiny_vlm

pytest.importorskip("transformers", reason="pip install -c constraints.txt 'worldloop[vlm]'")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny model on disk."""
    return save_tiny_vlm(tmp_path_factory.mktemp("vlm"))


def chat(folder: Path | str, temperature: float = 1.0) -> LocalChat:
    return LocalChat(str(folder), "cpu", "auto", max_tokens=1, temperature=temperature)


def question(seed: int = 0) -> Question:
    rng = np.random.default_rng(seed)
    pictures = tuple(rng.integers(0, 255, (20, 44, 3), dtype=np.uint8) for _ in range(2))
    return Question("is it done?", pictures)


def test_votes_are_draws_of_their_own_and_leave_torchs_numbers_alone(folder: Path) -> None:
    torch.manual_seed(3)
    before, model = torch.get_rng_state(), chat(folder, temperature=30.0)
    said = [asyncio.run(model.ask(question(), vote)).text for vote in range(12)]
    assert set(said) == {"Answer: Yes", "Answer: No"}  # so hot that both come
    assert torch.equal(torch.get_rng_state(), before)
    again = chat(folder, temperature=30.0)
    assert [asyncio.run(again.ask(question(), vote)).text for vote in reversed(range(12))] == said[::-1]
    cold = chat(folder, temperature=0.0)
    replies = [asyncio.run(cold.ask(question(), vote)) for vote in range(3)]
    assert len(set(replies)) == 1 and replies[0].completion_tokens == 1 < replies[0].prompt_tokens


def test_answers_belong_to_the_weights_wherever_they_lie(folder: Path, tmp_path: Path) -> None:
    moved = tmp_path / "moved"
    moved.mkdir()
    for path in folder.iterdir():
        (moved / path.name).write_bytes(path.read_bytes())
    assert chat(moved).name == chat(folder).name != chat(folder, temperature=0.5).name
    weights = moved / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:-1] + b"!")
    assert chat(moved).name != chat(folder).name


@pytest.mark.parametrize("changed", ["model.safetensors", "chat_template.jinja", "tokenizer_config.json"])
def test_answers_belong_to_templates_and_to_all_of_large_weights(changed: str, tmp_path: Path) -> None:
    large = bytearray(40 << 20)
    (tmp_path / "model.safetensors").write_bytes(large)
    for name in ("config.json", "chat_template.jinja", "tokenizer_config.json"):
        (tmp_path / name).write_text("{}")
    before = chat(tmp_path).name
    assert chat(tmp_path).name == before
    large[15 << 20 : 25 << 20] = b"!" * (10 << 20)  # of the same size, ends and all
    (tmp_path / changed).write_bytes(large if changed == "model.safetensors" else b"[]")
    assert chat(tmp_path).name != before


def test_what_is_missing_is_told_by_its_key(folder: Path, tmp_path: Path) -> None:
    for nothing in ("", tmp_path, tmp_path / "nowhere"):
        with pytest.raises(ConfigError, match=r"judge\.chat\.path=.* must be a folder with config\.json"):
            chat(nothing)
    half = tmp_path / "half"
    half.mkdir()
    for path in folder.iterdir():
        if "template" not in path.name:
            (half / path.name).write_bytes(path.read_bytes())
    with pytest.raises(ConfigError, match=r"judge\.chat\.path=.* holds no chat template"):
        asyncio.run(chat(half).greet())
    (half / "config.json").write_text("{}")
    with pytest.raises(ConfigError, match=r"judge\.chat\.path=.*transformers cannot load it"):
        asyncio.run(chat(half).greet())
