"""Squares of pixels, and what looks at them."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F

from envs.simulators.unet.blocks import Embed, at_detail
from envs.simulators.unet.folding import fold, unfold


@pytest.mark.parametrize(
    ("edge", "dtype"),
    [(4, torch.uint8), (8, torch.uint8), (4, torch.float32), (4, torch.bfloat16), (8, torch.float32)],
)
def test_folding_is_torchs_unshuffling(edge: int, dtype: torch.dtype) -> None:
    pictures = (torch.rand(2, 3, 16, 24) * 255).to(dtype)
    squares = fold(pictures, edge)
    assert squares.dtype == dtype
    assert torch.equal(squares.permute(0, 3, 1, 2).float(), F.pixel_unshuffle(pictures.float(), edge))
    assert torch.equal(unfold(squares, edge), pictures)


def test_unfolding_passes_gradients_on() -> None:
    maps = torch.randn(2, 3, 4, 16, requires_grad=True)
    wanted = torch.randn(2, 1, 12, 16)
    (unfold(maps, 4) * wanted).sum().backward()
    assert torch.equal(maps.grad, fold(wanted, 4))  # type: ignore[arg-type]


@pytest.mark.parametrize("shrink", [1, 2])
def test_looking_at_bytes_is_a_convolution_of_pictures(shrink: int) -> None:
    torch.manual_seed(0)
    embed = Embed(6, 8, shrink, 4)
    pictures = torch.randint(0, 256, (2, 6, 16 * shrink, 24 * shrink), dtype=torch.uint8)
    small = at_detail(pictures, shrink) * 2 - 1
    wanted = F.conv2d(small, embed.weight, embed.bias, stride=4)
    for parts in ([pictures], [pictures[:, :3].float(), pictures[:, 3:]]):  # generated ones are floats
        assert torch.allclose(embed(parts), wanted, atol=1e-5)
