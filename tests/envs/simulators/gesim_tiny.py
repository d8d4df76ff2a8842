"""A tiny random checkpoint of the released form, for tests."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from diffusers import AutoencoderKLWan
from safetensors.torch import save_file

from envs.embodiment import Robot
from envs.simulators.dit.network import MultiViewDiT
from envs.simulators.dit.shape import DiTShape
from envs.simulators.dit.state_network import StateDiT
from envs.simulators.gesim.engine import GESimulator
from envs.specs import WorldSpec
from tests.embodiments import BIMANUAL_JOINTS

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

# GE-Sim's robot. What its kinematics are does not matter where pose maps are given.
ROBOT = replace(BIMANUAL_JOINTS, kinematics=Robot("robot.urdf", (("a",) * 7, ("b",) * 7), ("left", "right")))
SPEC = WorldSpec(ROBOT, (32, 48), 5, pose_map=True, ray_map=True)


def build(checkpoint: Path | None, spec: WorldSpec = SPEC, **options: Any) -> GESimulator:
    """A tiny GE-Sim: of a checkpoint, or from nothing."""
    defaults: dict[str, Any] = {
        "parity": "right",
        "sampling": {"kind": "", "steps": 0},
        "training": {"shift": 1.0, "foreground": 0.0, "augment": 0.8, "checkpointing": False},
        "scratch": {"net": NET, "vae": VAE},
    }
    path = None if checkpoint is None else str(checkpoint)
    return GESimulator(spec, 4, path, **(defaults | options)).eval()


def write_checkpoint(folder: Path, expert: bool = True) -> Path:
    """A folder like the released one, or a file with companions like GE-Sim 1; returns the path to load."""
    torch.manual_seed(0)
    folder.mkdir(parents=True, exist_ok=True)
    shape = DiTShape(**NET, pose_expert=expert)
    trunk, states = MultiViewDiT(shape), StateDiT(shape)
    with torch.no_grad():
        for p in (*trunk.parameters(), *states.parameters()):
            p.add_(0.05 * torch.randn_like(p))
    tensors = trunk.state_dict() | states.state_dict() if expert else trunk.state_dict()
    if not expert:
        tensors = {key: value for key, value in tensors.items() if not key.startswith("video_buffer")}
    weights = folder / ("model.safetensors" if expert else "ge_sim_v1.safetensors")
    save_file({key: value.contiguous() for key, value in tensors.items()}, weights)
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
