"""Instructions as numbers: words that share stems lie near each other, order counts, bytes say it all."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F

from envs.encoders.language import TextEncoder
from envs.specs import TEXT_BYTES, text_to_bytes


def near(one: str, *others: str) -> list[float]:
    """Cosine similarities of fixed features."""
    rows = F.normalize(TextEncoder(4).features(text_to_bytes([one, *others])), dim=-1)
    return (rows[1:] @ rows[0]).tolist()


def test_unseen_words_lie_near_words_that_share_their_stem() -> None:
    plural, other = near("push the red block", "push the red blocks", "push the red banana")
    assert plural > other > 0.3
    assert near("open", "opened")[0] > 0.3 > abs(near("open", "zebra")[0])


def test_case_and_punctuation_do_not_count_but_order_does() -> None:
    same, swapped = near("Put the cup, on the plate.", "put the cup on the plate", "put the plate on the cup")
    assert same > 0.9999
    assert swapped < 0.97


@pytest.mark.parametrize("text", ["", " ", "a", "schiebe den Würfel über das Brett", "推动积木", "x" * 600])
def test_any_text_is_a_finite_vector(text: str) -> None:
    out = TextEncoder(8).encode([text, "push"])
    assert out.shape == (2, 8) and bool(out.isfinite().all())


def test_rows_do_not_depend_on_their_batch_and_leading_dimensions_stay() -> None:
    torch.manual_seed(0)
    encoder = TextEncoder(8)
    texts = ["open the drawer", "lift the cube", "open the drawer", "push"]
    rows = encoder(text_to_bytes(texts).reshape(2, 2, TEXT_BYTES))
    assert rows.shape == (2, 2, 8)
    alone = torch.cat([encoder.encode([text]) for text in texts])
    assert torch.allclose(rows.flatten(0, 1), alone, atol=1e-6)
    assert torch.equal(rows[0, 0], rows[1, 0])


def test_only_the_map_is_saved_and_learns() -> None:
    encoder = TextEncoder(8)
    assert set(encoder.state_dict()) == {"map.weight", "map.bias"}
    encoder.encode(["push"]).sum().backward()
    assert bool(encoder.map.weight.grad.any())
