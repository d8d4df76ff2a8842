"""The one training loop: every supervised stage is a module, a loss and a FitConfig given to `fit`.

Batches and noise are functions of (seed, step), so a run that was killed and resumed has the loss stream of one that
was not. The checkpoint holds weights, their moving average and the optimiser, and replaces its predecessor by rename.
"""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from tqdm import tqdm

from envs.precision import mixed_precision

Loss = Callable[[int, torch.Generator], tuple[Tensor, dict[str, Any]]]
Batch = Callable[[int, torch.Generator], Any]


class TrainingDiverged(RuntimeError):
    """Loss or gradients became NaN or infinite; the last good checkpoint is kept."""


@dataclass(frozen=True)
class FitConfig:
    """Options of the training loop.

    Args:
        steps: optimiser steps in all.
        batch: samples per step.
        lr: peak learning rate; warms up over `warmup` steps and falls by a cosine to a twentieth.
        weight_decay: of AdamW, on matrices only.
        ema: decay of the weights' moving average, 0 for none; the average is what a stage hands on.
        clip: largest gradient norm.
        bf16: run forward passes in bfloat16 where the device computes in it.
        checkpoint_every: steps between checkpoints.
        seed: of batches and noise.
    """

    steps: int
    batch: int = 32
    lr: float = 1e-3
    warmup: int = 50
    weight_decay: float = 1e-4
    ema: float = 0.995
    clip: float = 1.0
    bf16: bool = True
    checkpoint_every: int = 200
    seed: int = 0


def step_generator(seed: int, step: int) -> torch.Generator:
    """The generator of one step; equal seeds and steps give equal numbers wherever and whenever."""
    return torch.Generator().manual_seed((seed * 1_000_003 + step) & 0x7FFF_FFFF_FFFF)


def _rate(config: FitConfig, step: int) -> float:
    if step < config.warmup:
        return config.lr * (step + 1) / config.warmup
    share = (step - config.warmup) / max(1, config.steps - config.warmup)
    return config.lr * (0.05 + 0.95 * 0.5 * (1 + math.cos(math.pi * min(1.0, share))))


