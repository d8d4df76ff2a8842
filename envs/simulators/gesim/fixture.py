"""Fixtures of the public GE-Sim 2.0 network: weights, inputs and outputs in one safetensors file, and how far
ours is off.

Keys are weights.*, in.{hidden_states, timestep, text, pose_states, pose_timestep, pose_mask} and out.{video,
fused_feature, pose}; the metadata hold the configuration, the number of views and the frame rate.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn

from envs.simulators.dit.network import MultiViewDiT
from envs.simulators.dit.shape import DiTShape
from envs.simulators.dit.state_network import StateDiT

# What the public configuration may say besides sizes, and the only values that this network knows.
_FIXED = {"extra_pos_embed_type": None, "use_view_embed": True}


class FixtureError(ValueError):
    """A fixture that is damaged, or of a network that this is not; the message says which part."""


def shape_of(config: Mapping[str, Any], views: int) -> DiTShape:
    """Sizes of a public configuration.

    Raises:
        FixtureError: naming the options that are unknown or have values this network does not know.
    """
    known = {field.name for field in fields(DiTShape)} - {"views"}
    wrong = {
        key: value for key, value in config.items() if key not in known and _FIXED.get(key, _FIXED) != value
    }
    if wrong:
        raise FixtureError(f"configuration has {wrong}, which this network does not know")
    sizes: dict[str, Any] = {
        key: tuple(value) if isinstance(value, list) else value
        for key, value in config.items()
        if key in known
    }
    return DiTShape(**sizes, views=views)


@torch.no_grad()
def verify(path: Path) -> dict[str, float]:
    """Largest absolute errors in float32 of "video", "fused_feature" and "pose", the latter on our own fused
    feature.

    Raises:
        FixtureError: if the file is damaged, or weights are missing, unexpected or of other shapes.
    """
    try:
        with safe_open(str(path), "pt") as file:
            meta = file.metadata() or {}
            tensors = {key: file.get_tensor(key) for key in file.keys()}
    except (OSError, SafetensorError) as error:
        raise FixtureError(f"{path} cannot be read: {error}") from error
    missing = [key for key in ("config", "n_view", "fps") if key not in meta]
    missing += [
        key
        for key in (
            "in.hidden_states",
            "in.timestep",
            "in.text",
            "in.pose_states",
            "in.pose_timestep",
            "out.video",
            "out.fused_feature",
            "out.pose",
            "weights.view_embed",
        )
        if key not in tensors
    ]
    if missing:
        raise FixtureError(f"{path} lacks {missing}")
    weights = {
        key.removeprefix("weights."): value.float()
        for key, value in tensors.items()
        if key.startswith("weights.")
    }
    shape, views = shape_of(json.loads(meta["config"]), len(weights["view_embed"])), int(meta["n_view"])
    trunk, expert = MultiViewDiT(shape).eval(), StateDiT(shape).eval()
    _load((trunk, expert), weights, path)
    video, fused = trunk(
        tensors["in.hidden_states"], tensors["in.timestep"], tensors["in.text"], float(meta["fps"])
    )
    keys = expert.feature_keys(fused.unflatten(0, (-1, views)))
    pose = expert(tensors["in.pose_states"], tensors["in.pose_timestep"], keys, tensors.get("in.pose_mask"))
    return {
        name: float((ours - tensors[f"out.{name}"]).abs().max())
        for name, ours in (("video", video), ("fused_feature", fused), ("pose", pose))
    }


def _load(parts: Sequence[nn.Module], weights: dict[str, Tensor], path: Path) -> None:
    """Load networks that share one file, strictly."""
    unknown = weights.keys() - {name for part in parts for name in part.state_dict()}
    try:
        if unknown:
            raise RuntimeError(f"unexpected {sorted(unknown)}")
        for part in parts:
            names = part.state_dict().keys()
            part.load_state_dict({name: value for name, value in weights.items() if name in names})
    except RuntimeError as error:
        raise FixtureError(f"{path} holds weights of another network: {error}") from error
