"""Released checkpoints of GE-Sim: the folder of version 2.0 and the single file of version 1, loaded strictly
by one path.

Folder: model.safetensors (trunk and state expert), prompt_embeds.pt, norm_stats.json, vae/, scheduler/
(diffusers' layout). Version 1 is one .safetensors file; vae/, scheduler/ and prompt_embeds.pt are looked for
beside it.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from envs.simulators.dit.network import MultiViewDiT
from envs.simulators.dit.shape import DiTShape
from envs.simulators.dit.state_network import StateDiT
from envs.simulators.gesim.fixture import shape_of
from envs.simulators.samplers import EDM
from envs.simulators.tokenizers.wan import WanCodec

JOINTS = 16  # of the released robot's actions and states
_MIX = ("video_buffer_weights", "video_buffer_norm.weight", "video_buffer_norm.bias")


class CheckpointError(ValueError):
    """A checkpoint is incomplete, damaged or of another network; the message lists what is wrong."""


@dataclass
class Released:
    """What a checkpoint holds of the video world.

    Args:
        net: trunk; float32, or as stored if `dtype` was given.
        codec, prompt: autoencoder, and prompt embedding [1, L, D].
        edm: the undistilled sampler's numbers.
        distilled: whether the four-step sampler is meant.
    """

    net: MultiViewDiT
    codec: WanCodec
    prompt: Tensor
    edm: EDM
    distilled: bool


def load_released(path: Path, dtype: torch.dtype = torch.float32) -> Released:
    """Load the video world of a checkpoint folder of GE-Sim 2.0 or a file of GE-Sim 1.

    Raises:
        CheckpointError: if parts are missing or do not fit.
    """
    folder, weights = _locate(path)
    parts = {name: folder / name for name in ("prompt_embeds.pt", "vae", "scheduler/scheduler_config.json")}
    if path.is_dir():
        parts["norm_stats.json"] = folder / "norm_stats.json"
    missing = [str(part) for part in (weights, *parts.values()) if not part.exists()]
    if missing:
        raise CheckpointError(
            f"simulator.checkpoint={path}: {missing} are missing; a checkpoint is a folder with"
            " model.safetensors, prompt_embeds.pt, norm_stats.json, vae/ and scheduler/"
        )
    shape, tensors = _read(weights, dtype)
    with torch.device("meta"):
        net = MultiViewDiT(shape)
    defaults = {name: value for name, value in _default_mix(shape).items() if name not in tensors}
    net.load_state_dict({name: (tensors | defaults)[name] for name in net.state_dict()}, assign=True)
    try:
        codec = WanCodec.load(parts["vae"])
    except (OSError, ValueError, KeyError) as error:
        raise CheckpointError(f"{parts['vae']}: {error}") from error
    if codec.channels != net.shape.out_channels:
        raise CheckpointError(
            f"{parts['vae']} has {codec.channels} latent channels, {weights} makes {net.shape.out_channels}"
        )
    prompt = _prompt(parts["prompt_embeds.pt"], net.shape.text_embed_dim)
    edm = _edm(parts["scheduler/scheduler_config.json"])
    return Released(net.eval(), codec, prompt, edm, distilled=shape.pose_expert)


def load_state_network(path: Path) -> tuple[StateDiT, dict[str, Tensor]] | None:
    """The state expert of a checkpoint, and the units "action" and "state", each mean and spread [2, 16];
    None of GE-Sim 1, which has none.

    Raises:
        CheckpointError: if parts are missing or do not fit.
    """
    folder, weights = _locate(path)
    shape, tensors = _read(weights, torch.float32)
    if not shape.pose_expert:
        return None
    net = StateDiT(shape)
    net.load_state_dict({name: tensors[name] for name in net.state_dict()})
    return net.eval(), _stats(folder / "norm_stats.json")


def _locate(path: Path) -> tuple[Path, Path]:
    """The checkpoint's folder and its file of weights."""
    return (path, path / "model.safetensors") if path.is_dir() else (path.parent, path)


def _default_mix(shape: DiTShape) -> dict[str, Tensor]:
    """The mix of features of a network whose file has no state expert."""
    values = (torch.ones(shape.num_layers), torch.ones(shape.width), torch.zeros(shape.width))
    return dict(zip(_MIX, values, strict=True))


def _read(path: Path, dtype: torch.dtype) -> tuple[DiTShape, dict[str, Tensor]]:
    """Sizes and all weights of a file, strictly those of trunk and state expert."""
    try:
        with safe_open(str(path), "pt") as file:
            meta = file.metadata() or {}
            shapes = {key: tuple(file.get_slice(key).get_shape()) for key in file.keys()}
            shape = sizes_of(shapes, meta, path)
            wanted = _wanted(shape)
            absent, extra = sorted(wanted.keys() - shapes.keys()), sorted(shapes.keys() - wanted.keys())
            other = [
                f"{key}: file {shapes[key]}, network {wanted[key]}"
                for key in sorted(wanted.keys() & shapes.keys())
                if wanted[key] != shapes[key]
            ]
            if absent or extra or other:
                raise CheckpointError(
                    f"{path} is not this network. Missing: {_listed(absent)}. Unexpected: {_listed(extra)}."
                    f" Of other shapes: {_listed(other)}."
                )
            return shape, {key: file.get_tensor(key).to(dtype) for key in wanted}
    except (OSError, SafetensorError) as error:
        raise CheckpointError(f"{path} cannot be read: {error}") from error


