"""LPIPS (Zhang et al. 2018) with AlexNet, from weights that lie on disk; nothing is downloaded.

A distance of pictures like envs/judges/perceptual.py, for whoever has the two files: torchvision's AlexNet
(alexnet-owt-7be5be79.pth) and the linear weights of the `lpips` package (lpips/weights/v0.1/alex.pth).
"""

from __future__ import annotations

from pathlib import Path

import torch
import torch.nn.functional as F
from safetensors.torch import load_file
from torch import Tensor, nn

# Channels in and out, kernel, stride, padding, and whether the largest of 3 x 3 is taken first.
_LAYERS = (
    (3, 64, 11, 4, 2, False),
    (64, 192, 5, 1, 2, True),
    (192, 384, 3, 1, 1, True),
    (384, 256, 3, 1, 1, False),
    (256, 256, 3, 1, 1, False),
)
_PLACES = (0, 3, 6, 8, 10)  # of the convolutions among torchvision's `features`
_SHIFT, _SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)  # of pictures in -1..1
_SMALLEST = 32  # pixels of a side, below which nothing is left to compare at the last layer


class LPIPS(nn.Module):
    """Learned perceptual image patch similarity, version 0.1; 0 of equal pictures.

    Args:
        network: file with the weights of torchvision's AlexNet, .pth or .safetensors.
        linear: file with the weights of the five linear layers, likewise.

    Attributes:
        name: to be told beside every figure.

    Raises:
        ValueError: if a file is missing or holds other weights.
    """

    name = "LPIPS 0.1 (AlexNet)"

    def __init__(self, network: str, linear: str):
        super().__init__()
        trunk, heads = _read(network, "network"), _read(linear, "linear")
        self.convolutions = nn.ModuleList(nn.Conv2d(a, b, k, s, p) for a, b, k, s, p, _ in _LAYERS)
        self.weights = nn.ParameterList(torch.zeros(b) for _, b, *_ in _LAYERS)
        for number, place in enumerate(_PLACES):
            for name, value in self.convolutions[number].named_parameters():
                _fill(value, trunk, f"features.{place}.{name}", network)
            _fill(self.weights[number], heads, f"lin{number}.model.1.weight", linear)
        self.register_buffer("shift", torch.tensor(_SHIFT)[:, None, None], persistent=False)
        self.register_buffer("scale", torch.tensor(_SCALE)[:, None, None], persistent=False)
        self.shift: Tensor
        self.scale: Tensor
        self.requires_grad_(False)

    def forward(self, one: Tensor, other: Tensor) -> Tensor:
        """Distances float32 [N] of pictures [N, 3, H, W], uint8 or float in 0..1.

        Raises:
            ValueError: if pictures are too small for the network.
        """
        if min(one.shape[-2:]) < _SMALLEST:
            small = min(one.shape[-2:])
            raise ValueError(f"LPIPS needs pictures of at least {_SMALLEST} pixels a side, not of {small}")
        total = torch.zeros(len(one), device=one.device)
        for mine, theirs, weight in zip(self._layers(one), self._layers(other), self.weights, strict=True):
            apart = (mine - theirs).square()
            total = total + torch.einsum("nchw,c->nhw", apart, weight).mean((-2, -1))
        return total

    def _layers(self, pictures: Tensor) -> list[Tensor]:
        """Activations of all layers, of unit length at every place."""
        x = pictures.float() / 255 if pictures.dtype == torch.uint8 else pictures.float()
        x = (2 * x - 1 - self.shift) / self.scale
        out = []
        for (*_, pooled), conv in zip(_LAYERS, self.convolutions, strict=True):
            x = F.relu(conv(F.max_pool2d(x, 3, 2) if pooled else x))
            out.append(x / (x.square().sum(1, keepdim=True).sqrt() + 1e-10))
        return out


def _read(path: str, key: str) -> dict[str, Tensor]:
    file = Path(path)
    if not file.is_file():
        raise ValueError(
            f"{key}={path} does not exist; LPIPS needs its weights on disk, see envs/judges/lpips.py"
        )
    if file.suffix == ".safetensors":
        return load_file(file)
    found = torch.load(file, map_location="cpu", weights_only=True)
    return dict(found)


def _fill(parameter: Tensor, found: dict[str, Tensor], name: str, path: str) -> None:
    """Copy a tensor of the file; linear weights lie there as 1 x C x 1 x 1."""
    value = found.get(name)
    if value is None or value.numel() != parameter.numel():
        shape = None if value is None else tuple(value.shape)
        raise ValueError(f"{path}: {name} should hold {tuple(parameter.shape)}, and is {shape}")
    with torch.no_grad():
        parameter.copy_(value.reshape(parameter.shape))
