"""Types that several sections share."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from annotated_types import Ge, MinLen, MultipleOf

Side = Annotated[int, Ge(16), MultipleOf(16)]
Name = Annotated[str, MinLen(1)]
Fit = Mapping[str, Any]  # learners.training.fit.FitConfig; checked by itself
Choice = Mapping[str, Any]  # `_target_` and its options; checked by itself
