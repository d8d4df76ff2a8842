"""Where bfloat16 is used: on devices that compute in it. Others only emulate it, hundreds of times slower
than float32.
"""

from __future__ import annotations

import torch


def computes_bf16(device: torch.device) -> bool:
    """Whether a device has instructions for bfloat16 (AVX-512 BF16 or AMX on a CPU, Ampere and later on a
    GPU).
    """
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    return bool(torch.cpu._is_avx512_bf16_supported() or torch.cpu._is_amx_tile_supported())


def working_dtype(device: torch.device, otherwise: torch.dtype) -> torch.dtype:
    """What matrices are multiplied in on a device: autocast's type within it, or `otherwise`."""
    if not torch.amp.is_autocast_available(device.type) or not torch.is_autocast_enabled(device.type):
        return otherwise
    return torch.get_autocast_dtype(device.type)


def mixed_precision(device: torch.device, wanted: bool) -> torch.autocast:
    """Autocast to bfloat16 where it is wanted and the device computes in it, else a context that changes
    nothing.
    """
    return torch.autocast(device.type, torch.bfloat16, enabled=wanted and computes_bf16(device))
