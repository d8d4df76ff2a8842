"""A tiny random checkpoint of the released form, for tests."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from diffusers import AutoencoderKLWan
from safetensors.torch import save_file

from envs.simulators.dit.network import DiTShape, MultiViewDiT

NET: dict[str, Any] = {
    "num_attention_heads": 2,
    "attention_head_dim": 24,
    "num_layers": 3,
    "text_embed_dim": 8,
    "adaln_lora_dim": 8,
    "pose_num_attention_heads": 2,
    "pose_attention_head_dim": 16,
}
VAE: dict[str, Any] = {
    "base_dim": 8,
    "z_dim": 16,
    "dim_mult": [1, 1, 1, 1],
    "num_res_blocks": 1,
    "temperal_downsample": [False, True, True],
}


def write_checkpoint(folder: Path, expert: bool = True) -> Path:
    """A folder like the released one, or a file with its companions like GE-Sim 1; returns the path to load."""
    torch.manual_seed(0)
    folder.mkdir(parents=True, exist_ok=True)
    net = MultiViewDiT(DiTShape(**NET, pose_expert=expert))
    with torch.no_grad():
        for p in net.parameters():
            p.add_(0.05 * torch.randn_like(p))
    weights = folder / ("model.safetensors" if expert else "ge_sim_v1.safetensors")
    save_file({key: value.contiguous() for key, value in net.state_dict().items()}, weights)
    AutoencoderKLWan(**VAE).save_pretrained(folder / "vae")
    (folder / "scheduler").mkdir(exist_ok=True)
    (folder / "scheduler/scheduler_config.json").write_text(
        json.dumps(
            {
                "_class_name": "FlowMatchEulerDiscreteScheduler",
                "sigma_max": 80.0,
                "sigma_min": 0.002,
                "sigma_data": 1.0,
            }
        )
    )
    torch.save(torch.randn(4, 8), folder / "prompt_embeds.pt")
    if expert:
        stats = {
            kind: {"mean": [0.1 * k for k in range(16)], "std": [1.0 + 0.1 * k for k in range(16)]}
            for kind in ("action", "state")
        }
        (folder / "norm_stats.json").write_text(json.dumps(stats))
    return folder if expert else weights
