"""The one training loop: every supervised stage is a module, a loss and a FitConfig given to `fit`.

Batches and noise are functions of (seed, step, microbatch), so a run that was killed and resumed has the loss
stream of one that was not, and so have, up to rounding, several workers (parallel.py).
"""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim.swa_utils import get_ema_multi_avg_fn
from tqdm import tqdm

from envs.precision import mixed_precision
from envs.ranges import Count, Decay, Natural, NonNegative, Positive
from envs.simulators.compiling import begin_step, replays
from learners.training.ahead import Batch, BatchesAhead
from learners.training.checkpoint import Checkpoints, buffers_of, truncate_log
from learners.training.interrupt import deferred_signals, leave
from learners.training.optimisers import OPTIMISERS, Optimise, optimiser_state
from learners.training.parallel import (
    Trainee,
    averaged,
    clip_gradients,
    from_leader,
    leads,
    local,
    my_share,
    twin,
)


class TrainingDiverged(RuntimeError):
    """Loss or gradients became NaN or infinite; the last good checkpoint is kept."""


@dataclass(frozen=True)
class FitConfig:
    """Options of the training loop.

    The config says the first three for every stage, and of the others those that are not as they are here.

    Args:
        steps: optimiser steps in all.
        batch: samples per step.
        lr: peak learning rate; warms up over `warmup` steps and falls by a cosine to a twentieth.
        weight_decay: decoupled, of matrices and convolutions only.
        ema: decay of the weights' moving average, 0 for none; the average is what a stage hands on.
        clip: largest gradient norm.
        bf16: run forward passes in bfloat16 where the device computes in it.
        checkpoint_every: steps between checkpoints.
        seed: of batches and noise.
        microbatches: parts a batch is cut into, each with a backward pass of its own, to save memory or to be
            shared out to workers.
        optimiser: a name in optimisers.OPTIMISERS: "adamw" or "muon".
        key: where the config has these options, for messages; "" if it has them nowhere.

    Raises:
        ValueError: if batch is no multiple of microbatches, or the optimiser is unknown.
    """

    steps: Count
    batch: Count
    lr: Positive
    warmup: Natural = 50
    weight_decay: NonNegative = 1e-4
    ema: Decay = 0.995
    clip: Positive = 1.0
    bf16: bool = True
    checkpoint_every: Count = 200
    seed: Natural = 0
    microbatches: Count = 1
    optimiser: str = "adamw"
    key: str = ""

    def __post_init__(self) -> None:
        if self.microbatches < 1 or self.batch % self.microbatches:
            raise ValueError(f"batch={self.batch} must be a multiple of microbatches={self.microbatches}")
        if self.optimiser not in OPTIMISERS:
            raise ValueError(f"optimiser={self.optimiser} must be one of {sorted(OPTIMISERS)}")

    @property
    def part(self) -> int:
        """Samples of a microbatch."""
        return self.batch // self.microbatches


def _rate(config: FitConfig, step: int) -> float:
    if step < config.warmup:
        return config.lr * (step + 1) / config.warmup
    share = (step - config.warmup) / max(1, config.steps - config.warmup)
    return config.lr * (0.05 + 0.95 * 0.5 * (1 + math.cos(math.pi * min(1.0, share))))


def _advice(config: FitConfig) -> str:
    """What may help training that diverges; ++ sets a key whether or not the config's YAML has it."""
    path = f"{config.key}." if config.key else ""
    return f"lower {path}lr{f' or say ++{path}bf16=false' if config.bf16 else ''}"


