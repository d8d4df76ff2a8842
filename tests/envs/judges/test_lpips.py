"""LPIPS from files: it is read as the public files are laid out, and is a distance."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from envs.judges.lpips import LPIPS

SHAPES = {
    0: (64, 3, 11, 11),
    3: (192, 64, 5, 5),
    6: (384, 192, 3, 3),
    8: (256, 384, 3, 3),
    10: (256, 256, 3, 3),
}


@pytest.fixture
def files(tmp_path: Path) -> tuple[str, str]:
    """Random weights in the layout of torchvision's file and of the lpips package's."""
    draw = torch.Generator().manual_seed(0)
    network, linear = {}, {}
    for number, (place, shape) in enumerate(SHAPES.items()):
        network[f"features.{place}.weight"] = 0.05 * torch.randn(shape, generator=draw)
        network[f"features.{place}.bias"] = 0.05 * torch.randn(shape[0], generator=draw)
        linear[f"lin{number}.model.1.weight"] = torch.rand(1, shape[0], 1, 1, generator=draw)
    network["classifier.6.bias"] = torch.zeros(1000)
    torch.save(network, tmp_path / "alexnet.pth")
    save_file(linear, tmp_path / "alex.safetensors")
    return str(tmp_path / "alexnet.pth"), str(tmp_path / "alex.safetensors")


def test_it_is_a_distance_of_pictures(files: tuple[str, str]) -> None:
    metric, draw = LPIPS(*files), torch.Generator().manual_seed(1)
    pictures = torch.randint(0, 256, (3, 3, 32, 48), dtype=torch.uint8, generator=draw)
    other = pictures.flip(0)
    away = metric(pictures, other)
    assert away.shape == (3,) and torch.allclose(away, metric(other, pictures)) and float(away[0]) > 0
    assert not bool(metric(pictures, pictures).any())
    assert torch.allclose(metric(pictures.float() / 255, other), away, atol=1e-5)
    nearer = (0.9 * pictures.float() + 0.1 * other.float()) / 255
    assert bool((metric(pictures, nearer)[[0, 2]] < away[[0, 2]]).all())


def test_wrong_files_and_small_pictures_are_told(files: tuple[str, str], tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="does not exist"):
        LPIPS(str(tmp_path / "nowhere.pth"), files[1])
    with pytest.raises(ValueError, match=r"features\.0\.weight"):
        LPIPS(files[1], files[1])
    with pytest.raises(ValueError, match="32 pixels"):
        LPIPS(*files)(torch.zeros(1, 3, 16, 64), torch.zeros(1, 3, 16, 64))
