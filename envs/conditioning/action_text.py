"""Actions as text: their digits in words, through a frozen embedding. The other side of WPE's comparison."""

from __future__ import annotations

from torch import Tensor, nn

from envs.embodiment import Embodiment
from envs.encoders.language import FEATURES, TextEncoder
from envs.ranges import Natural
from envs.specs import TEXT_BYTES, text_to_bytes


class ActionText(nn.Module):
    """Commands as fixed features of the text that says them, such as "minus 3 7 plus 1 2".

    The embedding is that of envs/encoders/language.py: hashed n-grams of words and their order, without a
    vocabulary, a language model or anything that learns. In place of ActionVector, whose contract this has.

    Args:
        embodiment: whose actions.
        decimals: digits after the point, to which commands are rounded, in their own units.

    Attributes:
        size: numbers per frame that `forward` gives.
    """

    def __init__(self, embodiment: Embodiment, decimals: Natural):
        super().__init__()
        self.decimals, self.size = decimals, FEATURES
        self.encoder = TextEncoder(1).requires_grad_(False)  # of which only fixed features are read

    def normalise(self, commands: Tensor, moves: Tensor) -> None:
        """Text has no units to take."""

    def forward(self, commands: Tensor, now: Tensor) -> Tensor:
        """float32 [..., K, size] of commands [..., K, A]; the command in force [..., A] is not told.

        Raises:
            ValueError: if a command takes more text than is read.
        """
        said = [self.describe(row) for row in commands.flatten(0, -2).cpu().tolist()]
        longest = max(map(len, said), default=0)
        if longest > TEXT_BYTES:
            raise ValueError(
                f"{commands.shape[-1]} numbers with {self.decimals} decimals take {longest} letters, and"
                f" {TEXT_BYTES} are read; lower simulator.actions.decimals, or take ActionVector instead"
            )
        text = text_to_bytes(said)
        features = self.encoder.features(text.to(commands.device))
        return features.float().reshape(*commands.shape[:-1], -1)

    def describe(self, numbers: list[float]) -> str:
        """Signs, digits and points as words of their own, number by number."""
        words = []
        for number in numbers:
            digits = f"{abs(number):.{self.decimals}f}"
            words += ["minus" if number < 0 else "plus", *("point" if c == "." else c for c in digits)]
        return " ".join(words)
