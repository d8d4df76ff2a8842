"""Instructions in other words."""

from __future__ import annotations

from torch import Tensor

from envs.rng import step_generator
from envs.specs import TEXT_BYTES, bytes_to_text, text_to_bytes
from learners.stages.words import BETWEEN, reworded

SAID = "Pick up the red mug, and place it in the blue bowl"


def new(texts: list[str], step: int = 0) -> Tensor:
    return reworded(text_to_bytes(texts), step_generator(0, step))


def test_half_of_the_instructions_gain_few_words_that_mean_nothing_and_lose_none() -> None:
    changed = [text.split() for text in bytes_to_text(new([SAID] * 400)) if text != SAID]
    assert 120 < len(changed) < 220  # of a half, a fifth gains none
    known = SAID.split()
    for words in changed:
        between = [word for word in words if word not in known]
        assert 1 <= len(between) <= BETWEEN and all(word.isalpha() and word.islower() for word in between)
        assert [word for word in words if word in known] == known
    assert len({tuple(words) for words in changed}) > 100


def test_the_same_draws_say_the_same_words() -> None:
    assert new([SAID] * 64, 3).equal(new([SAID] * 64, 3))
    assert not new([SAID] * 64, 3).equal(new([SAID] * 64, 4))


def test_what_would_be_too_long_stays_and_any_script_keeps_its_words() -> None:
    long, one = "\u00e4" * (TEXT_BYTES // 2), "\u62ff\u8d77\u7ea2\u8272\u7684\u676f\u5b50"
    assert set(bytes_to_text(new([long] * 64))) == {long}
    assert all(one in text.split() for text in bytes_to_text(new([one] * 64)))
