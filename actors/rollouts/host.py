"""What one host of worlds does: a job in, a rollout out.

A job says which episodes to run and which random numbers to draw; with the version of the weights it fixes
the rollout,
bit for bit. So it does not matter who runs it, in which order, or whether it is run a second time after a
host died.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.collectors import Collector
from torchrl.envs import EnvBase

from actors.policies.vla import VISUAL_FEATURES, ChunkPolicy, Perception
from actors.rollouts.meter import Meter
from envs.specs import (
    CHUNK,
    COMMAND,
    EPISODE,
    IMAGE,
    INVALID_ACTION,
    JUDGE_STATUS,
    LOG_PROB,
    STATE,
    SUCCESS,
    TOKENS,
    ActionMode,
)
from envs.transforms import JudgeReward, StateExpertTransform

VERSION = "policy_version"  # int64 [B, T, 1]: which weights acted
Weights = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class Job:
    """Episodes to run.

    Args:
        number: counts up over a run; rollouts are joined in this order, whenever they arrive.
        seeds: of the episodes; more than the host's batch where early endings are to be refilled.
        sampling: seed of the policy's exploration.
    """

    number: int
    seeds: tuple[int, ...]
    sampling: int


def trained_weights(policy: nn.Module) -> Weights:
    """The tensors that learning changes, by name; the rest of a policy is built from files by every host
    itself.
    """
    # A fresh array each: a published version must not change when the optimiser goes on.
    return {
        name: value.detach().cpu().clone().numpy()
        for name, value in policy.named_parameters()
        if value.requires_grad
    }


class SafePolicyWrapper(TensorDictModuleBase):
    """A policy whose numbers that are NaN or infinite never reach a world: the arms rest instead, and
    INVALID_ACTION says so.

    Args:
        policy: acts.
        mode: of its chunks.
    """

    def __init__(self, policy: ChunkPolicy, mode: ActionMode):
        super().__init__()
        self.policy, self.mode = policy, mode
        self.in_keys, self.out_keys = [*policy.in_keys, COMMAND], [*policy.out_keys, INVALID_ACTION]

    def forward(self, observed: TensorDictBase) -> TensorDictBase:
        out = self.policy(observed)
        bad = ~(out[CHUNK].isfinite().flatten(1).all(1) & out[LOG_PROB].isfinite())
        if bad.any():
            chunk = out[CHUNK]
            rest = (
                torch.zeros_like(chunk)
                if self.mode is ActionMode.RELATIVE
                else out[COMMAND].unsqueeze(1).expand_as(chunk)
            )
            out[CHUNK] = torch.where(bad[:, None, None], rest, chunk)
            out[LOG_PROB] = torch.where(bad, 0.0, out[LOG_PROB])
            out[VISUAL_FEATURES] = torch.where(bad[:, None], 0.0, out[VISUAL_FEATURES])
        out[INVALID_ACTION] = bad.unsqueeze(-1)
        return out


class Host:
    """A batch of episodes with a replica of the policy.

    Collects with TorchRL's Collector, which resets all slots before each job.

    Args:
        env: any world of this project, its transforms included.
        policy: the replica; nobody else may change it.
        bootstrap: also say what perception makes of each next observation, for critics.
    """

    def __init__(self, env: EnvBase, policy: ChunkPolicy, bootstrap: bool = True):
        self.env, self.policy, self.bootstrap = env, policy, bootstrap
        self.base = getattr(env, "base_env", env)
        self.steps = self.base.horizon // self.base.chunk
        self.version = -1
        self._job: Job | None = None
        transforms = list(getattr(env, "transform", None) or ())
        self._judging = next((t for t in transforms if isinstance(t, JudgeReward)), None)
        self.meter = Meter()
        self.meter.watch(policy, "forward")
        self.meter.watch(policy.perception, "forward")  # calls within calls count once
        for transform in transforms:  # none in physics
            if isinstance(transform, StateExpertTransform):
                self.meter.watch(transform.decoder, "decode")
            if isinstance(transform, JudgeReward):
                self.meter.watch(transform.judge, "score")
        if self._judging is not None:
            self.meter.watch(self.base.simulator, "predict")
            self.meter.watch(self.base.simulator.places, "find")
            self.meter.watch(self.base.simulator.places, "push")
        self._collect()
        seen = {key for key in policy.trained.in_keys if isinstance(key, tuple)}
        self._keys: list[NestedKey] = [
            *sorted(seen | {STATE, VISUAL_FEATURES}),
            CHUNK,
            LOG_PROB,
            INVALID_ACTION,
            EPISODE,
        ]
        self._after: list[NestedKey] = ["reward", "done", "terminated", "truncated", SUCCESS, STATE]
        # What is built by now stays; looking through it for garbage again and again took a tenth of a
        # rollout's time.
        gc.collect()
        gc.freeze()

    def _collect(self) -> None:
        self._collector = Collector(
            self.env,
            SafePolicyWrapper(self.policy, self.base.mode),
            frames_per_batch=self.env.batch_size[0] * self.steps,
            total_frames=-1,
            reset_at_each_iter=True,
            # Right before the reset: the collector also resets when it is set up, and would use up the first
            # seeds.
            pre_collect_hook=self._begin,
            auto_register_policy_transforms=False,
        )
        self._stream = iter(self._collector)

    def _begin(self) -> None:
        if self._job is not None:
            torch.manual_seed(self._job.sampling)
            if self._judging is not None:
                self._judging.forget()
            self.base.schedule(self._job.seeds)

    def load(self, version: int, weights: Mapping[str, NDArray[Any]]) -> None:
        """Take over a version of what is trained.

        Raises:
            KeyError: if a tensor is not one of this policy's.
        """
        known = dict(self.policy.named_parameters())
        with torch.no_grad():
            for name, value in weights.items():
                known[name].copy_(torch.tensor(value))
        self.version = version

    def run(self, job: Job) -> TensorDict:
        """Carry out a job.

        Returns:
            TensorDict [B, T] with what learners read: the trained part's inputs, chunk, log-probability,
                episode seed,
            version, and of each next step reward, ends, success, state and what perception makes of it.
            Pictures
            are among it only if perception is trained; the video itself stays here.
        """
        self._job = job
        # in one process with the learner, its random numbers are its own
        with torch.random.fork_rng(devices=[]):
            try:
                batch = next(self._stream)
            except BaseException:
                # What raised half-way through has ended the stream; the next job finds a new one.
                self._collector.shutdown(close_env=False)
                self._collect()
                raise
        if self._judging is not None and self._judging.later:
            self._judging.settle(batch)
        if self.bootstrap:
            batch["next", VISUAL_FEATURES] = seen_next(batch, self.policy.perception)
        after = [
            *self._after,
            *([VISUAL_FEATURES] if self.bootstrap else []),
            *([JUDGE_STATUS] if JUDGE_STATUS in batch["next"].keys(True, True) else []),
        ]
        out = batch.select(*self._keys).exclude("next").clone()
        out["next"] = batch["next"].select(*after).clone()
        out[VERSION] = torch.full((*batch.shape, 1), self.version)
        return out.cpu()

    def close(self) -> None:
        """Let go of the world."""
        self._collector.shutdown(close_env=False)
        if not self.env.is_closed:
            self.env.close()


@torch.no_grad()
def seen_next(batch: TensorDict, perception: Perception) -> Tensor:
    """What perception makes of each step's next observation: what it made of it a step later, or, where the
    rollout ends or a slot starts anew, computed here.
    """
    seen = batch[VISUAL_FEATURES].roll(-1, 1)
    fresh = batch["next", "done"].squeeze(-1).clone()
    fresh[:, -1] = True
    seen[fresh] = perception(batch["next", IMAGE][fresh], batch["next", TOKENS][fresh])
    return seen


def pack(batch: TensorDict) -> Weights:
    """A rollout as named arrays, which Ray hands over without copying; names are joined by slashes."""
    return {
        "/".join(key) if isinstance(key, tuple) else key: value.numpy()
        for key, value in batch.items(True, True)
    }


def unpack(arrays: Mapping[str, NDArray[Any]]) -> TensorDict:
    """The reverse of pack; copies, for what Ray hands over may not be written to."""
    lead = next(iter(arrays.values())).shape[:2]
    return TensorDict({tuple(name.split("/")): torch.tensor(value) for name, value in arrays.items()}, lead)


def size_of(arrays: Mapping[str, NDArray[np.generic]]) -> int:
    """Bytes of named arrays."""
    return sum(value.nbytes for value in arrays.values())


class Stopwatch:
    """Seconds since it was made or last read."""

    def __init__(self) -> None:
        self._began = time.perf_counter()

    def read(self) -> float:
        """Seconds, and begins anew."""
        now = time.perf_counter()
        spent, self._began = now - self._began, now
        return spent
