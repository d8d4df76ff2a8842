"""The reinforcement-learning loop: collect whole episodes, let an algorithm turn them into updates, watch for trouble.

Where a policy is updated: `update` below, by the losses of ppo.py, grpo.py and filtered_bc.py. The world is any
TorchRL environment of this project, imagined or true. Every iteration starts fresh episodes and draws its
randomness from (seed, iteration), so a run resumed from its checkpoint repeats what it would have done.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import torch
from tensordict import NestedKey, TensorDict
from torch import Tensor, nn
from torchrl.collectors import Collector
from torchrl.envs import EnvBase
from tqdm import tqdm

from actors.policies.vla import ChunkPolicy
from envs.schema import CHUNK, JUDGE_STATUS, LOG_PROB, SUCCESS, Status
from learners.fit import TrainingDiverged, _truncate, save_atomic


@dataclass(frozen=True)
class RLConfig:
    """Options of the loop, shared by all algorithms.

    Args:
        iterations: rounds of collecting and updating.
        envs: episodes side by side, and so the least number of episodes per iteration.
        epochs: passes over each iteration's data.
        minibatch: transitions per update.
        lr: learning rate of the policy.
        clip: largest gradient norm.
        kl_stop: mean KL to the behaviour policy at which an iteration's epochs end early.
        anchor: weight of cloning what is known to have worked in physics (demonstrations and the policy's own true
            successes) beside the algorithm's loss; it keeps RL from wandering where only the simulator says it works.
        anchor_batch: frames of that per update.
        freeze_perception: train only what follows the policy's encoder, so that no picture is encoded twice.
        checkpoint_every: iterations between checkpoints.
        seed: of start frames, exploration and minibatches.
    """

    iterations: int = 40
    envs: int = 128
    epochs: int = 3
    minibatch: int = 256
    lr: float = 2e-4
    clip: float = 1.0
    kl_stop: float = 0.15
    anchor: float = 0.0
    anchor_batch: int = 96
    freeze_perception: bool = False
    checkpoint_every: int = 5
    seed: int = 0


class Algorithm(Protocol):
    """What tells algorithms apart; one file each."""

    name: str

    def seeds(self, starts: int, envs: int, generator: torch.Generator) -> list[int]:
        """Episode seeds of one iteration, more than `envs` where early endings should be refilled."""
        ...

    def prepare(self, batch: TensorDict) -> tuple[TensorDict, dict[str, float]]:
        """Turn a rollout [B, T] into a flat set of transitions with everything `loss` needs."""
        ...

    def loss(self, minibatch: TensorDict) -> tuple[Tensor, dict[str, float]]:
        """Scalar loss of some transitions and figures to log."""
        ...

    def modules(self) -> nn.Module:
        """All that is trained, the policy included."""
        ...

    def groups(self, lr: float) -> list[dict[str, Any]]:
        """Parameter groups for the optimiser; `lr` is the policy's."""
        ...


class Anchor(Protocol):
    """Something with batches and a loss that is added to the algorithm's."""

    def sample(self, count: int, generator: torch.Generator) -> TensorDict:
        """A batch."""
        ...

    def loss(self, data: TensorDict, generator: torch.Generator) -> Tensor:
        """Its scalar loss."""
        ...


@dataclass
class Alarms:
    """Watches an RL run for the ways it goes wrong quietly.

    Args:
        patience: iterations in a row without reward variance before the alarm.
        kl: KL per iteration that counts as exploding.
        entropy_drop: fall of entropy (nats) from the first iteration that counts as collapse.
    """

    patience: int = 3
    kl: float = 0.5
    entropy_drop: float = 12.0
    silent: int = 0
    entropy: float | None = None
    raised: list[str] = field(default_factory=list)

    def check(self, figures: dict[str, float], iteration: int) -> None:
        """Look at one iteration's figures; warns once per kind, stops the run on numbers that are not finite."""
        bad = [key for key, value in figures.items() if not math.isfinite(value)]
        if bad:
            raise TrainingDiverged(f"rl: {bad} not finite at iteration {iteration}; lower rl.lr or raise algorithm clipping; the last checkpoint is kept")
        self.silent = self.silent + 1 if figures["reward_std"] < 1e-6 else 0
        if self.silent == self.patience:
            self._warn("no reward variance", iteration, "every episode scores the same; check the judge, or start from a policy that succeeds sometimes")
        if figures.get("kl", 0.0) > self.kl:
            self._warn("exploding KL", iteration, f"KL {figures['kl']:.3g} in one iteration; lower rl.lr or rl.epochs")
        if "entropy" in figures:
            self.entropy = figures["entropy"] if self.entropy is None else self.entropy
            if self.entropy - figures["entropy"] > self.entropy_drop:
                self._warn("collapsed entropy", iteration, "exploration is gone; raise algorithm.entropy or policy.std")

    def _warn(self, kind: str, iteration: int, advice: str) -> None:
        if kind not in [text.split(" at ")[0] for text in self.raised]:
            self.raised.append(f"{kind} at iteration {iteration}: {advice}")
            tqdm.write(f"ALARM rl: {self.raised[-1]}")