def save_atomic(value: Any, path: Path) -> None:
    """torch.save through a neighbour and a rename; a full disk leaves the old file as it was."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.part")
    try:
        torch.save(value, temporary)
    except (OSError, RuntimeError) as error:
        temporary.unlink(missing_ok=True)
        raise OSError(f"cannot write {path}: {error}; free disk space and start again, finished work is kept") from error
    os.replace(temporary, path)


def fit(
    name: str,
    module: nn.Module,
    batch: Batch,
    loss: Callable[[Any, torch.Generator], tuple[Tensor, dict[str, Any]]],
    config: FitConfig,
    folder: Path,
    watch: str = "loss",
) -> dict[str, float]:
    """Train `module` in place and leave it with its averaged weights.

    Args:
        name: shown in the progress bar and used as the metrics' prefix.
        module: what is trained; parameters without gradient are left alone.
        batch: (step, generator) -> anything `loss` understands.
        loss: (batch, generator) -> scalar loss and figures to log.
        folder: receives checkpoint.pt and metrics.jsonl; a checkpoint found there is resumed.
        watch: the figure shown while it runs.

    Returns:
        Seconds spent: total, data, compute; and the last smoothed loss.

    Raises:
        TrainingDiverged: on a loss or gradient that is not finite.
    """
    folder.mkdir(parents=True, exist_ok=True)
    checkpoint, log = folder / "checkpoint.pt", folder / "metrics.jsonl"
    device = next(module.parameters()).device
    trained = [p for p in module.parameters() if p.requires_grad]
    groups = [
        {"params": [p for p in trained if p.ndim >= 2], "weight_decay": config.weight_decay},
        {"params": [p for p in trained if p.ndim < 2], "weight_decay": 0.0},
    ]
    optimiser = torch.optim.AdamW(groups, lr=config.lr, betas=(0.9, 0.99), fused=device.type == "cuda")
    average = [p.detach().clone() for p in trained]
    first, spent = 0, {"data": 0.0, "compute": 0.0}
    if checkpoint.exists():
        saved = torch.load(checkpoint, weights_only=True, map_location=device)
        try:
            module.load_state_dict(saved["module"])
        except RuntimeError as error:
            raise RuntimeError(f"{checkpoint} belongs to another architecture: {error}. Remove the folder or restore the config.") from error
        optimiser.load_state_dict(saved["optimiser"])
        average = [value.to(device) for value in saved["average"]]
        first, spent = int(saved["step"]), dict(saved["spent"])
        _truncate(log, first)
    module.train()
    bar = tqdm(total=config.steps, initial=first, desc=name, unit="step", mininterval=1.0, dynamic_ncols=True)
    smooth: float | None = None
    with log.open("a") as stream:
        for step in range(first, config.steps):
            generator = step_generator(config.seed, step)
            began = time.perf_counter()
            data = batch(step, generator)
            if hasattr(data, "to"):
                data = data.to(device)
            loaded = time.perf_counter()
            for group in optimiser.param_groups:
                group["lr"] = _rate(config, step)
            with mixed_precision(device, config.bf16):
                value, figures = loss(data, generator)
            optimiser.zero_grad(set_to_none=True)
            value.backward()
            norm = nn.utils.clip_grad_norm_(trained, config.clip)
            if not math.isfinite(float(norm)) or not math.isfinite(float(value.detach())):
                raise TrainingDiverged(f"{name}: loss {float(value):.4g}, gradient norm {float(norm):.4g} at step {step}; lower {name}.lr or switch {name}.bf16 off")
            optimiser.step()
            decay = min(config.ema, (1 + step) / (10 + step))
            torch._foreach_lerp_(average, [p.detach() for p in trained], 1.0 - decay)
            done = time.perf_counter()
            spent["data"] += loaded - began
            spent["compute"] += done - loaded
            figure = float(value.detach())
            smooth = figure if smooth is None else 0.98 * smooth + 0.02 * figure
            row = {"step": step, f"{name}/loss": figure, f"{name}/grad_norm": float(norm), f"{name}/lr": optimiser.param_groups[0]["lr"]}
            row |= {f"{name}/{key}": float(item) for key, item in figures.items()}
            stream.write(json.dumps(row) + "\n")
            bar.update()
            if step - first == 2:  # the first step warms caches up; the next two are the calibration
                _announce(name, config.steps - step - 1, (done - began))
            bar.set_postfix_str(f"{watch} {smooth:.4g}" if watch == "loss" else f"{watch} {float(figures.get(watch, smooth)):.4g}", refresh=False)
            if (step + 1) % config.checkpoint_every == 0 and step + 1 < config.steps:
                stream.flush()
                save_atomic({"module": module.state_dict(), "optimiser": optimiser.state_dict(), "average": average, "step": step + 1, "spent": spent}, checkpoint)
    bar.close()
    if config.ema:
        with torch.no_grad():
            for parameter, value in zip(trained, average, strict=True):
                parameter.copy_(value)
    module.eval()
    checkpoint.unlink(missing_ok=True)
    return {**{f"{key}_seconds": value for key, value in spent.items()}, "loss": smooth if smooth is not None else math.nan}


def _announce(name: str, steps: int, seconds: float) -> None:
    total = steps * seconds
    tqdm.write(f"{name}: about {total / 60:.1f} min for {steps} more steps at {seconds * 1e3:.0f} ms")


def _truncate(log: Path, step: int) -> None:
    """Drop log rows of steps that will be run again, and the half-written one that a killed process leaves."""
    if log.exists():
        lines = log.read_text()
        rows = [line for line in lines[: lines.rfind("\n") + 1].splitlines() if json.loads(line)["step"] < step]
        log.write_text("".join(row + "\n" for row in rows))
