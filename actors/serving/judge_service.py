"""One judge for all hosts: a Ray actor that gathers clips from many callers into batches, and the Judge that
asks it.

Judgements are remembered by content, so the same video is never paid for twice. A caller waits until a
deadline, tries again with growing pauses, and then says ERROR, upon which learners drop the episode and count
it; a spent budget says ABSTAIN. The service is a named actor that Ray restarts when it dies; callers find it
again by name.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import time
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import ray
import torch
from ray.exceptions import GetTimeoutError, RayActorError, RayTaskError
from torch import Tensor

from actors.factory import build_judge
from actors.policies.contract import device_of
from actors.process import prepare_process
from envs.judges.base import Judge, JudgeError, Judgement, checked
from envs.ranges import Count, Natural, NonNegative, Positive
from envs.specs import Status
from envs.targets import ConfigError

# Frames [T, V, 3, H, W], first [V, 3, H, W], instruction, features [C, D] (empty if the judge reads none).
Clip = tuple[np.ndarray, np.ndarray, str, np.ndarray]


@dataclass(frozen=True)
class ServiceConfig:
    """Options of the service and of those who ask it.

    Args:
        batch: clips judged at once at most.
        wait_ms: how long the first clip of a batch waits for others.
        cache: judgements remembered.
        budget: clips that may be judged since the service started, remembered ones not counted; 0 for any
            number.
        deadline: seconds a caller waits for an answer.
        retries: times it asks again.
        pause: seconds before the first of these; doubles each time.
    """

    batch: Count
    wait_ms: NonNegative
    cache: Natural
    budget: Natural
    deadline: Positive
    retries: Natural
    pause: NonNegative


class JudgeServer:
    """The actor's code; `score` runs concurrently for many callers, the judge itself in one batch after
    another.
    """

    def __init__(self, config: Mapping[str, Any], weights: str, options: ServiceConfig, threads: int):
        prepare_process(0, threads)
        self.judge = build_judge(config, Path(weights)).eval()
        self.options = options
        self.cache: OrderedDict[bytes, tuple[np.ndarray, np.ndarray, int]] = OrderedDict()
        self.waiting: list[tuple[Clip, asyncio.Future[Any]]] = []
        self.counts = {"clips": 0, "judged": 0, "remembered": 0, "batches": 0, "refused": 0}
        self.taken = 0  # of the budget, by clips that are judged, being judged, or wait
        self.worker: asyncio.Task[None] | None = None

    async def describe(self) -> dict[str, Any]:
        """Threshold and hold of the judge, by which callers turn frames into episodes, what it reads, and
        whether it charges.
        """
        judge = self.judge
        about = {"threshold": float(judge.threshold), "hold": judge.hold}
        return about | {"reads_features": judge.reads_features, "charges": judge.charges}

    async def stats(self) -> dict[str, int]:
        """How many clips came, were judged or remembered, in how many batches."""
        return dict(self.counts)

    async def score(
        self,
        frames: np.ndarray,
        first: np.ndarray,
        instruction: list[str],
        features: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Success and progress [B, T] and status [B] of clips; see Judge.score."""
        seen = np.zeros((len(frames), 0, 0), np.float32) if features is None else features
        answers = await asyncio.gather(
            *(self._clip(parts) for parts in zip(frames, first, instruction, seen, strict=True))
        )
        success, progress, status = zip(*answers, strict=True)
        return np.stack(success), np.stack(progress), np.array(status)

    async def _clip(self, clip: Clip) -> tuple[np.ndarray, np.ndarray, int]:
        self.counts["clips"] += 1
        frames, first, instruction, features = clip
        digest = hashlib.blake2b(instruction.encode(), digest_size=16)
        for part in (frames, first, features):
            digest.update(str(part.shape).encode())
            digest.update(np.ascontiguousarray(part).tobytes())
        key = digest.digest()
        if key in self.cache:
            self.counts["remembered"] += 1
            self.cache.move_to_end(key)
            return self.cache[key]
        if self.options.budget and self.taken >= self.options.budget:
            self.counts["refused"] += 1
            return np.zeros(len(frames), np.float32), np.zeros(len(frames), np.float32), Status.ABSTAIN.value
        self.taken += 1
        future: asyncio.Future[Any] = asyncio.get_running_loop().create_future()
        self.waiting.append((clip, future))
        if self.worker is None or self.worker.done():
            self.worker = asyncio.create_task(self._work())
        answer: tuple[np.ndarray, np.ndarray, int] = await future
        if answer[2] == Status.ERROR.value:
            return answer  # it may fare better the next time
        self.cache[key] = answer
        while len(self.cache) > self.options.cache:
            self.cache.popitem(last=False)
        return answer

    async def _work(self) -> None:
        """Judge what waits, batch by batch; clips of another length wait for a batch of their own."""
        while self.waiting:
            if len(self.waiting) < self.options.batch:
                await asyncio.sleep(self.options.wait_ms / 1e3)
            shape = self.waiting[0][0][0].shape
            chosen = [item for item in self.waiting if item[0][0].shape == shape][: self.options.batch]
            self.waiting = [item for item in self.waiting if not any(item is other for other in chosen)]
            clips = [clip for clip, _ in chosen]
            try:
                judgement = await asyncio.get_running_loop().run_in_executor(None, self._judge, clips)
            except Exception as error:
                self.taken -= len(chosen)
                for _, future in chosen:
                    future.set_exception(error)
                continue
            self.counts["judged"] += len(chosen)
            self.counts["batches"] += 1
            rows = zip(
                judgement.success.cpu().numpy(),
                judgement.progress.cpu().numpy(),
                judgement.status.tolist(),
                strict=True,
            )
            for (_, future), row in zip(chosen, rows, strict=True):
                future.set_result(row)

    def _judge(self, clips: list[Clip]) -> Judgement:
        """Judge clips of equal shape on the judge's device."""
        device = device_of(self.judge)
        frames, first, features = (
            torch.from_numpy(np.stack([clip[part] for clip in clips])).to(device) for part in (0, 1, 3)
        )
        seen = (features,) if self.judge.reads_features else ()
        return checked(
            self.judge, self.judge.score(frames, first, [clip[2] for clip in clips], *seen), frames
        )


