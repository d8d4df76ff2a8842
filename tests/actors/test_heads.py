"""Action heads: what they say, how sure they are, and what demonstrations make of them."""

from __future__ import annotations

from functools import partial

import torch
from tensordict import TensorDict
from torch.distributions import kl_divergence

from actors.policies.chunk_tokens import ChunkTokenHead, ChunkTokens
from actors.policies.vla import ChunkPolicy
from envs.specs import CHUNK, IMAGE, LOG_PROB, STATE, TOKENS


def tokens(*batch: int, bins: int = 8) -> ChunkTokens:
    """A distribution over chunks [4, 3] whose middle dimension is constant."""
    return ChunkTokens(
        torch.randn(*batch, 4, 3, bins), torch.tensor([-1.0, 0.5, 0.0]), torch.tensor([1.0, 0.5, 2.0])
    )


def test_tokens_are_a_density_over_bins() -> None:
    torch.manual_seed(0)
    dist = tokens(5)
    chunk = dist.sample()
    assert chunk.shape == (5, 4, 3) and bool((chunk[..., 1] == 0.5).all())
    assert bool((chunk[..., 0].abs() < 1).all()) and bool(((chunk[..., 2] > 0) & (chunk[..., 2] < 2)).all())
    bins = torch.stack(((chunk[..., 0] + 1) / 2 * 8, chunk[..., 2] / 2 * 8), -1).floor().long()
    expected = dist.log_share[:, :, [0, 2]].gather(-1, bins.unsqueeze(-1)).sum((-3, -2, -1))
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


def test_a_token_policy_learns_a_demonstrated_chunk_and_scores_what_it_writes() -> None:
    torch.manual_seed(0)
    policy = ChunkPolicy(
        1, partial(ChunkTokenHead, chunk=4, bins=16, actions=3), width=32, points=4, states=5, channels=16
    )
    seen = TensorDict(
        {
            IMAGE: torch.randint(0, 255, (6, 1, 3, 16, 16), dtype=torch.uint8),
            STATE: torch.randn(6, 5),
            TOKENS: torch.randint(0, 99, (6, 12)),
        },
        [6],
    )
    chunks = torch.rand(6, 4, 3) * torch.tensor([0.2, 1e-6, 4.0])
    policy.normalise(chunks, seen[STATE], torch.full((3,), 1e-3))
    out = policy(seen.clone())
    assert torch.allclose(policy.get_dist(seen.clone()).log_prob(out[CHUNK]), out[LOG_PROB], atol=1e-4)
    hidden, target = (
        policy.fusion(policy.perception(seen[IMAGE], seen[TOKENS]), seen[STATE]).detach(),
        policy.head.target(chunks),
    )
    optimiser = torch.optim.Adam(policy.head.parameters(), 0.05)
    for _ in range(150):
        optimiser.zero_grad()
        policy.head.error(hidden, target).backward()
        optimiser.step()
    with torch.no_grad():
        said = ChunkTokens(*policy.head(hidden)).mode
    # a bin spans the range and a tenth on either side
    assert float((said - chunks)[..., 2].abs().max()) < 4.8 / 16
    assert bool(((said - chunks)[..., 1].abs() < 1e-5).all())
    assert float(policy.head.apart(hidden, hidden)) < 1e-6 < float(policy.head.apart(hidden, hidden.flip(0)))