def fit(
    name: str,
    module: nn.Module | Trainee,
    batch: Batch,
    loss: Callable[[Any, torch.Generator], tuple[Tensor, dict[str, Any]]],
    config: FitConfig,
    folder: Path,
    watch: str = "loss",
    optimise: Optimise | None = None,
    look: Callable[[int], None] | None = None,
) -> dict[str, float]:
    """Train `module` in place and leave it with its averaged weights.

    Args:
        name: shown in the progress bar and used as the metrics' prefix.
        module: what is trained; parameters without gradient are left alone. A Trainee, where it is to be
            gathered otherwise than those are by default.
        batch: (step, generator) -> config.part samples of anything `loss` understands; made ahead in another
            thread unless it is at hand, see ahead.py.
        loss: (batch, generator) -> scalar loss and figures to log.
        folder: receives checkpoints and metrics.jsonl; a checkpoint found there is resumed.
        watch: the figure shown while it runs.
        optimise: makes the optimisers of parts that learn differently; by default config.optimiser moves
            all. A group's `lr_scale` multiplies the learning rate. What a step's loss does not reach stays.
        look: shows what has been learned: called before each checkpoint, by every worker, with the number of
            steps, while the averaged weights are in place. Nothing that it does changes what is learned next.

    Returns:
        data_seconds, spent waiting for batches; compute_seconds, spent on all else; samples_per_second over
        both, of all workers together; and the last smoothed loss.

    Raises:
        TrainingDiverged: on a loss or gradient that is not finite.
        KeyboardInterrupt, SystemExit: after SIGINT and SIGTERM, once a checkpoint is written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    checkpoints, log = Checkpoints(folder), folder / "metrics.jsonl"
    trainee = module if isinstance(module, Trainee) else Trainee(module)
    network, mine, trained = trainee.module, my_share(config.microbatches), trainee.trained
    device = next(network.parameters()).device
    hidden, graphs = getattr(network, "hidden", ()), replays(network)
    optimise = optimise or partial(OPTIMISERS[config.optimiser], hidden=hidden)
    optimisers = optimise(trained, config.lr, config.weight_decay)
    average = twin(trained)
    first, spent = 0, {"data": 0.0, "compute": 0.0}
    smooth: float | None = None

    def state() -> dict[str, Any]:
        return {
            "module": trainee.parameters,
            "buffers": buffers_of(network),
            "average": average,
            "optimiser": optimiser_state(optimisers, trained),
        }

    if checkpoints.newest is not None:
        facts = checkpoints.load(state())
        assert facts is not None
        first, spent, smooth = int(facts["step"]), dict(facts["spent"]), facts["smooth"]
    if leads():
        truncate_log(log, first)
    network.train()
    bar = tqdm(
        total=config.steps,
        initial=first,
        desc=name,
        unit="step",
        mininterval=1.0,
        dynamic_ncols=True,
        disable=not leads(),
    )
    steps = range(first, config.steps)
    with (
        (log if leads() else Path(os.devnull)).open("a") as stream,
        deferred_signals() as stop_requested,
        BatchesAhead(batch, config.seed, steps, mine, device) as batches,
    ):
        for step in steps:
            began, waited = time.perf_counter(), 0.0
            for optimiser in optimisers:
                for group in optimiser.param_groups:
                    group["lr"] = _rate(config, step) * group.get("lr_scale", 1.0)
                optimiser.zero_grad(set_to_none=True)
            if graphs:
                begin_step()
            rows = []
            for _ in mine:
                waiting_since = time.perf_counter()
                data, generator = batches.take()
                waited += time.perf_counter() - waiting_since
                with mixed_precision(device, config.bf16):
                    value, more = trainee(loss, data, generator)
                (value / len(mine)).backward()
                rows.append(
                    {"loss": float(value.detach()), **{key: float(item) for key, item in more.items()}}
                )
            norm, figures = clip_gradients(trained.values(), config.clip), averaged(rows)
            figure = figures.pop("loss")
            if not math.isfinite(norm) or not math.isfinite(figure):
                raise TrainingDiverged(
                    f"{name}: loss {figure:.4g}, gradient norm {norm:.4g} at step {step}; {_advice(config)}"
                )
            for optimiser in optimisers:
                optimiser.step()
            follow(average, trained, min(config.ema, (1 + step) / (10 + step)))
            took = time.perf_counter() - began
            spent["data"] += waited
            spent["compute"] += took - waited
            smooth = figure if smooth is None else 0.98 * smooth + 0.02 * figure
            row = {
                "step": step,
                f"{name}/loss": figure,
                f"{name}/grad_norm": norm,
                f"{name}/lr": _rate(config, step),
            }
            stream.write(json.dumps(row | {f"{name}/{key}": item for key, item in figures.items()}) + "\n")
            bar.update()
            # the first step warms caches up; the next two are the calibration
            if step - first == 2 and leads():
                _announce(name, config.steps - step - 1, took)
            bar.set_postfix_str(f"{watch} {figures.get(watch, smooth):.4g}", refresh=False)
            stop = from_leader(stop_requested)
            due = (step + 1) % config.checkpoint_every == 0 or step + 1 == config.steps
            # before the checkpoint: whoever goes on from there does not look at that step again
            if due and look is not None:
                with averaged_weights(network, trained, average if config.ema else {}):
                    trainee(look, step + 1)
            if stop or due:
                stream.flush()
                checkpoints.save(step + 1, state(), {"step": step + 1, "spent": spent, "smooth": smooth})
            if stop:
                bar.close()
                tqdm.write(
                    f"{name}: stopped after step {step}, as asked; the same command goes on from there"
                )
                leave(stop)
    bar.close()
    if config.ema:
        with torch.no_grad():
            for key, parameter in trained.items():
                parameter.copy_(average[key])
    trainee.release()
    network.eval()
    return {
        **{f"{key}_seconds": value for key, value in spent.items()},
        "samples_per_second": config.steps * config.batch / max(1e-9, sum(spent.values())),
        "loss": smooth if smooth is not None else math.nan,
    }


@contextmanager
def averaged_weights(
    module: nn.Module, trained: Mapping[str, Tensor], average: Mapping[str, Tensor]
) -> Iterator[None]:
    """Within, `module` evaluates with the averages of its trained weights, as it will be handed on, and draws
    random numbers as it likes; after it, all is as before.
    """

    def exchange() -> None:
        with torch.no_grad():
            for key, value in average.items():
                kept = trained[key].clone()
                trained[key].copy_(value)
                value.copy_(kept)

    exchange()
    module.eval()
    try:
        with torch.random.fork_rng(), torch.no_grad():
            yield
    finally:
        module.train()
        exchange()


def follow(average: Mapping[str, Tensor], trained: Mapping[str, Tensor], decay: float) -> None:
    """Move an exponential moving average of weights one step on, in place, by torch's own rule.

    swa_utils.AveragedModel copies the whole module for this; of a module in shards, or of one most of whose
    weights are frozen, only the shards of those that learn are to be held twice, so its rule is used without
    it.
    """
    update = get_ema_multi_avg_fn(decay)
    update([local(value) for value in average.values()], [local(p.detach()) for p in trained.values()], 0)


def _announce(name: str, steps: int, seconds: float) -> None:
    total = steps * seconds
    tqdm.write(f"{name}: about {total / 60:.1f} min for {steps} more steps at {seconds * 1e3:.0f} ms")
