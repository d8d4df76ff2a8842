"""Sessions of a served simulator, and the one worker that advances several of them in one forward pass."""

from __future__ import annotations

import asyncio
import threading
import time
import uuid
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict
from torch import Tensor

from actors.serving.batching import Company
from actors.serving.session import Session, first_frame, needs_cameras, next_chunk
from envs.conditioning.joint_commands import JointCommands
from envs.precision import mixed_precision
from envs.ranges import Count, Natural, NonNegative, Port, Positive
from envs.simulators import memory
from envs.simulators.base import Simulator
from envs.simulators.remote.protocol import ProtocolError
from envs.simulators.state_experts.base import StateDecoder


class UnknownSession(PermissionError):
    """No session has this client_id; it was never opened, was closed, or expired."""


class NoPlace(RuntimeError):
    """Every place is taken by a session that is still in use."""


@dataclass(frozen=True)
class ServeConfig:
    """Options of `worldloop serve`.

    Args:
        host, port: to listen on; loopback, for whoever reaches the port drives the simulator.
        sessions: held at once; /init beyond that is refused.
        batch: sessions that share a forward pass.
        linger_ms: longest that a step waits for others that usually come soon; never longer than a pass
            takes.
        idle_s: after which an unused session ends.
        grace_s: after which a session that was opened as bound to its connection ends, once that is lost.
        body_mb: largest request body.
        seed: of sessions that name none.
        fixed_seed: every such session has that very seed, so that the same client gets the same frames
            whenever it runs; else they count up from it.
    """

    host: str
    port: Port
    sessions: Count
    batch: Count
    linger_ms: NonNegative
    idle_s: Positive
    grace_s: Positive
    body_mb: Positive
    seed: Natural
    fixed_seed: bool


@dataclass
class _Job:
    session: Session
    commands: Tensor  # [L, A]
    done: asyncio.Future


