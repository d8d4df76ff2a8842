"""Action heads: what they say, how sure they are, and what demonstrations make of them."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch.distributions import kl_divergence

from actors.policies.chunk_gaussian import ChunkGaussian, ChunkGaussianHead, knot_basis
from actors.policies.chunk_tokens import ChunkTokenHead, ChunkTokens
from actors.policies.heads import varying
from envs.embodiment import ActionKind
from envs.specs import ActionMode, to_chunk
from tests.embodiments import ARM_JOINTS, BIMANUAL_POSES


class WrongHead(ChunkGaussianHead):
    """A head that says one number too few."""

    def __init__(self, width: int, chunk: int, actions: int, knots: int, std: float, mode: str):
        super().__init__(width, chunk, actions - 1, knots, std, mode)


def tokens(*batch: int, bins: int = 8) -> ChunkTokens:
    """A distribution over chunks [4, 3] whose middle dimension is constant."""
    low, high = torch.tensor([-1.0, 0.5, 0.0]), torch.tensor([1.0, 0.5, 2.0])
    return ChunkTokens(torch.randn(*batch, 4, 3, bins), low, high, torch.ones(batch))


def test_tokens_are_a_density_over_bins() -> None:
    torch.manual_seed(0)
    dist = tokens(5)
    chunk = dist.sample()
    assert chunk.shape == (5, 4, 3) and bool((chunk[..., 1] == 0.5).all())
    assert bool((chunk[..., 0].abs() < 1).all()) and bool(((chunk[..., 2] > 0) & (chunk[..., 2] < 2)).all())
    bins = torch.stack(((chunk[..., 0] + 1) / 2 * 8, chunk[..., 2] / 2 * 8), -1).floor().long()
    expected = dist.log_probs[:, :, [0, 2]].gather(-1, bins.unsqueeze(-1)).sum((-3, -2, -1))
    assert torch.allclose(dist.log_prob(chunk), expected, atol=1e-5)
    assert bool((dist.log_prob(dist.mode) >= dist.log_prob(chunk)).all())


def test_tokens_draw_as_often_as_they_say_and_diverge_from_others_only() -> None:
    torch.manual_seed(0)
    dist, other = tokens(), tokens()
    drawn = dist.sample((20_000,))
    assert drawn.shape == (20_000, 4, 3)
    assert torch.allclose(drawn.mean(0), dist.mean, atol=0.03)
    assert float(kl_divergence(dist, dist)) == 0.0
    estimate = (dist.log_prob(drawn) - other.log_prob(drawn)).mean()
    assert torch.allclose(kl_divergence(dist, other), estimate, rtol=0.05)
    assert torch.allclose(dist.entropy(), -dist.log_prob(drawn).mean(), rtol=0.05)


def test_gaussian_chunks_are_smooth_from_rest_and_their_density_consistent() -> None:
    gain = torch.tensor([1.0, 0.0, 2.0])
    dist = ChunkGaussian(
        torch.zeros(5, 2, 3),
        torch.full((5, 2, 3), 0.5),
        knot_basis(4, 2, from_rest=True),
        gain,
        torch.tensor([0.0, 7.0, 0.0]),
        torch.ones(5),
    )
    chunk = dist.sample()
    assert chunk.shape == (5, 4, 3) and bool((chunk[..., 1] == 7.0).all())
    assert torch.allclose(chunk[:, 0, 0] * 2, chunk[:, 1, 0], atol=1e-6)  # linear from rest to the first knot
    knots = torch.stack((chunk[:, 1], chunk[:, 3]), 1)[..., [0, 2]] / gain[[0, 2]]
    expected = torch.distributions.Normal(0.0, 0.5).log_prob(knots).sum((-2, -1))
    assert torch.allclose(dist.log_prob(chunk), expected, atol=1e-4)


@pytest.mark.parametrize("knots", [1, 2, 4])
def test_chunks_that_do_not_begin_at_rest_can_stay_anywhere(knots: int) -> None:
    basis = knot_basis(4, knots, from_rest=False)
    assert torch.allclose(basis.sum(1), torch.ones(4))  # equal knots are a constant chunk
    assert torch.allclose(basis[0], torch.eye(knots)[0])
    head = ChunkGaussianHead(8, 4, 2, knots, 0.3, "absolute")
    chunks = 50 + torch.randn(20, 1, 2).expand(-1, 4, -1)
    head.normalise(chunks, torch.tensor([True, True]))
    dist = ChunkGaussian(*head(torch.zeros(1, 8)))
    assert torch.allclose(dist.mean, chunks.mean((0, 1)).expand(1, 4, 2), atol=0.1)


def test_token_head_spans_what_was_demonstrated() -> None:
    head = ChunkTokenHead(8, 4, 3, 16)
    chunks = torch.rand(30, 4, 3) * torch.tensor([0.2, 0.0, 4.0]) + torch.tensor([0.0, 0.3, 0.0])
    head.normalise(chunks, torch.tensor([True, False, True]))
    dist = ChunkTokens(*head(torch.randn(5, 8)))
    said = dist.sample((100,))
    assert bool((said[..., 1] - 0.3).abs().max() < 1e-6)
    assert float(said[..., 2].max()) > 3.5 and float(said[..., 0].max()) < 0.25
    target = head.target(chunks)
    assert float((dist._decode(target) - chunks).abs()[..., 2].max()) < 4.8 / 16


def test_what_hardly_varies_is_told_by_the_spread_of_its_unit() -> None:
    g = torch.Generator().manual_seed(0)
    chunks = torch.zeros(50, 4, 14)
    chunks[..., 0:2] = 0.05 * torch.randn(50, 4, 2, generator=g)  # x and y of the left arm
    chunks[..., 2] = 2e-4 * torch.randn(50, 4, generator=g)  # z wobbles by 0.2 mm
    chunks[..., 3] = 5e-3 * torch.randn(50, 4, generator=g)  # roll is the only angle that moves
    chunks[..., 6] = 0.005 * torch.randn(50, 4, generator=g)  # the gripper chatters within half a percent
    chunks[..., 13] = 0.3 * torch.randn(50, 4, generator=g)
    assert varying(chunks, BIMANUAL_POSES).nonzero().flatten().tolist() == [0, 1, 3, 13]
    chunks = 10 + torch.randn(50, 4, 7, generator=g) * torch.tensor([9.0, 9.0, 0.01, 1.0, 9.0, 9.0, 30.0])
    assert varying(chunks, ARM_JOINTS).tolist() == [True, True, False, True, True, True, True]
    unknown = replace(ARM_JOINTS, action_kind=ActionKind.OTHER)
    assert bool(varying(chunks, unknown).all())


def demonstrated(mode: ActionMode, delta: bool) -> torch.Tensor:
    """Chunks [N, 4, 7] of ARM_JOINTS that wander by degrees; joint 0 is a rail in metres, joint 1 stands
    still up to noise, the gripper opens and closes between 0 and 1, and all rest at the end.
    """
    g = torch.Generator().manual_seed(1)
    chunks = []
    for _ in range(20):
        path = torch.randn(44, 7, generator=g).cumsum(0) * torch.tensor([0.01, 0.0, 5, 5, 5, 5, 0.0])
        path[:, 1] = 90 + 0.02 * torch.randn(44, generator=g)
        path[:, 6] = ((torch.arange(44) + torch.randint(20, (), generator=g)) // 10 % 2).float()
        path[38:] = path[38]
        last = path[:-1]
        if delta:
            path = torch.cat((path[1:, :6] - path[:-1, :6], path[1:, 6:]), 1)
            last = path
        ahead = path[torch.arange(1, 40)[:, None] + torch.arange(4)]
        chunks.append(to_chunk(ahead, last[:39], mode))
    return torch.cat(chunks)


@pytest.mark.parametrize(
    ("mode", "delta"),
    [(ActionMode.ABSOLUTE, False), (ActionMode.RELATIVE, False), (ActionMode.ABSOLUTE, True)],
)
def test_what_moves_is_not_held_for_its_unit(mode: ActionMode, delta: bool) -> None:
    chunks = demonstrated(mode, delta)
    robot = replace(ARM_JOINTS, delta=delta)  # whose gripper is said to go from 0 to 100
    before = chunks.clone()
    for given in (chunks, before.double()):
        assert varying(given, robot).tolist() == [True, False, True, True, True, True, True]
        assert torch.equal(given, before.to(given))  # nothing is changed in them


def test_where_modes_are_taken_too_the_spread_does_not_learn() -> None:
    torch.manual_seed(0)
    head = ChunkGaussianHead(8, 4, 3, 2, 0.7, "absolute")
    for share, learns in ((1.0, True), (0.5, False)):
        head.share.fill_(share)
        head.zero_grad(set_to_none=True)
        dist = ChunkGaussian(**dict(zip(head.names, head(torch.randn(6, 8)), strict=True)))
        dist.log_prob(dist.sample()).sum().backward()
        moved = head.log_std.grad is not None and bool(head.log_std.grad.any())
        assert moved == learns
        assert head.mean.weight.grad is not None and bool(head.mean.weight.grad.any())
