"""The text world: it stops where it says done, or does not finish; words decide; encoders refuse texts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict

from envs.simulators.tokens.text_world import TextWorld
from envs.simulators.tokens.words import HashedWords
from envs.specs import TEXT_BYTES, text_to_bytes
from envs.targets import ConfigError, build
from tests.embodiments import ARM_DELTAS, INSTRUCTIONS, world_spec
from tests.envs.simulators.clips import moving_square
from tests.learners.models import section_of
from tests.sections import merged

TOKENS = "envs.simulators.tokens"
SPEC = world_spec(ARM_DELTAS)
TEXTS = list(INSTRUCTIONS)


def section(**changes: Any) -> dict[str, Any]:
    """Options of a tiny text world: those of the small engine, and what is its own."""
    small = section_of("simulator", "tokens_small")
    shared = {name: small[name] for name in ("codec", "net", "conditioning", "decoding", "training")}
    own = {
        "_target_": f"{TOKENS}.text_world.TextWorld",
        "window": 4,
        "words": {"_target_": f"{TOKENS}.words.HashedWords"},
        "ending": {"threshold": 0.5, "max_frames": 7},
    }
    return merged(shared | own, changes)


def world(**changes: Any) -> TextWorld:
    torch.manual_seed(0)
    made = build(section(**changes), "judge.text_world", spec=SPEC)
    assert isinstance(made, TextWorld)
    return made.eval()


def firsts() -> torch.Tensor:
    return moving_square(SPEC, torch.tensor([0.2, 0.5, 0.8]))


def lean(model: TextWorld, amount: float, spread: float = 0.0) -> None:
    """Make its done head say a constant, or something about it."""
    with torch.no_grad():
        model.video.done_head[-1].weight.mul_(spread)
        model.video.done_head[-1].bias.fill_(amount)


def test_one_that_never_says_done_is_not_finished_and_ends_with_its_last_frame() -> None:
    model = world()
    lean(model, -5.0)
    golden = model.imagine(firsts(), TEXTS, torch.arange(3))
    assert golden.frames.shape == (3, 7, 2, 3, 32, 32) and golden.frames.dtype == torch.uint8
    assert golden.goal.tolist() == [6] * 3 and not golden.finished.any() and bool((golden.done < 0.5).all())


def test_it_stops_at_once_where_it_is_done_at_once() -> None:
    model = world()
    lean(model, 5.0)
    golden = model.imagine(firsts(), TEXTS, torch.arange(3))
    assert golden.frames.shape[1] == 1 and golden.goal.tolist() == [0] * 3 and golden.finished.all()


def test_the_goal_is_the_first_frame_that_is_done_and_then_it_rests() -> None:
    model = world(decoding={"temperature": 1.0})
    lean(model, 0.0, spread=200.0)  # about half of all frames
    seeds = torch.arange(8)
    first = firsts()[:1].expand(8, -1, -1, -1, -1)
    golden = model.imagine(first, TEXTS[:1] * 8, seeds)
    over = golden.done > 0.5
    assert torch.equal(golden.finished, over.any(1)) and golden.goal.unique().numel() > 1
    for row, goal in enumerate(golden.goal.tolist()):
        assert not over[row, :goal].any()
        if golden.finished[row]:
            assert bool((golden.frames[row, goal:] == golden.frames[row, goal]).all())
    assert golden.frames.shape[1] == int(golden.goal.max()) + 1
    ends, finished = model.imagine_goals(first, TEXTS[:1] * 8, seeds)
    assert torch.equal(ends, golden.frames[seeds, golden.goal]) and torch.equal(finished, golden.finished)
    turned = model.imagine(first, TEXTS[:1] * 8, seeds.flip(0))
    assert torch.equal(turned.goal.flip(0), golden.goal)
    assert torch.equal(turned.frames.flip(0), golden.frames)


def test_the_instruction_tells_and_its_company_does_not() -> None:
    model = world(decoding={"temperature": 0.0})
    lean(model, -5.0)
    first, seeds = firsts()[:1].expand(3, -1, -1, -1, -1), torch.zeros(3, dtype=torch.int64)
    with torch.no_grad():
        model.reader.map[-1].weight.mul_(30)
    several = model.imagine(first, TEXTS, seeds).frames
    assert not torch.equal(several[0], several[1])
    alone = model.imagine(first[:1], TEXTS[1:2], seeds[:1]).frames
    assert torch.equal(alone[0], several[1])
    said = model.done(several, TEXTS)
    assert said.shape == (3, 7) and bool(((said > 0) & (said < 0.5)).all())


def test_the_loss_falls_and_every_weight_but_the_tokenizers_learns() -> None:
    model = world().train()
    place = torch.linspace(0.1, 0.9, 4).expand(6, -1)
    clip = TensorDict(
        {
            "frames": moving_square(SPEC, place),
            "valid": torch.ones(6, 4, dtype=torch.bool),
            "success": (place > 0.8).float(),
            "text": text_to_bytes(TEXTS * 2),
        },
        [6],
    )
    optimiser, losses = torch.optim.Adam([p for p in model.parameters() if p.requires_grad], 3e-3), []
    for step in range(30):
        optimiser.zero_grad()
        loss, figures = model.loss(clip, torch.Generator().manual_seed(step))
        loss.backward()
        optimiser.step()
        losses.append(float(loss.detach()))
    assert sum(losses[-5:]) < 0.7 * sum(losses[:5]) and float(figures["done"]) < 0.4
    idle = [name for name, p in model.named_parameters() if p.requires_grad and not p.grad.any()]
    assert not idle and not any(p.requires_grad for p in model.codec.parameters())


def test_texts_that_would_be_cut_are_refused() -> None:
    model, long = world(), "put " * TEXT_BYTES
    with pytest.raises(ValueError, match=rf"has {len(long)} bytes.*carry {TEXT_BYTES}"):
        model.imagine(firsts(), [*TEXTS[:2], long], torch.arange(3))
    with pytest.raises(ValueError, match="'put put"):
        model.check([*TEXTS, long])
    assert HashedWords().encode(TEXTS, torch.device("cpu")).shape[:2] == (3, 1)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"window": 1}, r"judge\.text_world\.window=1"),
        ({"ending": {"threshold": 1.5}}, r"text_world\.ending\.threshold=1\.5"),
        (
            {"words": {"_target_": f"{TOKENS}.words.T5Words", "folder": "/none", "max_tokens": 8}},
            "holds no T5",
        ),
    ],
)
def test_options_that_cannot_work_are_named(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        world(**changes)


def test_t5_from_a_folder_tells_word_by_word(tmp_path: Path) -> None:
    transformers = pytest.importorskip("transformers")
    tokenizers = pytest.importorskip("tokenizers")
    words = ["<pad>", "</s>", "<unk>", *sorted({word for text in TEXTS for word in text.split()})]
    model = tokenizers.models.WordLevel({word: n for n, word in enumerate(words)}, unk_token="<unk>")
    cut = tokenizers.Tokenizer(model)
    cut.pre_tokenizer = tokenizers.pre_tokenizers.Whitespace()
    special = {"pad_token": "<pad>", "eos_token": "</s>", "unk_token": "<unk>"}
    transformers.PreTrainedTokenizerFast(tokenizer_object=cut, **special).save_pretrained(tmp_path)
    sizes = {"d_model": 16, "d_kv": 8, "d_ff": 32, "num_layers": 1, "num_heads": 2, "vocab_size": len(words)}
    torch.manual_seed(0)
    transformers.T5EncoderModel(transformers.T5Config(**sizes)).save_pretrained(tmp_path)
    given = {"_target_": f"{TOKENS}.words.T5Words", "folder": str(tmp_path), "max_tokens": 9}
    made = world(words=given)
    assert not [name for name in made.state_dict() if "words" in name]
    told = made.reader(TEXTS)
    assert told.shape == (3, 1, 9, 32) and not torch.equal(told[0], told[1])
    assert torch.equal(made.reader(TEXTS[1:2])[0], told[1])
    with pytest.raises(ValueError, match=r"has 10 tokens, more than text_world\.words\.max_tokens=9"):
        made.check(["cube " * 10])
    with torch.device("meta"):  # as a config is checked, and sizes are counted
        assert next(world(words=given).parameters()).is_meta
    given["max_tokens"] = 512  # more than clips and rollouts carry: it would learn from half of a text
    with pytest.raises(ValueError, match=rf"has 300 bytes.*carry {TEXT_BYTES}"):
        world(words=given).check(["cube " * 60])