class SessionHost:
    """Holds sessions and advances them.

    Args:
        simulator, decoder: the world; the decoder's joint states go into its memory and to the client.
        config: limits.
        joints: turns joint commands into the robot's own, for a robot that takes end-effector poses.
        bf16: as in the config of the simulator.
    """

    def __init__(
        self,
        simulator: Simulator,
        decoder: StateDecoder | None,
        config: ServeConfig,
        joints: JointCommands | None = None,
        bf16: bool = True,
    ):
        self.simulator, self.decoder, self.config, self.joints = simulator.eval(), decoder, config, joints
        self.bf16, self.spec, self.robot = bf16, simulator.spec, simulator.spec.embodiment
        self.sessions: dict[str, Session] = {}
        self.latest: Session | None = None
        self.passes = self.steps = self.opened = 0
        self.company = Company(config.linger_ms / 1e3)
        self._jobs: asyncio.Queue[_Job] = asyncio.Queue()
        self._worker: asyncio.Task[None] | None = None
        self._busy = threading.Lock()  # one forward pass at a time, whichever event loop asks

    # -- sessions
    def open(self, user: str, seed: int | None) -> Session:
        """A new session.

        Raises:
            NoPlace: if all places are in use.
        """
        self.expire()
        if len(self.sessions) >= self.config.sessions:
            raise NoPlace(
                f"all serve.sessions={self.config.sessions} are in use; close one, or wait until one was"
                f" idle for serve.idle_s={self.config.idle_s:g} seconds"
            )
        if seed is None:
            seed = self.config.seed + (0 if self.config.fixed_seed else self.opened)
        session = Session(uuid.uuid4().hex, self.opened, user, seed, time.monotonic())
        self.opened += 1
        self.sessions[session.client_id] = session
        self.latest = session
        return session

    def expire(self) -> None:
        """End the sessions that nobody used for `idle_s` seconds, or `grace_s` if their client is gone."""
        now = time.monotonic()
        for client in [
            key
            for key, session in self.sessions.items()
            if now - session.touched > (self.config.grace_s if session.left else self.config.idle_s)
            and not session.lock.locked()
        ]:
            self.close(client)

    def get(self, client_id: object) -> Session:
        """The session of a client.

        Raises:
            UnknownSession: if there is none.
        """
        session = self.sessions.get(client_id) if isinstance(client_id, str) else None
        if session is None:
            raise UnknownSession("unknown client_id; POST /init first")
        session.touched = time.monotonic()
        return session

    def close(self, client_id: str) -> None:
        """End a session and let its memory go."""
        session = self.sessions.pop(client_id)
        self.company.left(client_id)
        if session.state is not None:
            self.simulator.release(session.state, torch.ones(1, dtype=torch.bool))

    # -- steps
    async def step(
        self, session: Session, actions: NDArray[np.float32]
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32] | None]:
        """Frames uint8 [L, V, 3, H, W] and joint states [L, S] or None of a session under actions [L, A], L
        at most a chunk.

        Raises:
            ProtocolError: if something was not set up, or actions do not fit the world.
        """
        self._check(session, actions)
        if self._worker is None or self._worker.done():
            self._worker = asyncio.create_task(self._work())
        values = torch.from_numpy(actions)
        own = actions.shape[1] == self.robot.action_dim
        commands = values if own or self.joints is None else self.joints(values)
        job = _Job(session, commands, asyncio.get_running_loop().create_future())
        self.company.arrived(session.client_id, time.monotonic())
        await self._jobs.put(job)
        return await job.done

    def _check(self, session: Session, actions: NDArray[np.float32]) -> None:
        if len(actions) > self.spec.chunk:
            raise ProtocolError(
                f"an action chunk of {len(actions)} rows exceeds this world's {self.spec.chunk}"
            )
        wanted: list[tuple[str, object]] = [("/set_episode_data", session.first)]
        if needs_cameras(self.spec):
            wanted = [
                ("/set_camera_params", session.intrinsic),
                *wanted,
                ("/set_episode_traj", session.traj),
            ]
        missing = [path for path, value in wanted if value is None]
        if missing:
            raise ProtocolError(f"{missing} must be called before /step")
        sizes = [self.robot.action_dim, *([self.joints.size] if self.joints else [])]
        if actions.shape[1] not in sizes:
            also = f" (or {self.joints.size} joints)" if self.joints else ""
            raise ProtocolError(
                f"this world takes {self.robot.action_dim} numbers an action{also}:"
                f" {list(self.robot.action_names)}; got {actions.shape[1]}"
            )

    async def _work(self) -> None:
        """Take jobs, wait for expected company, advance them together; runs as long as the server does."""
        while True:
            jobs = await self._gather()
            began = time.monotonic()
            try:
                made = await asyncio.to_thread(self._advance, jobs)
            except Exception as error:  # every client of this pass hears of it; sessions stay as they were
                for job in jobs:
                    if not job.done.done():
                        job.done.set_exception(RuntimeError(f"{type(error).__name__}: {error}"))
                continue
            ended = time.monotonic()
            self.company.answered([job.session.client_id for job in jobs], ended, ended - began)
            for job, answer in zip(jobs, made, strict=True):
                if not job.done.done():
                    job.done.set_result(answer)

    async def _gather(self) -> list[_Job]:
        """The jobs of the next pass."""
        jobs = [await self._jobs.get()]
        began = time.monotonic()
        most = min(self.config.batch, len(self.sessions))
        while len(jobs) < most:
            if not self._jobs.empty():
                jobs.append(self._jobs.get_nowait())
                continue
            left = self.company.wait_until(began) - time.monotonic()
            if left <= 0:
                break
            try:
                jobs.append(await asyncio.wait_for(self._jobs.get(), left))
            except asyncio.TimeoutError:
                break
        return jobs

    @torch.no_grad()
    def _advance(self, jobs: list[_Job]) -> list[tuple[NDArray[np.uint8], NDArray[np.float32] | None]]:
        with self._busy:
            device, chunk = self.simulator.device, self.spec.chunk
            future = torch.cat([next_chunk(job.session, job.commands, self.spec) for job in jobs]).to(device)
            states = [
                job.session.state
                if job.session.state is not None
                else self._begin(job.session, future[row : row + 1])
                for row, job in enumerate(jobs)
            ]
            state = memory.stack(states)
            with mixed_precision(device, self.bf16):
                frames, features, state = self.simulator.step(state, future)
            decoded = None if self.decoder is None else self.decoder.follow(state, chunk, features)
            self.passes, self.steps = self.passes + 1, self.steps + len(jobs)
            out = []
            for row, job in enumerate(jobs):
                commanded = len(job.commands)
                mine = state[row : row + 1].clone()
                # what was generated beyond the actions did not happen
                mine["length"] = mine["length"] - (chunk - commanded)
                job.session.state = mine
                job.session.chunk += 1
                job.session.frames += commanded
                shown = frames[row, :commanded].cpu().numpy()
                out.append(
                    (shown, None if decoded is None else decoded[row, :commanded].float().cpu().numpy())
                )
            return out

    def _begin(self, session: Session, future: TensorDict) -> TensorDict:
        """The first state of a session, on the simulator's device."""
        rows = first_frame(session, future, self.spec).to(self.simulator.device)
        return self.simulator.reset(rows, torch.tensor([session.seed])).to(self.simulator.device)
