"""The transformer over tokens: kept keys equal full recomputation, both orders of decisions, the window."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict import TensorDict

from envs.simulators.base import WORLD_OPTIONS
from envs.simulators.tokenizers.autoencoder import STRIDE
from envs.simulators.tokens.conditioning import AdaLN, Conditioning, CrossAttention
from envs.simulators.tokens.decoding import Decoding, Draws, MaskGIT, Raster
from envs.simulators.tokens.engine import TokensSimulator
from envs.simulators.tokens.transformer import MASKED, SpatioTemporalTransformer, Trunk, Vocabulary
from envs.targets import ConfigError, build
from tests.embodiments import ARM_DELTAS, BIMANUAL_POSES, world_spec
from tests.envs.simulators.clips import clip, first_of, future_of
from tests.learners.models import section_of
from tests.sections import merged

VOCABULARY = Vocabulary(views=2, rows=2, columns=3, factors=2, bits=3)
WAYS: list[Conditioning] = [CrossAttention(2), AdaLN()]
CHUNK = 3


def net(conditioning: Conditioning, window: int) -> SpatioTemporalTransformer:
    torch.manual_seed(0)
    made = SpatioTemporalTransformer(VOCABULARY, Trunk(2, 32, 2, 2, False), window, conditioning)
    for parameter in made.parameters():
        if not parameter.any():
            torch.nn.init.normal_(parameter, std=0.2)
    return made.eval()


def video(frames: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Tokens, told and beside of two clips."""
    g = torch.Generator().manual_seed(1)
    tokens = torch.randint(VOCABULARY.codes, (2, frames, VOCABULARY.places, 2), generator=g)
    told = torch.randn(2, frames, 2, 32, generator=g)
    return tokens, told, 0.3 * torch.randn(2, frames, VOCABULARY.places, 32, generator=g)


def engine(name: str = "tokens_small", **changes: Any) -> TokensSimulator:
    """An untrained engine of configs/simulator, with some options changed."""
    section = merged(section_of("simulator", name), changes)
    options = {key: value for key, value in section.items() if key not in WORLD_OPTIONS}
    size, robot = ((256, 256), BIMANUAL_POSES) if name == "tokens_full" else ((32, 32), ARM_DELTAS)
    torch.manual_seed(0)
    made = build(options, "simulator", spec=world_spec(robot, size, CHUNK))
    assert isinstance(made, TokensSimulator)
    return made.eval()


@pytest.mark.parametrize("window", [9, 4], ids=["whole", "sliding"])
@pytest.mark.parametrize("way", WAYS, ids=["cross", "adaln"])
@torch.no_grad()
def test_kept_keys_give_what_is_computed_anew(way: Conditioning, window: int) -> None:
    model = net(way, window)
    tokens, told, beside = video(8)
    for order in (MaskGIT(2, 0.0), Raster(0.0)):
        shown, _ = order.shown(tokens[:, 1:], torch.Generator().manual_seed(0))
        logits, features = model(tokens, shown, told, beside, order.causal)
        known, begin = model.memory(), 0
        for count in (3, 1, 2, 1):
            part = slice(begin, begin + count)
            seen = model.observe(tokens[:, part], told[:, part], beside[:, part], known)
            assert torch.allclose(seen, features[:, part], atol=1e-5)
            begin += count
            at = slice(begin, begin + 1)
            given = shown[:, begin - 1]
            if order.causal:
                said = [
                    model.predict_place(place, given[:, place], told[:, at], beside[:, at], known)
                    for place in range(VOCABULARY.places)
                ]
                asked = torch.stack(said, 1)
            else:
                asked = model.predict(given, told[:, at], beside[:, at], known)
            assert torch.allclose(asked, logits[:, begin - 1], atol=1e-5)
        assert max(cache.time[0].shape[-2] for cache in known.blocks if cache.time) <= window - 1


@pytest.mark.parametrize("way", WAYS, ids=["cross", "adaln"])
@torch.no_grad()
def test_a_frame_depends_on_its_past_within_reach_and_on_nothing_after(way: Conditioning) -> None:
    model, layers, window = net(way, 3), 2, 3
    tokens, told, beside = video(9)
    shown, _ = MaskGIT(1, 0.0).shown(tokens[:, 1:], torch.Generator().manual_seed(0))
    said = model(tokens, shown, told, beside, False)[0]
    later, past = tokens.clone(), tokens.clone()
    later[:, 5:] = (later[:, 5:] + 1) % VOCABULARY.codes
    assert torch.equal(model(later, shown, told, beside, False)[0][:, :5], said[:, :5])
    past[:, 0] = (past[:, 0] + 1) % VOCABULARY.codes
    changed = (model(past, shown, told, beside, False)[0] - said).abs().amax((0, 2, 3, 4)) > 1e-6
    reach = layers * (window - 1)  # every block looks so much further
    assert changed[: window - 1].all() and not changed[reach:].any()


