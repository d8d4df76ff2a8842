"""The DiT engine: determinism per seed and chunk, and that it can learn."""

from __future__ import annotations

import pytest
import torch

from envs.episodes.clips import ClipSpec, ClipStore
from envs.simulators.base import WorldShape
from envs.simulators.dit.engine import DiTConfig, DiTSimulator
from envs.simulators.dit.network import Attention, DiTShape, MultiViewDiT
from envs.simulators.replay import replay
from envs.simulators.state_experts.flow import StateExpertConfig, untrained_expert

TINY = DiTConfig(layers=3, heads=2, head_dim=32, adaln_rank=8, codec_width=16, steps=2)


@pytest.fixture
def dit() -> DiTSimulator:
    torch.manual_seed(0)
    return DiTSimulator(WorldShape(chunk=4), TINY).eval()


def test_rollouts_depend_on_seed_and_not_on_batch(dit: DiTSimulator, store: ClipStore) -> None:
    torch.manual_seed(1)
    expert = untrained_expert(dit, StateExpertConfig(layers=2)).eval()
    both = replay(dit, store, torch.tensor([1, 2]), expert, bf16=False)
    alone = replay(dit, store, torch.tensor([2]), expert, bf16=False)
    length = alone.frames.shape[1]
    assert (both.frames[1, :length].int() - alone.frames[0].int()).abs().max() <= 1
    assert torch.allclose(both.states[1, :length], alone.states[0], atol=1e-3)
    assert not torch.equal(
        dit._noise(torch.tensor([1]), torch.tensor([0]), torch.zeros(1, 3, 16, 4, 8, 8)),
        dit._noise(torch.tensor([1]), torch.tensor([1]), torch.zeros(1, 3, 16, 4, 8, 8)),
    )


def test_loss_trains_trunk_and_unrolls(dit: DiTSimulator, store: ClipStore) -> None:
    clip = store.clips(torch.tensor([1, 2]), torch.tensor([0, 3]), ClipSpec(4, 4, 2))
    loss, _ = dit.loss(clip, torch.Generator().manual_seed(0))
    loss.backward()
    assert dit.net.patch_embed["proj"].weight.grad.abs().sum() > 0
    assert all(p.grad is None for p in dit.codec.parameters())


def test_cross_view_attention_in_every_third_block_only() -> None:
    torch.manual_seed(0)
    shape = DiTShape(
        in_channels=4,
        out_channels=4,
        num_attention_heads=2,
        attention_head_dim=24,
        num_layers=3,
        text_embed_dim=8,
        adaln_lora_dim=8,
    )
    net = MultiViewDiT(shape).eval()
    calls = []
    for block in net.transformer_blocks:
        block.register_forward_pre_hook(lambda module, args: calls.append(args[-1]))
    net(torch.randn(3, 4, 2, 4, 4), torch.rand(3, 2), torch.zeros(1, 1, 8), 3, 10.0)
    assert calls == [3, 1, 1]


def test_known_text_keys_change_nothing_and_follow_the_weights() -> None:
    torch.manual_seed(0)
    net = MultiViewDiT(
        DiTShape(
            in_channels=4,
            out_channels=4,
            num_attention_heads=2,
            attention_head_dim=24,
            num_layers=3,
            text_embed_dim=8,
            adaln_lora_dim=8,
        )
    ).eval()
    for p in net.parameters():
        torch.nn.init.normal_(p, std=0.1)
    latents, times, text = torch.randn(6, 4, 2, 4, 4), torch.rand(6, 2), torch.randn(1, 5, 8)
    anew = net(latents, times, text.repeat(6, 1, 1), 3, 10.0)[0].detach()
    with torch.no_grad():
        kept = [net(latents, times, text, 3, 10.0)[0] for _ in range(2)]
        assert torch.allclose(kept[0], anew, atol=1e-5) and torch.equal(*kept)
        net.transformer_blocks[0].attn2.to_v.weight.mul_(3.0)
        assert not torch.allclose(net(latents, times, text, 3, 10.0)[0], kept[0], atol=1e-4)


def test_the_expert_learns_its_mix_and_the_simulator_takes_it_over(
    dit: DiTSimulator, store: ClipStore
) -> None:
    torch.manual_seed(1)
    expert = untrained_expert(dit, StateExpertConfig(layers=2))
    clip = store.clips(torch.tensor([1, 2]), torch.tensor([0, 3]), ClipSpec(4, 4))
    inputs = dit.build_inputs(clip, 0, generator=torch.Generator().manual_seed(0))
    dit.requires_grad_(False)
    features = expert.read(expert.look(dit, inputs))
    history, future = clip["history"], clip["future"]
    expert.loss(
        features,
        future["commands"],
        history["commands"],
        history["states"],
        future["states"],
        future["valid"].float(),
        torch.Generator().manual_seed(0),
    ).backward()
    assert expert.net.video_buffer_weights.grad.abs().max() > 0
    with torch.no_grad():
        expert.net.video_buffer_weights.copy_(torch.tensor([0.5, 2.0, -1.0]))
        expert.attach(dit)
        assert torch.allclose(
            dit.features(inputs)[:, :, expert.tokens], expert.read(expert.look(dit, inputs)), atol=1e-5
        )


def test_checkpointed_blocks_give_the_same_gradients(dit: DiTSimulator, store: ClipStore) -> None:
    clip = store.clips(torch.tensor([1]), torch.tensor([0]), ClipSpec(4, 4))
    grads = []
    for checkpointing in (False, True):
        dit.net.checkpointing = checkpointing
        dit.zero_grad()
        dit.loss(clip, torch.Generator().manual_seed(0))[0].backward()
        grads.append(dit.net.transformer_blocks[1].attn1.to_q.weight.grad.clone())
    assert torch.allclose(*grads, atol=1e-7)


def test_one_token_tells_everybody_the_same() -> None:
    torch.manual_seed(0)
    attention = Attention(24, 2, 8, context=12)
    asking, context = torch.randn(3, 5, 24), torch.randn(3, 1, 12)
    said = attention.alone(attention.keys_of(context)[1])
    assert said.shape == (3, 1, 24) and torch.allclose(
        attention(asking, context), said.expand(-1, 5, -1), atol=1e-6
    )
