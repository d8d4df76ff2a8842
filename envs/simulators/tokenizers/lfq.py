"""Pictures as tokens: an autoencoder with lookup-free quantisation (MAGVIT-2, Yu et al. 2023).

Every number of the latent keeps only its sign, so n numbers are a code of 2^n without a codebook to look up.
Codes so large are too many for a softmax: their bits are split into factors, each a small vocabulary of its
own. Every frame of every camera is encoded on its own, all with the same weights.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

import torch
import torch.nn.functional as F
from annotated_types import Ge, Le, MultipleOf
from torch import Tensor, nn

from envs.ranges import Count, NonNegative
from envs.simulators.tokenizers.convolutions import FOLD, decoder, encoder
from envs.simulators.tokenizers.errors import gradient_difference, picture_error, psnr

_COLLAPSED = 0.02  # perplexity, of the codes that could have been seen, below which a codebook has collapsed
_FEWEST = 1.5  # and in codes, for small ones
# Of a token, as in MAGVIT-2: a table lists all codes, and transformers say how likely each is.
_MOST_BITS = 18


class LookupFreeQuantiser(nn.Module):
    """Numbers to signs, and signs to tokens and back.

    Args:
        bits: numbers of a latent, n.
        factors: parts the code is split into, tokens; a divisor of bits that leaves a token at most 18.

    Attributes:
        codes: of a factor, 2^(bits / factors).

    Raises:
        ValueError: if the bits cannot be split so.
    """

    powers: Tensor
    table: Tensor

    def __init__(self, bits: int, factors: int):
        super().__init__()
        if bits % factors:
            raise ValueError(f"codec.bits={bits} must be a multiple of codec.factors={factors}")
        self.bits, self.factors, self.each = bits, factors, bits // factors
        if self.each > _MOST_BITS:
            raise ValueError(
                f"codec.bits={bits} in codec.factors={factors} are tokens of {self.each} bits, and a table of"
                f" all 2^{self.each} codes is too large; raise codec.factors, or lower codec.bits, so that a"
                f" token has at most {_MOST_BITS} bits"
            )
        self.codes = 2**self.each
        self.register_buffer("powers", 2 ** torch.arange(self.each), persistent=False)
        self.register_buffer("table", bit_signs(self.each), persistent=False)

    def signs(self, z: Tensor) -> Tensor:
        """Numbers [N, bits, h, w] as -1 and 1; gradients pass as if they were left as they are."""
        hard = torch.where(z > 0, 1.0, -1.0).to(z.dtype)
        return z + (hard - z).detach()

    def tokens(self, z: Tensor) -> Tensor:
        """Tokens int64 [N, h, w, factors] of numbers or signs [N, bits, h, w]."""
        ones = (z > 0).long().unflatten(1, (self.factors, self.each))
        return (ones * self.powers[:, None, None]).sum(2).permute(0, 2, 3, 1)

    def latents(self, tokens: Tensor) -> Tensor:
        """Signs float32 [N, bits, h, w] of tokens [N, h, w, factors]."""
        ones = tokens[..., None] // self.powers % 2
        return (ones.flatten(-2) * 2 - 1).permute(0, 3, 1, 2).to(self.table.dtype)

    def entropies(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Entropy of each place's code, and of the codes of all places, in nats, summed over the factors.

        A place's code is taken for random, with the odds exp(-|z - code|^2); its bits are then independent,
        so that their entropies add up.
        """
        logits = 4 * z.float().permute(0, 2, 3, 1).flatten(0, 2)  # |z + 1|^2 - |z - 1|^2
        share = logits.sigmoid()
        each = F.binary_cross_entropy_with_logits(logits, share, reduction="none").sum(-1).mean()
        # of all bits of a factor at once: half of each logit, with the sign of the code's bit
        joint = (logits.unflatten(-1, (self.factors, self.each)) / 2) @ self.table.T
        mean = joint.softmax(-1).mean(0)
        return each, torch.special.entr(mean).sum()

    def use(self, tokens: Tensor) -> tuple[Tensor, Tensor]:
        """How tokens [..., factors] use the codebook: the share of the codes that occur, and their
        perplexity, exp of the entropy of their frequencies, each of the factor that uses fewest.
        """
        shares, perplexities = [], []
        for factor in tokens.reshape(-1, self.factors).unbind(-1):
            count = torch.bincount(factor, minlength=self.codes).float()
            frequency = count / count.sum()
            shares.append((count > 0).float().mean())
            perplexities.append(torch.special.entr(frequency).sum().exp())
        return torch.stack(shares).min(), torch.stack(perplexities).min()