class _Fixed:
    """Logits that do not depend on what is known."""

    def __init__(self, logits: torch.Tensor):
        self.logits = logits

    def all(self, shown: torch.Tensor) -> torch.Tensor:
        return self.logits

    def place(self, number: int, shown: torch.Tensor) -> torch.Tensor:
        return self.logits[:, number]


@pytest.mark.parametrize("order", [MaskGIT(1, 1.0), MaskGIT(4, 1.0), MaskGIT(40, 1.0), Raster(1.0)], ids=str)
def test_every_place_is_decided_by_the_rows_own_draws(order: Decoding) -> None:
    logits = torch.randn(3, 12, 2, 8, generator=torch.Generator().manual_seed(0))

    def decided(rows: list[int]) -> torch.Tensor:
        generators = [torch.Generator().manual_seed(row) for row in rows]
        return order.decide(_Fixed(logits[rows]), 12, 2, Draws(generators, torch.device("cpu")))

    tokens = decided([0, 1, 2])
    assert tokens.shape == (3, 12, 2) and int(tokens.min()) >= 0 and int(tokens.max()) < 8
    assert torch.equal(decided([2, 0, 1]), tokens[[2, 0, 1]]) and torch.equal(decided([1]), tokens[1:2])
    assert not torch.equal(tokens, logits.argmax(-1))
    cold = type(order)(**vars(order) | {"temperature": 0.0})
    generators = [torch.Generator().manual_seed(7)] * 3
    still = cold.decide(_Fixed(logits), 12, 2, Draws(generators, torch.device("cpu")))
    assert torch.equal(still, logits.argmax(-1))


def test_draws_have_the_frequencies_that_logits_say() -> None:
    share = torch.tensor([0.5, 0.3, 0.2, 0.0])
    logits = share.log().expand(1, 4000, 1, 4)
    draws = Draws([torch.Generator().manual_seed(0)], torch.device("cpu"))
    tokens = MaskGIT(1, 1.0).decide(_Fixed(logits), 4000, 1, draws)
    found = torch.bincount(tokens.flatten(), minlength=4) / 4000
    assert (found - share).abs().max() < 0.03


def test_training_masks_some_places_of_every_frame_and_shows_the_others() -> None:
    tokens, *_ = video(6)
    shown, asked = MaskGIT(2, 0.0).shown(tokens, torch.Generator().manual_seed(0))
    assert torch.equal((shown == MASKED).all(-1), asked) and asked.any(-1).all()
    assert torch.equal(shown[~asked], tokens[~asked]) and not asked.all()
    shown, asked = Raster(0.0).shown(tokens, torch.Generator().manual_seed(0))
    assert (
        asked.all() and (shown[:, :, 0] == MASKED).all() and torch.equal(shown[:, :, 1:], tokens[:, :, :-1])
    )


@pytest.mark.parametrize("order", [MaskGIT(2, 1.0), Raster(1.0)], ids=["maskgit", "raster"])
def test_what_lies_beyond_the_window_is_forgotten_and_sessions_go_on(order: Decoding) -> None:
    model = engine(window=5)
    model.video.decoding = order
    clips = clip(model.spec, 2, model.memory_frames, chunks=5)
    state = model.reset(first_of(model.spec, clips), torch.tensor([1, 2]))
    for number in range(4):  # 13 frames, of which the last two are remembered
        _, _, state = model.step(state, future_of(model.spec, clips, number))
    own = {"history", "length", "seed", "chunk_index", "stride", "intrinsic"}  # as of any engine
    assert set(state.keys()) <= own
    other, future = state.clone(), future_of(model.spec, clips, 4)
    other["history", "frames"][:, :11] = 0
    frames = model.step(state, future)[0]
    assert torch.equal(model.step(other, future)[0], frames)


def test_seeds_draw_and_commands_tell() -> None:
    model = engine(decoding={"temperature": 1.0})
    clips = clip(model.spec, 2, model.memory_frames)
    clips[1] = clips[0]
    first, future = first_of(model.spec, clips), future_of(model.spec, clips)
    frames = model.step(model.reset(first, torch.tensor([3, 4])), future)[0]
    assert not torch.equal(frames[0], frames[1])
    future["commands"][1] += 3.0
    told = model.step(model.reset(first, torch.tensor([3, 3])), future)[0]
    assert torch.equal(told[0], frames[0]) and not torch.equal(told[1], told[0])


