"""Lookup-free quantisation: tokens there and back, entropies, gradients, and a codebook that collapses."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch

from envs.simulators.tokenizers.detail import restore_detail
from envs.simulators.tokenizers.errors import gradient_difference
from envs.simulators.tokenizers.lfq import LookupFreeQuantiser, LookupFreeTokenizer
from learners.stages.tokenizer import CodecAlarm
from tests.embodiments import BIMANUAL_POSES, world_spec
from tests.envs.simulators.clips import clip
from tests.envs.simulators.test_engines import ENGINES, build_engine

OPTIONS: dict[str, Any] = {
    "bits": 8,
    "factors": 2,
    "stride": 8,
    "width": 16,
    "gradients": 1.0,
    "commitment": 0.25,
    "entropy": 0.1,
}


def tokenizer(**changes: Any) -> LookupFreeTokenizer:
    torch.manual_seed(0)
    return LookupFreeTokenizer(**OPTIONS | changes)


def pictures(count: int) -> torch.Tensor:
    return torch.rand(count, 3, 32, 48, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize(("bits", "factors"), [(8, 1), (8, 2), (9, 3), (36, 4)])
def test_tokens_are_signs_and_back(bits: int, factors: int) -> None:
    quantiser = LookupFreeQuantiser(bits, factors)
    z = torch.randn(5, bits, 2, 3)
    tokens = quantiser.tokens(z)
    assert tokens.shape == (5, 2, 3, factors) and int(tokens.max()) < quantiser.codes == 2 ** (
        bits // factors
    )
    assert torch.equal(quantiser.latents(tokens), torch.where(z > 0, 1.0, -1.0))
    every = torch.arange(quantiser.codes)[:, None, None, None].expand(-1, 1, 1, factors)
    assert torch.equal(quantiser.tokens(quantiser.latents(every)), every)


def test_a_bit_moves_the_token_of_its_factor_alone() -> None:
    quantiser, z = LookupFreeQuantiser(8, 2), -torch.ones(1, 8, 1, 1)
    for bit in range(8):
        turned = z.clone()
        turned[0, bit] = 1.0
        wanted = [0, 0]
        wanted[bit // 4] = 2 ** (bit % 4)
        assert quantiser.tokens(turned).flatten().tolist() == wanted


def test_entropies_of_sure_unsure_spread_and_collapsed_codes() -> None:
    quantiser = LookupFreeQuantiser(6, 2)
    spread = quantiser.latents(torch.cartesian_prod(torch.arange(8), torch.arange(8))[:, None, None])
    each, whole = quantiser.entropies(8 * spread)
    assert float(each) < 1e-3 and abs(float(whole) - 2 * math.log(8)) < 1e-3
    each, whole = quantiser.entropies(torch.zeros(4, 6, 1, 1))
    assert abs(float(each) - 6 * math.log(2)) < 1e-4 and abs(float(whole) - 6 * math.log(2)) < 1e-4
    each, whole = quantiser.entropies(8 * spread[:1].expand(64, -1, -1, -1))
    assert float(each) < 1e-3 and float(whole) < 1e-3
    share, perplexity = quantiser.use(quantiser.tokens(spread))
    assert float(share) == 1.0 and abs(float(perplexity) - 8) < 1e-3
    share, perplexity = quantiser.use(torch.zeros(10, 2, dtype=torch.int64))
    assert float(share) == 1 / 8 and abs(float(perplexity) - 1) < 1e-3


def test_gradients_pass_the_signs_and_reach_every_weight() -> None:
    codec = tokenizer()
    value, figures = codec.loss(pictures(4))
    value.backward()
    assert bool(value.isfinite())
    assert {"psnr", "codebook_use", "perplexity", "codebook_tokens"} == figures.keys()
    assert not [name for name, p in codec.named_parameters() if p.grad is None or not p.grad.any()]


def test_stills_are_encoded_alone_and_decoded_to_their_size() -> None:
    codec, stills = tokenizer(stride=16), pictures(4)
    with torch.no_grad():
        tokens = codec.encode(stills)
        assert tokens.shape == (4, 2, 3, 2) and codec.decode(tokens).shape == stills.shape
        assert torch.equal(codec.encode(stills.flip(0)).flip(0), tokens)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"factors": 3}, r"codec\.bits=8"),
        ({"stride": 12}, r"codec\.stride=12"),
        # 34 GB of signs otherwise
        ({"bits": 64}, r"codec\.bits=64 in codec\.factors=2 are tokens of 32 bits.*raise codec\.factors"),
    ],
)
def test_options_that_cannot_work_are_named(change: dict[str, int], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        tokenizer(**change)


def test_edges_cost_more_than_shades() -> None:
    truth = torch.zeros(1, 3, 16, 16)
    truth[..., 8:] = 1.0
    blurred = truth.clone()
    blurred[..., 6:10] = torch.tensor([0.2, 0.4, 0.6, 0.8])
    assert float(gradient_difference(truth, truth)) == 0.0
    assert float(gradient_difference(truth + 0.1, truth)) < 1e-6 < float(gradient_difference(blurred, truth))


def test_a_collapsed_codebook_gives_one_alarm_that_says_what_to_do(
    capsys: pytest.CaptureFixture[str],
) -> None:
    codec = tokenizer()
    alarm = CodecAlarm(codec, patience=3)
    with torch.no_grad():
        codec.encoder[-1].bias.fill_(100.0)  # whatever is seen, all signs are 1
        for _ in range(8):
            _, figures = codec.loss(pictures(2))
            alarm.check({name: float(value) for name, value in figures.items()})
    alarm.give(alarm.message)  # as at the end of training, where it is still so
    assert "simulator.codec" in alarm.message and "collapsed" in alarm.message
    assert capsys.readouterr().out.count("ALARM tokenizer") == 1
    healthy = CodecAlarm(codec, patience=1)
    healthy.check({"psnr": 20.0, "perplexity": 9.0, "codebook_tokens": 48.0})
    assert not healthy.message and codec.warning(codec.figures(pictures(2)))


def test_one_factor_that_has_collapsed_is_a_collapse() -> None:
    codec = tokenizer()
    tokens = torch.randint(codec.quantiser.codes, (4096, codec.quantiser.factors))
    found = said_of(codec, tokens)
    assert found["codebook_use"] == 1.0 and not codec.warning(found)
    tokens[:, 0] = 3
    found = said_of(codec, tokens)
    assert found["perplexity"] == 1.0 and codec.warning(found)


def test_of_many_codes_no_more_can_be_in_use_than_tokens_were_seen() -> None:
    codec = tokenizer(bits=14, factors=1)
    different = torch.randperm(codec.quantiser.codes)[:300, None]
    found = said_of(codec, different)
    assert found["codebook_tokens"] == 300 and not codec.warning(found)
    many = different.repeat(100, 1)  # of these no less than a fiftieth of all codes is expected
    assert "in use in 30000 tokens (least 327.68)" in codec.warning(said_of(codec, many))
    assert "(least 6.00)" in codec.warning(said_of(codec, different[:5].repeat(60, 1)))


def said_of(codec: LookupFreeTokenizer, tokens: torch.Tensor) -> dict[str, float]:
    """Figures of tokens [N, factors]."""
    return {name: float(value) for name, value in codec._use(tokens).items()}


@pytest.mark.parametrize("name", ENGINES)
def test_engines_show_stills_as_their_autoencoders_keep_them(name: str) -> None:
    simulator, _ = build_engine(name, world_spec(BIMANUAL_POSES, chunk=5))
    frames = clip(simulator.spec, 2, 4)["future", "frames"]
    coded = simulator.coded(frames)
    assert (coded is None) == (not hasattr(simulator, "codec"))
    if coded is not None:
        assert coded.shape == frames.shape and coded.dtype == torch.uint8 and not torch.equal(coded, frames)
        alone = simulator.coded(frames[1:, 2:3])
        assert alone is not None and (alone.int() - coded[1:, 2:3].int()).abs().max() <= 1


def test_detail_stays_where_the_picture_does_and_goes_where_it_changes() -> None:
    last, seen = torch.rand(2, 2, 1, 1, 3, 8, 8, generator=torch.Generator().manual_seed(0))
    made = seen.expand(-1, 2, -1, -1, -1, -1).clone()
    made[:, 1, ..., :4] += 0.5  # in its left half the second frame shows something else
    shown = restore_detail(made, seen, last)
    assert torch.allclose(shown[:, :1], last) and torch.allclose(shown[:, 1:, ..., 4:], last[..., 4:])
    assert torch.equal(shown[:, 1, ..., :4], made[:, 1, ..., :4])
