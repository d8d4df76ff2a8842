"""The perceptual distance against what one can see: shifts of light are milder than blur of equal error."""

from __future__ import annotations

import pytest
import torch
from torch.nn import functional

from envs.judges.perceptual import PerceptualDistance


@pytest.fixture
def picture() -> torch.Tensor:
    """Blocks of colour with sharp edges, [1, 3, 64, 64] in 0.2..0.8."""
    small = torch.rand(1, 3, 8, 8, generator=torch.Generator().manual_seed(0)) * 0.6 + 0.2
    return small.repeat_interleave(8, -1).repeat_interleave(8, -2)


def test_equal_pictures_are_equal_and_distance_is_symmetric(picture: torch.Tensor) -> None:
    distance, other = PerceptualDistance(), picture.flip(-1)
    assert float(distance(picture, picture)) == 0.0
    assert torch.equal(distance(picture, other), distance(other, picture)) and float(distance(picture, other))
    both = distance(torch.stack((picture, other)), torch.stack((picture, picture)))
    assert both.shape == (2, 1) and float(both[0]) == 0.0
    with pytest.raises(ValueError, match="cannot be compared"):
        distance(picture, picture[..., :32])


def test_blur_weighs_more_than_light_of_the_same_error(picture: torch.Tensor) -> None:
    distance = PerceptualDistance()
    blurred = functional.avg_pool2d(picture, 5, 1, 2, count_include_pad=False)
    error = (blurred - picture).square().mean().sqrt()
    lighter = picture + error
    assert (lighter - picture).square().mean().sqrt() == pytest.approx(float(error))
    assert float(distance(picture, blurred)) > 2 * float(distance(picture, lighter))


def test_more_noise_is_further_away_and_gradients_are_finite(picture: torch.Tensor) -> None:
    distance = PerceptualDistance()
    noise = torch.randn(picture.shape, generator=torch.Generator().manual_seed(1))
    steps = [float(distance(picture, picture + level * noise)) for level in (0.01, 0.03, 0.1)]
    assert steps == sorted(steps) and steps[0] > 0
    learned = picture.clone().requires_grad_()
    distance(learned, picture).sum().backward()
    assert learned.grad is not None and torch.isfinite(learned.grad).all()
    bytes_ = (picture * 255).round().to(torch.uint8)
    assert float(distance(bytes_, picture)) < 0.02


@pytest.mark.parametrize("size", [(64, 64), (49, 66), (47, 81), (17, 16)])
def test_levels_are_in_register(size: tuple[int, int]) -> None:
    """A slope of light is the same at all scales, so that no band holds any of it but at the edges."""
    distance, (height, width) = PerceptualDistance(), size
    down, across = torch.arange(height) / height, torch.arange(width) / width
    ramp = (0.6 * down[:, None] + 0.4 * across).expand(1, 3, -1, -1)
    *bands, _ = distance.bands(ramp)
    assert len(bands) == (1 if min(size) < 32 else 2 if min(size) < 64 else 3)
    assert bands[0].shape[-2:] == size
    assert all(float(band[..., 6:-6, 6:-6].abs().max()) < 1e-3 for band in bands)


def test_a_mirror_image_has_mirrored_bands(picture: torch.Tensor) -> None:
    distance = PerceptualDistance()
    for band, other in zip(distance.bands(picture), distance.bands(picture.flip(-1, -2)), strict=True):
        assert torch.allclose(band.flip(-1, -2), other, atol=1e-5)