def bit_signs(bits: int) -> Tensor:
    """Signs float32 [2 ** bits, bits] of all codes of so many bits, the lowest bit first."""
    powers = 2 ** torch.arange(bits)
    return ((torch.arange(2**bits)[:, None] // powers % 2) * 2 - 1).float()


class LookupFreeTokenizer(nn.Module):
    """Convolutional autoencoder of stills whose latents are signs; pictures are float in 0..1.

    Args:
        bits, factors: see LookupFreeQuantiser.
        stride: pixels each way of a token: 4, 8, 16, ...
        width: channels of all layers, a multiple of 8.
        gradients: loss weight of the multi-scale gradient difference (errors.py).
        commitment: loss weight of the distance between numbers and their signs.
        entropy: loss weight of the entropy of a place's code less that of all codes: a code shall be sure,
            and codes shall be many.

    Raises:
        ValueError: if the bits cannot be split, or a token has too many, or the stride is no power of two
            from 4 on.
    """

    def __init__(
        self,
        bits: Annotated[int, Ge(1), Le(64)],
        factors: Count,
        stride: Annotated[int, Ge(FOLD)],
        width: Annotated[int, Ge(8), MultipleOf(8)],
        gradients: NonNegative,
        commitment: NonNegative,
        entropy: NonNegative,
    ):
        super().__init__()
        if stride & (stride - 1):
            raise ValueError(f"codec.stride={stride} must be a power of two, such as 8 or 16")
        self.stride = stride
        self.gradients, self.commitment, self.entropy = gradients, commitment, entropy
        halvings = (stride // FOLD).bit_length() - 1
        self.encoder, self.decoder = (make(bits, width, halvings) for make in (encoder, decoder))
        self.quantiser = LookupFreeQuantiser(bits, factors)

    @property
    def factors(self) -> int:
        """Tokens of a place."""
        return self.quantiser.factors

    @property
    def bits(self) -> int:
        """Of a token."""
        return self.quantiser.each

    def encode(self, frames: Tensor) -> Tensor:
        """Stills [N, 3, H, W] -> tokens int64 [N, H / stride, W / stride, factors]."""
        return self.quantiser.tokens(self._numbers(frames))

    def decode(self, tokens: Tensor) -> Tensor:
        """Tokens [N, h, w, factors] -> stills float32 [N, 3, H, W], about 0..1."""
        return self._pictures(self.quantiser.latents(tokens))

    def loss(self, frames: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """Training loss of stills, and how well they are kept and the codebook is used."""
        z = self._numbers(frames).float()
        signs = self.quantiser.signs(z)
        made = self._pictures(signs)
        value = picture_error(made, frames) + self.gradients * gradient_difference(made, frames)
        each, all_places = self.quantiser.entropies(z)
        value = value + self.commitment * (z - signs.detach()).square().mean()
        value = value + self.entropy * (each - all_places)
        return value, {"psnr": psnr(made, frames), **self._use(self.quantiser.tokens(z))}

    def normalise(self, frames: Tensor) -> None:
        """Signs have no units to take."""

    @torch.no_grad()
    def figures(self, frames: Tensor) -> dict[str, float]:
        """PSNR in dB on stills; of their tokens the number, share of the codes used and perplexity."""
        tokens = self.encode(frames)
        found = {"psnr": psnr(self.decode(tokens), frames), **self._use(tokens)}
        return {name: float(value) for name, value in found.items()}

    def warning(self, figures: Mapping[str, float]) -> str:
        """What to do where figures of `loss` or `figures` say that the codebook has collapsed, else ""."""
        floor = max(_FEWEST, _COLLAPSED * min(self.quantiser.codes, figures["codebook_tokens"]))
        if figures["perplexity"] >= floor:
            return ""
        return (
            f"the codebook has collapsed: of {self.quantiser.codes} codes a factor, as if"
            f" {figures['perplexity']:.2f} were in use in {figures['codebook_tokens']:.0f} tokens (least"
            f" {floor:.2f}); raise the codec's entropy,"
            " lower its bits (simulator.codec, of a text world judge.text_world.codec) or the rate of its"
            " training (tokenizer_fit.lr, text_world_fit.tokenizer.lr), or see whether all pictures are alike"
        )

    def _numbers(self, frames: Tensor) -> Tensor:
        return self.encoder(F.pixel_unshuffle(frames * 2 - 1, FOLD))

    def _pictures(self, signs: Tensor) -> Tensor:
        return F.pixel_shuffle(self.decoder(signs), FOLD).float() * 0.5 + 0.5

    def _use(self, tokens: Tensor) -> dict[str, Tensor]:
        share, perplexity = self.quantiser.use(tokens)
        count = torch.tensor(float(tokens.numel() // self.factors))  # of each factor
        return {"codebook_use": share, "perplexity": perplexity, "codebook_tokens": count}
