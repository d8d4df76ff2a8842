"""Convolutional encoder and decoder of single pictures, which our video autoencoders share."""

from __future__ import annotations

from torch import Tensor, nn

FOLD = 4  # pixels each way that are folded into channels first: convolutions at full size cost most


class Residual(nn.Module):
    """x + conv(silu(norm(conv(silu(norm(x)))))) of [N, width, H, W]."""

    def __init__(self, width: int):
        super().__init__()
        self.layers = nn.Sequential(
            nn.GroupNorm(8, width),
            nn.SiLU(),
            nn.Conv2d(width, width, 3, padding=1),
            nn.GroupNorm(8, width),
            nn.SiLU(),
            nn.Conv2d(width, width, 3, padding=1),
        )

    def forward(self, x: Tensor) -> Tensor:
        return x + self.layers(x)


def encoder(channels: int, width: int, halvings: int = 1) -> nn.Sequential:
    """Folded pictures [N, 3 * FOLD ** 2, H, W] -> [N, channels, H / 2 ** halvings, W / 2 ** halvings].

    Args:
        channels: of the output.
        width: of all layers between, a multiple of 8.
        halvings: of the resolution, after folding.
    """
    layers: list[nn.Module] = [nn.Conv2d(3 * FOLD**2, width, 1), Residual(width)]
    for _ in range(halvings):
        layers += [nn.Conv2d(width, width, 2, stride=2), Residual(width)]
    layers += [Residual(width), nn.GroupNorm(8, width), nn.SiLU(), nn.Conv2d(width, channels, 1)]
    return nn.Sequential(*layers)


def decoder(channels: int, width: int, halvings: int = 1) -> nn.Sequential:
    """The way back, [N, channels, h, w] -> folded pictures; see `encoder`."""
    layers: list[nn.Module] = [nn.Conv2d(channels, width, 3, padding=1), Residual(width), Residual(width)]
    for _ in range(halvings):
        layers += [nn.Conv2d(width, 4 * width, 1), nn.PixelShuffle(2), Residual(width)]
    layers += [nn.GroupNorm(8, width), nn.SiLU(), nn.Conv2d(width, 3 * FOLD**2, 1)]
    return nn.Sequential(*layers)
