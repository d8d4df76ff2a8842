"""bfloat16 only where the device computes in it."""

from __future__ import annotations

import pytest
import torch

from envs import precision


def test_an_emulated_type_is_never_used(monkeypatch: pytest.MonkeyPatch) -> None:
    x = torch.ones(4, 4)
    for able, wanted in ((True, True), (True, False), (False, True)):
        monkeypatch.setattr(precision, "computes_bf16", lambda device, able=able: able)
        with precision.mixed_precision(x.device, wanted):
            assert (x @ x).dtype == (torch.bfloat16 if able and wanted else torch.float32)
