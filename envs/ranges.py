"""Types of options with their ranges: what stands at an option's name is what configs are checked against."""

from __future__ import annotations

from typing import Annotated

from annotated_types import Ge, Gt, Le, Lt

Count = Annotated[int, Ge(1), Lt(2**31)]
Natural = Annotated[int, Ge(0), Lt(2**31)]
Seed = Annotated[int, Ge(0), Lt(2**31)]
Positive = Annotated[float, Gt(0)]
NonNegative = Annotated[float, Ge(0)]
Port = Annotated[int, Ge(0), Le(65535)]  # 0 lets the system choose
Share = Annotated[float, Ge(0), Le(1)]
Fraction = Annotated[float, Gt(0), Lt(1)]
Decay = Annotated[float, Ge(0), Lt(1)]  # what is left of something after each step
Discount = Annotated[float, Gt(0), Le(1)]

__all__ = [
    "Count",
    "Decay",
    "Discount",
    "Fraction",
    "Natural",
    "NonNegative",
    "Port",
    "Positive",
    "Seed",
    "Share",
]
