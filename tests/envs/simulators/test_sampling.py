"""Samplers against what is known of them: an exact flow, and diffusers' scheduler with released numbers."""

from __future__ import annotations

import pytest
import torch
from diffusers import FlowMatchEulerDiscreteScheduler

from envs.simulators.samplers import EDM, Distilled, Euler


def test_every_sampler_finds_the_data_of_an_exact_flow() -> None:
    torch.manual_seed(0)
    data, noise = torch.randn(2, 5), torch.randn(2, 5)

    def velocity(z: torch.Tensor, level: float) -> torch.Tensor:
        return (z - data) / level  # that of a world with one possible future

    assert torch.allclose(Euler(4, 1.0)(velocity, noise), data, atol=1e-5)
    assert torch.allclose(Distilled()(velocity, noise), data, atol=1e-5)
    assert (EDM(15)(velocity, noise) - data).abs().max() < 0.002 * noise.abs().max() + 1e-4


def test_distilled_returns_to_the_same_noise() -> None:
    seen = []

    def velocity(z: torch.Tensor, level: float) -> torch.Tensor:
        seen.append((level, z.clone()))
        return torch.zeros_like(z)

    noise = torch.ones(1)
    out = Distilled((1.0, 0.5))(velocity, noise)
    # Without velocity the data found is z itself: 1 at first, then half of it and half of the noise.
    assert [level for level, _ in seen] == [1.0, 0.5] and float(seen[1][1]) == 1.0 and float(out) == 1.0
    with pytest.raises(ValueError, match="must fall"):
        Distilled((0.5, 1.0))


def test_edm_is_diffusers_scheduler_with_the_released_configuration() -> None:
    scheduler = FlowMatchEulerDiscreteScheduler(use_karras_sigmas=True)
    scheduler.register_to_config(sigma_max=80.0, sigma_min=0.002)
    scheduler.set_timesteps(sigmas=torch.linspace(0, 1, 15).double().numpy())
    theirs = scheduler.sigmas.clone()
    theirs[-1] = theirs[-2]  # final_sigmas_type sigma_min
    ours = torch.tensor([*EDM(15).sigmas(), EDM(15).sigmas()[-1]])
    assert torch.allclose(ours.float(), theirs.float(), rtol=1e-4)
    torch.manual_seed(0)
    weight, noise = torch.randn(4, 4), torch.randn(3, 4)

    def velocity(z: torch.Tensor, level: float) -> torch.Tensor:
        return torch.tanh(z @ weight + level)

    z = noise * theirs[0]
    for sigma, following in zip(theirs[:-1].tolist(), theirs[1:].tolist(), strict=True):
        t = sigma / (sigma + 1)
        denoised = (1 - t) * z - t * velocity(z * (1 - t), t)
        z = z + (following - sigma) * (z - denoised) / sigma
    assert torch.allclose(EDM(15)(velocity, noise), z, atol=1e-3)