def first_episode(done: Tensor) -> Tensor:
    """Which steps [B, T] belong to the first episode of their slot, from done flags [B, T]."""
    before = torch.cat([torch.zeros_like(done[:, :1]), done[:, :-1]], 1)
    return before.long().cumsum(1) == 0


def judged(batch: TensorDict) -> Tensor:
    """Which steps [B, T] belong to episodes that no judge's error or abstention has spoiled."""
    if JUDGE_STATUS not in batch["next"].keys(True, True):
        return torch.ones(batch.shape, dtype=torch.bool, device=batch.device)
    bad = batch["next", JUDGE_STATUS].squeeze(-1) != Status.OK.value
    done = batch["next", "done"].squeeze(-1)
    spoiled = torch.zeros_like(bad)
    poison = torch.zeros_like(bad[:, 0])
    for t in reversed(range(batch.shape[1])):  # a bad verdict ends its episode, so it spoils what came before it
        poison = torch.where(done[:, t], bad[:, t], poison)
        spoiled[:, t] = poison
    return ~spoiled


def train_rl(
    env: EnvBase,
    policy: ChunkPolicy,
    algorithm: Algorithm,
    config: RLConfig,
    folder: Path,
    starts: int | None = None,
    name: str = "rl",
    seed_pool: Sequence[int] | None = None,
    anchor: Anchor | None = None,
) -> dict[str, Any]:
    """Improve `policy` in place.

    Args:
        env: batch of `config.envs` episodes; its base takes `schedule`.
        starts: number of start frames in imagination; None in physics, where `seed_pool` says which seeds may be used.
        folder: receives checkpoint.pt and metrics.jsonl; a checkpoint found there is resumed.
        anchor: what RLConfig.anchor speaks of.

    Returns:
        Seconds spent, episodes used, alarms, and the metrics of the last iteration.
    """
    folder.mkdir(parents=True, exist_ok=True)
    checkpoint, log = folder / "checkpoint.pt", folder / "metrics.jsonl"
    base = getattr(env, "base_env", env)
    trained = algorithm.modules()
    optimiser = torch.optim.Adam(algorithm.groups(config.lr), lr=config.lr, eps=1e-5)
    alarms, first, episodes = Alarms(), 0, 0
    spent = {"rollout": 0.0, "update": 0.0}
    if checkpoint.exists():
        saved = torch.load(checkpoint, weights_only=True)
        trained.load_state_dict(saved["modules"])
        optimiser.load_state_dict(saved["optimiser"])
        first, episodes, spent = saved["iteration"], saved["episodes"], saved["spent"]
        alarms.entropy, alarms.silent, alarms.raised = saved["entropy"], saved["silent"], saved["raised"]
        _truncate(log, first)
    steps = base.horizon // base.chunk
    queued: list[int] = []
    per_batch = config.envs * steps
    collector = Collector(
        env,
        policy,
        frames_per_batch=per_batch,
        total_frames=per_batch * max(1, config.iterations - first),
        reset_at_each_iter=True,
        # Right before the reset: the collector also resets when it is set up, and would use up the first seeds.
        pre_collect_hook=lambda: base.schedule(queued),
        auto_register_policy_transforms=False,
    )
    bar = tqdm(total=config.iterations, initial=first, desc=name, unit="it", dynamic_ncols=True)
    figures: dict[str, float] = {}
    stream = iter(collector)
    with log.open("a") as rows:
        for iteration in range(first, config.iterations):
            generator = torch.Generator().manual_seed(config.seed * 1_000_003 + iteration)
            torch.manual_seed(config.seed * 7_919 + iteration)
            pool = starts or len(seed_pool or ())
            seeds = algorithm.seeds(pool, config.envs, generator)
            queued[:] = seeds if seed_pool is None else [seed_pool[s % pool] for s in seeds]
            began = time.perf_counter()
            batch = next(stream)
            collected = time.perf_counter()
            figures = update(batch, algorithm, optimiser, config, generator, anchor)
            updated = time.perf_counter()
            spent["rollout"] += collected - began
            spent["update"] += updated - collected
            started = batch["next", "done"].sum().item() + (~batch["next", "done"][:, -1]).sum().item()
            episodes += int(started)
            figures |= {"rollout_seconds": collected - began, "update_seconds": updated - collected}
            alarms.check(figures, iteration)
            rows.write(json.dumps({"step": iteration, **{f"{name}/{k}": v for k, v in figures.items()}}) + "\n")
            rows.flush()
            bar.update()
            bar.set_postfix_str(f"success {figures['success']:.2f}", refresh=False)
            if iteration == first:
                tqdm.write(f"{name}: about {(updated - began) * (config.iterations - first - 1) / 60:.1f} min for {config.iterations - first - 1} more iterations")
            if (iteration + 1) % config.checkpoint_every == 0:
                save_atomic(
                    {
                        "modules": trained.state_dict(),
                        "optimiser": optimiser.state_dict(),
                        "iteration": iteration + 1,
                        "episodes": episodes,
                        "spent": spent,
                        "entropy": alarms.entropy,
                        "silent": alarms.silent,
                        "raised": alarms.raised,
                    },
                    checkpoint,
                )
    bar.close()
    collector.shutdown(close_env=False)
    checkpoint.unlink(missing_ok=True)
    return {**{f"{k}_seconds": v for k, v in spent.items()}, "episodes": episodes, "alarms": alarms.raised, "last": figures}