def _wanted(shape: DiTShape) -> dict[str, tuple[int, ...]]:
    """Names and shapes of all weights of a released file."""
    with torch.device("meta"):
        parts = [MultiViewDiT(shape), *([StateDiT(shape)] if shape.pose_expert else [])]
    wanted = {key: tuple(value.shape) for part in parts for key, value in part.state_dict().items()}
    return {key: size for key, size in wanted.items() if shape.pose_expert or key not in _MIX}


def _listed(names: list[str], most: int = 40) -> str:
    return (
        "none"
        if not names
        else ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")
    )


def sizes_of(shapes: Mapping[str, tuple[int, ...]], meta: Mapping[str, str], path: Path) -> DiTShape:
    """Sizes of a network from the configuration in its file's metadata or, where there is none, from its
    tensors' shapes.

    Raises:
        CheckpointError: if tensors are missing without which no size can be told.
    """
    needed = (
        "patch_embed.proj.weight",
        "view_embed",
        "transformer_blocks.0.attn1.norm_q.weight",
        "transformer_blocks.0.attn2.to_k.weight",
        "transformer_blocks.0.norm1.linear_1.weight",
        "transformer_blocks.0.ff.net.0.proj.weight",
        "proj_out.weight",
    )
    expert = "pose_proj_in.weight" in shapes
    absent = [name for name in needed if name not in shapes]
    if absent:
        raise CheckpointError(f"{path} is not this network. Missing: {_listed(absent)}.")
    if "config" in meta:
        return shape_of(json.loads(meta["config"]), shapes["view_embed"][0])
    width, head = shapes["proj_out.weight"][1], shapes["transformer_blocks.0.attn1.norm_q.weight"][0]
    patch = (1, 2, 2)
    layers = 1 + max(int(key.split(".")[1]) for key in shapes if key.startswith("transformer_blocks."))
    sizes: dict[str, Any] = {
        "in_channels": shapes["patch_embed.proj.weight"][1] // math.prod(patch) - 1,
        "out_channels": shapes["proj_out.weight"][0] // math.prod(patch),
        "num_attention_heads": width // head,
        "attention_head_dim": head,
        "num_layers": layers,
        "mlp_ratio": shapes["transformer_blocks.0.ff.net.0.proj.weight"][0] / width,
        "text_embed_dim": shapes["transformer_blocks.0.attn2.to_k.weight"][1],
        "adaln_lora_dim": shapes["transformer_blocks.0.norm1.linear_1.weight"][0],
        "views": shapes["view_embed"][0],
        "pose_expert": expert,
    }
    if expert:
        pose, per_head = (
            shapes["pose_proj_in.weight"],
            shapes.get("pose_blocks.0.attn1.norm_q.weight", (32,))[0],
        )
        sizes |= {
            "pose_in_channels": pose[1],
            "pose_num_attention_heads": pose[0] // per_head,
            "pose_attention_head_dim": per_head,
        }
    return DiTShape(patch_size=patch, **sizes)


def _prompt(path: Path, width: int) -> Tensor:
    try:
        prompt = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch.load raises pickle, runtime and OS errors alike
        raise CheckpointError(f"{path} cannot be read as tensors alone: {error}") from error
    if not isinstance(prompt, Tensor) or prompt.ndim not in (2, 3) or prompt.shape[-1] != width:
        raise CheckpointError(
            f"{path} must hold one tensor [L, {width}] or [N, L, {width}],"
            f" got {tuple(getattr(prompt, 'shape', ()))}"
        )
    return (prompt if prompt.ndim == 3 else prompt[None])[:1].float()


def _stats(path: Path) -> dict[str, Tensor]:
    try:
        raw = json.loads(path.read_text())
        stats = {
            kind: torch.tensor([raw[kind]["mean"], raw[kind]["std"]], dtype=torch.float32)
            for kind in ("action", "state")
        }
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CheckpointError(
            f"{path} must hold action and state, each with mean and std: {error!r}"
        ) from error
    for kind, values in stats.items():
        if values.shape != (2, JOINTS) or not torch.isfinite(values).all() or not (values[1] > 0).all():
            raise CheckpointError(
                f"{path}: {kind} must have {JOINTS} finite means and positive spreads,"
                f" got {tuple(values.shape)}"
            )
    return stats


def _edm(path: Path) -> EDM:
    try:
        raw = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise CheckpointError(f"{path}: {error}") from error
    if raw.get("sigma_data", 1.0) != 1.0:
        raise CheckpointError(f"{path}: sigma_data={raw['sigma_data']}, only 1.0 is known")
    return EDM(15, float(raw.get("sigma_max", 80.0)), float(raw.get("sigma_min", 0.002)))
