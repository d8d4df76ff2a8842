"""What one host of worlds does: a job in, a rollout out.

A job says which episodes to run and which random numbers to draw; with the version of the weights it fixes
the rollout, bit for bit. So it does not matter who runs it, in which order, or whether it is run a second
time after a host died.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import NestedKey, TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from actors.policies.contract import (
    VISUAL_FEATURES,
    action_key,
    device_of,
    feature_part,
    input_keys,
    inputs_for,
    trained_part,
    writes_features,
)
from actors.policies.safe import SafePolicyWrapper
from actors.rollouts.footage import Footage, footage
from actors.rollouts.meter import Meter
from envs.judges.base import counted
from envs.rng import seed_process
from envs.specs import (
    CHUNK,
    EPISODE,
    IMAGE,
    INSTRUCTION_UTF8,
    INVALID_ACTION,
    JUDGE_STATUS,
    LOG_PROB,
    LOST,
    STATE,
    SUCCESS,
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
        shown: imagined episodes of which the host keeps the frames, for people.
    """

    number: int
    seeds: tuple[int, ...]
    sampling: int
    shown: int = 0


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


class Host:
    """A batch of episodes with a replica of the policy.

    Args:
        env: any world of this project, its transforms included.
        policy: the replica; nobody else may change it (see policies/contract.py).
        bootstrap: also give critics what they read of each next observation: the policy's visual features,
            or, of a policy that writes none, the observation.
        threads: that torch computes a job with, so that it gives the same bits in any process; None for those
            of the process.

    Attributes:
        footage: of the last job, as many episodes as it asked to be shown; none in physics.
        counted: what the judge counted in the last job, such as goals; nothing in physics, and nothing of a
            judge in a service, which hosts share.
    """

    def __init__(
        self, env: EnvBase, policy: TensorDictModuleBase, bootstrap: bool = True, threads: int | None = None
    ):
        self.env, self.policy, self.bootstrap, self.threads = env, policy, bootstrap, threads
        self.base = getattr(env, "base_env", env)
        self.steps = self.base.horizon // self.base.chunk
        self.version = -1
        self.footage: tuple[Footage, ...] = ()
        self.counted: dict[str, int] = {}
        self.actor = SafePolicyWrapper(policy, self.base.spec, self.base.mode)
        self._features = feature_part(policy) if bootstrap and writes_features(policy) else None
        transforms = list(getattr(env, "transform", None) or ())
        self._judging = next((t for t in transforms if isinstance(t, JudgeReward)), None)
        self.meter = self._watch(transforms)
        critic = [VISUAL_FEATURES] if writes_features(policy) else [IMAGE, INSTRUCTION_UTF8]
        observed = {*input_keys(trained_part(policy)), STATE, *(critic if bootstrap else [])}
        self._keys: list[NestedKey] = [
            *sorted(key for key in observed if isinstance(key, tuple)),
            *dict.fromkeys((CHUNK, action_key(policy), LOG_PROB)),
            INVALID_ACTION,
            EPISODE,
        ]
        self._after: list[NestedKey] = [
            *("reward", "done", "terminated", "truncated", SUCCESS, STATE, JUDGE_STATUS, LOST),
            *([IMAGE, INSTRUCTION_UTF8] if bootstrap and self._features is None else []),
        ]
        # What is built by now stays; looking through it for garbage again and again took a tenth of a
        # rollout's time.
        gc.collect()
        gc.freeze()

    def _watch(self, transforms: list[Any]) -> Meter:
        """A meter over all networks of this host; calls within calls count once."""
        meter = Meter()
        meter.watch(self.policy, "forward")
        if self._features is not None and self._features is not self.policy:
            meter.watch(self._features, "forward")
        for transform in transforms:  # none in physics
            if isinstance(transform, StateExpertTransform):
                meter.watch(transform.decoder, "decode")
            if isinstance(transform, JudgeReward):
                meter.watch(transform.judge, "score")
        if self._judging is not None:
            meter.watch(self.base.simulator, "predict")
        return meter

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
            TensorDict [B, T] on the CPU with what learners read: the trained part's inputs, chunk,
            log-probability, episode seed, version, and of each next step reward, ends, success, state and
            visual features. Pictures are among it only if the policy's encoder is trained, or writes no
            features; the video itself stays here.
        """
        before = self._counts()
        devices = [torch.cuda.current_device()] if device_of(self.policy).type == "cuda" else []
        # In one process with the learner, its random numbers are its own.
        with torch.random.fork_rng(devices=devices), torch.no_grad(), computing_threads(self.threads):
            seed_process(job.sampling)
            if self._judging is not None:
                self._judging.forget()
            self.base.schedule(job.seeds)
            with set_exploration_type(ExplorationType.RANDOM):
                batch, ends = self._collect()
            if self._features is not None:
                batch["next", VISUAL_FEATURES] = self._next_features(batch, ends)
            if self._judging is not None and self._judging.later:
                self._judging.settle(batch)
            self.footage = footage(self.base, batch, job.shown) if job.shown and self._judging else ()
        self.counted = {name: count - before[name] for name, count in self._counts().items()}
        batch[VERSION] = torch.full((*batch.shape, 1), self.version)
        return batch.cpu()

    def _counts(self) -> dict[str, int]:
        return {} if self._judging is None else counted(self._judging.judge)

    def _collect(self) -> tuple[TensorDict, TensorDict | None]:
        """Rollout [B, T] from fresh episodes, and the observations [N] after which another episode begins, in
        the order of steps and slots, for those who value them.
        """
        now, rows, ends = self.env.reset(), [], []
        for step in range(self.steps):
            last, acted = step + 1 == self.steps, self.actor(now)
            # Nobody waits for the episodes that would begin after the last step.
            after, now = (self.env.step(acted), now) if last else self.env.step_and_maybe_reset(acted)
            row, following = after.select(*self._keys), after["next"]
            row["next"] = following.select(*self._after, strict=False)
            rows.append(row)
            if self._features is not None:
                done = following["done"].squeeze(-1)
                fresh = torch.ones_like(done) if last else done
                ends.append(following.select(*input_keys(self._features))[fresh])
        return torch.stack(rows, 1), torch.cat(ends) if ends else None

    @torch.no_grad()
    def _next_features(self, batch: TensorDict, ends: TensorDict | None) -> Tensor:
        """Visual features [B, T, F] of each step's next observation: those of a step later, or, where the
        rollout ends or a slot starts anew, those of `ends`.
        """
        assert self._features is not None and ends is not None
        seen = batch[VISUAL_FEATURES].roll(-1, 1)
        fresh = batch["next", "done"].squeeze(-1).clone()
        fresh[:, -1] = True
        features = self._features(inputs_for(ends, self._features))[VISUAL_FEATURES].to(seen.device)
        seen.transpose(0, 1)[fresh.transpose(0, 1)] = features  # ends come step by step
        return seen

    def close(self) -> None:
        """Let go of the world."""
        if not self.env.is_closed:
            self.env.close()


@contextmanager
def computing_threads(count: int | None) -> Iterator[None]:
    """Within, torch computes on the CPU with that many threads, which decide the order of sums and so their
    last bits; None changes nothing.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(count or before)
    try:
        yield
    finally:
        torch.set_num_threads(before)


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