def update(
    batch: TensorDict, algorithm: Algorithm, optimiser: torch.optim.Optimizer, config: RLConfig, generator: torch.Generator, anchor: Anchor | None = None
) -> dict[str, float]:
    """One iteration's optimisation on a rollout [B, T]; returns its figures."""
    done, success = batch["next", "done"].squeeze(-1), batch["next", SUCCESS].squeeze(-1)
    mine, fine = first_episode(done), judged(batch)
    reward = (batch["next", "reward"].squeeze(-1) * mine).sum(1)
    kept = fine[:, 0]
    figures = {
        "success": float((success & mine).any(1)[kept].float().mean()) if kept.any() else 0.0,
        "return": float(reward[kept].mean()) if kept.any() else 0.0,
        "reward_std": float(reward[kept].std(unbiased=False)) if kept.any() else 0.0,
        "dropped_by_judge": float((~kept).sum()),
    }
    data, extra = algorithm.prepare(batch)
    figures |= extra
    trained = [p for group in optimiser.param_groups for p in group["params"]]
    sums: dict[str, float] = {}
    count, stopped = 0, False
    for _ in range(config.epochs):
        order = torch.randperm(len(data), generator=generator)
        for pick in order.split(config.minibatch):
            if len(pick) < 16 and len(data) >= 16:
                continue
            loss, parts = algorithm.loss(data[pick])
            if parts.get("kl", 0.0) > config.kl_stop:
                stopped = True
                break
            if anchor is not None and config.anchor:
                pull = anchor.loss(anchor.sample(config.anchor_batch, generator), generator)
                loss = loss + config.anchor * pull
                parts["anchor"] = float(pull.detach())
            optimiser.zero_grad(set_to_none=True)
            loss.backward()
            norm = nn.utils.clip_grad_norm_(trained, config.clip)
            if not torch.isfinite(norm):
                raise TrainingDiverged(f"rl: gradient norm {float(norm)}; lower rl.lr; the last checkpoint is kept")
            optimiser.step()
            for key, value in {**parts, "grad_norm": float(norm), "loss": float(loss.detach())}.items():
                sums[key] = sums.get(key, 0.0) + value
            count += 1
        if stopped:
            break
    figures |= {key: value / max(1, count) for key, value in sums.items()}
    return figures | {"updates": float(count), "transitions": float(len(data))}


def transitions(batch: TensorDict, keep: Tensor, keys: Iterable[NestedKey], **extra: Tensor) -> TensorDict:
    """The flat set of kept steps: what losses read by key, chunk and behaviour log-probability, plus tensors [B, T, ...] by name."""
    flat = keep.reshape(-1).nonzero().squeeze(-1)
    source = {key: batch[key].flatten(0, 1)[flat] for key in (*keys, CHUNK, LOG_PROB)}
    out = TensorDict(source, [len(flat)])
    for key, value in extra.items():
        out[key] = value.flatten(0, 1)[flat]
    return out
