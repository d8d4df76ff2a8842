"""The DiT engine: determinism per seed and chunk, and that it can learn."""

from __future__ import annotations

import pytest
import torch

from envs.episodes.clips import ClipSpec, ClipStore
from envs.simulators.base import WorldShape
from envs.simulators.dit import DiTShape, MultiViewDiT
from envs.simulators.dit_world import DiTConfig, DiTSimulator
from envs.simulators.replay import replay
from envs.simulators.state_flow import StateExpert, StateExpertConfig

TINY = DiTConfig(layers=3, heads=2, head_dim=32, adaln_rank=8, codec_width=16, steps=2)


@pytest.fixture
def dit() -> DiTSimulator:
    torch.manual_seed(0)
    return DiTSimulator(WorldShape(chunk=4), TINY).eval()


def test_rollouts_depend_on_seed_and_not_on_batch(dit: DiTSimulator, store: ClipStore) -> None:
    torch.manual_seed(1)
    expert = StateExpert(dit.feature_shape, 4, 4, StateExpertConfig(layers=2)).eval()
    both = replay(dit, store, torch.tensor([1, 2]), expert, bf16=False)
    alone = replay(dit, store, torch.tensor([2]), expert, bf16=False)
    length = alone.frames.shape[1]
    assert (both.frames[1, :length].int() - alone.frames[0].int()).abs().max() <= 1
    assert torch.allclose(both.states[1, :length], alone.states[0], atol=1e-3)
    assert not torch.equal(dit._noise(torch.tensor([1]), torch.tensor([0]), torch.zeros(1, 3, 16, 4, 8, 8)), dit._noise(torch.tensor([1]), torch.tensor([1]), torch.zeros(1, 3, 16, 4, 8, 8)))


def test_loss_trains_trunk_and_unrolls(dit: DiTSimulator, store: ClipStore) -> None:
    clip = store.clips(torch.tensor([1, 2]), torch.tensor([0, 3]), ClipSpec(4, 4, 2))
    loss, _ = dit.loss(clip, torch.Generator().manual_seed(0))
    loss.backward()
    assert dit.net.patch_embed["proj"].weight.grad.abs().sum() > 0
    assert all(p.grad is None for p in dit.codec.parameters())


def test_cross_view_attention_in_every_third_block_only() -> None:
    torch.manual_seed(0)
    shape = DiTShape(in_channels=4, out_channels=4, num_attention_heads=2, attention_head_dim=24, num_layers=3, text_embed_dim=8, adaln_lora_dim=8)
    net = MultiViewDiT(shape).eval()
    calls = []
    for block in net.transformer_blocks:
        block.register_forward_pre_hook(lambda module, args: calls.append(args[-1]))
    net(torch.randn(3, 4, 2, 4, 4), torch.rand(3, 2), torch.zeros(1, 1, 8), 3, 10.0)
    assert calls == [3, 1, 1]