def test_checkpointed_blocks_keep_less_and_give_the_same_gradients() -> None:
    kept, gradients = [], []
    for checkpointing in (False, True):
        model, held = engine(net={"checkpointing": checkpointing}).train(), list[torch.Tensor]()
        clips, generator = clip(model.spec, 1, model.memory_frames), torch.Generator().manual_seed(0)
        with torch.autograd.graph.saved_tensors_hooks(lambda x, held=held: held.append(x) or x, lambda x: x):
            loss = model.loss(clips, generator)[0]
        loss.backward()
        kept.append(sum(tensor.numel() for tensor in held))
        gradients.append([p.grad for p in model.parameters() if p.requires_grad])
    assert kept[1] < 0.7 * kept[0]
    for one, other in zip(*gradients, strict=True):
        assert torch.equal(one, other)


def test_frames_without_a_picture_are_never_asked_for() -> None:
    model = engine()
    clips = clip(model.spec, 2, model.memory_frames)

    def loss(data: TensorDict) -> torch.Tensor:
        return model.loss(data, torch.Generator().manual_seed(0))[0]

    whole = loss(clips)
    clips["memory", "present"] = torch.zeros_like(clips["memory", "present"])
    less = loss(clips)
    clips["memory", "index"] = torch.zeros_like(clips["memory", "index"])  # as if all were repeats
    assert not torch.equal(less, whole) and torch.equal(loss(clips), less)


def test_what_is_asked_does_not_decide_what_it_weighs() -> None:
    """Or places would seem likelier to change than they are."""
    model = engine()
    v = model.video.vocabulary
    still = torch.zeros(1, 6, v.places, v.factors, dtype=torch.int64)
    moved = still.clone()
    moved[:, 3:, 0] = 1  # one place changes in frame 3, and stays
    weight = model.video._stirred(moved)[0].unflatten(1, (v.views, v.rows, v.columns)) > 0
    assert weight.shape[0] == 5 and not model.video._stirred(still).any()
    assert weight.flatten(1).any(1).tolist() == [False, False, False, True, False]  # asked for frames 1 .. 5
    beside = torch.zeros(v.views, v.rows, v.columns, dtype=torch.bool)
    beside[0, :2, :2] = True
    assert torch.equal(weight[3], beside)


def test_where_tokens_stay_the_picture_does() -> None:
    model = engine(decoding={"temperature": 0.0})
    torch.nn.init.constant_(model.video.net.head.keep.bias, 1e3)
    clips = clip(model.spec, 2, model.memory_frames)
    first = first_of(model.spec, clips)
    frames = model.step(model.reset(first, torch.tensor([3, 4])), future_of(model.spec, clips))[0]
    # The tokenizer has learned nothing: decoded, the frame would be noise.
    assert torch.equal(frames, first["frames"][:, None].expand_as(frames))


def test_as_many_frames_are_remembered_whatever_the_chunk() -> None:
    own = {
        key: value
        for key, value in section_of("simulator", "tokens_small").items()
        if key not in WORLD_OPTIONS
    }
    worlds = [build(own, "simulator", spec=world_spec(ARM_DELTAS, chunk=chunk)) for chunk in (1, 4, 16)]
    assert [world.memory_frames for world in worlds] == [8, 8, 8]
    assert engine(window=5).memory_frames == 5 - CHUNK


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"window": CHUNK}, r"simulator\.window=3 must be more than task\.chunk=3"),
        ({"codec": {"stride": 64}}, r"task\.size=\[32, 32\].*simulator\.codec\.stride"),
        ({"net": {"heads": 5}}, r"net\.width=32"),
        ({"decoding": {"steps": 0}}, r"simulator\.decoding\.steps=0"),
    ],
)
def test_options_that_cannot_work_are_named(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        engine(**changes)


def test_the_default_sees_as_finely_as_worlds_of_latents() -> None:
    assert engine("tokens").codec.stride == STRIDE


def test_the_full_size_is_built_and_runs_without_memory() -> None:
    with torch.device("meta"):
        model = engine("tokens_full")
        tokens = torch.zeros(1, 3, 3 * 16 * 16, 2, dtype=torch.int64)
        logits, features = model.video.net(tokens, tokens[:, 1:], torch.zeros(1, 3, 8, 1024), None, False)
    assert 4e8 < sum(p.numel() for p in model.video.net.parameters()) < 6e8
    assert model.memory_frames == 48 - CHUNK
    assert logits.shape == (1, 2, 768, 2, 512) and features.shape == (1, 3, 768, 1024)