class JudgeClient(Judge):
    """A Judge that asks the service of a name.

    Args:
        service: name of the actor.
        options: deadline and retries.

    Raises:
        ConfigError: if there is no such service.
    """

    def __init__(self, service: str, options: ServiceConfig):
        self.service, self.options = service, options
        try:
            about: Any = ray.get(ray.get_actor(service).describe.remote(), timeout=options.deadline)
        except (ValueError, RayActorError, GetTimeoutError) as error:
            raise ConfigError(
                f"the judge service {service!r} does not answer: {error}; start it first, or use"
                " launch.judge_service=false"
            ) from error
        super().__init__(about["hold"], about["threshold"])
        self.reads_features, self.charges = about["reads_features"], about["charges"]

    def submit(
        self, frames: Tensor, first: Tensor, instruction: list[str], features: Tensor | None = None
    ) -> Any:
        """See Judge.submit; the service begins at once."""
        seen = None if features is None else features.float().cpu().numpy()
        arrays = (frames.cpu().numpy(), first.cpu().numpy(), list(instruction), seen)
        ref: Any = None  # stays so if it is down just now; `fetch` asks again
        with contextlib.suppress(ValueError, RayActorError):
            ref = ray.get_actor(self.service).score.remote(*arrays)
        return arrays, ref, frames.device

    def fetch(self, ticket: Any) -> Judgement:
        """See Judge.fetch; what no attempt answered is an ERROR.

        Raises:
            JudgeError: if the judge itself says that it cannot go on.
        """
        arrays, ref, device = ticket
        for attempt in range(self.options.retries + 1):
            try:
                if ref is None:
                    ref = ray.get_actor(self.service).score.remote(*arrays)
                success, progress, status = ray.get(ref, timeout=self.options.deadline)
            except (ValueError, RayActorError, RayTaskError, GetTimeoutError) as error:
                if isinstance(error, RayTaskError) and isinstance(error.cause, JudgeError):
                    raise JudgeError(str(error.cause)) from None
                ref = None
                if attempt < self.options.retries:
                    time.sleep(self.options.pause * 2**attempt)
                continue
            return Judgement(
                torch.tensor(success, device=device),
                torch.tensor(progress, device=device),
                torch.tensor(status, device=device),
            )
        batch, count = arrays[0].shape[:2]
        nothing = torch.zeros(batch, count, device=device)
        return Judgement(nothing, nothing.clone(), torch.full((batch,), Status.ERROR.value, device=device))

    def score(
        self, frames: Tensor, first: Tensor, instruction: list[str], features: Tensor | None = None
    ) -> Judgement:
        """See Judge.score."""
        return self.fetch(self.submit(frames, first, instruction, features))


def start_service(
    name: str,
    config: Mapping[str, Any],
    weights: str,
    options: ServiceConfig,
    resources: Mapping[str, Any],
    threads: int,
) -> Any:
    """Start the named service and wait until it answers.

    Returns:
        The actor, which lives until it is killed.
    """
    server: Any = ray.remote(JudgeServer)
    actor = server.options(name=name, max_restarts=-1, max_concurrency=256, **resources).remote(
        config, weights, options, threads
    )
    ray.get(actor.describe.remote(), timeout=180)
    return actor
