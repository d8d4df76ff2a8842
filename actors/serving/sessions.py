"""Sessions of a served simulator, and the one worker that advances several of them in one forward pass."""

from __future__ import annotations

import asyncio
import threading
import time
import uuid
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict
from torch import Tensor

from envs.geometry.kinematics import Kinematics
from envs.layouts import CommandLayout, JointLayout, Joints
from envs.precision import mixed_precision
from envs.simulators.base import Simulator
from envs.simulators.remote.protocol import ProtocolError
from envs.simulators.state_experts.base import StateDecoder
from envs.specs import STATE_DIM


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
        linger_ms: that a step waits for company.
        idle_s: after which an unused session ends.
        body_mb: largest request body.
        seed: of sessions that name none.
    """

    host: str = "127.0.0.1"
    port: int = 9000
    sessions: int = 32
    batch: int = 8
    linger_ms: float = 5.0
    idle_s: float = 900.0
    body_mb: float = 512.0
    seed: int = 0


@dataclass
class Session:
    """One client's episode. Pictures are uint8 at the simulator's size; `state` is its row of the simulator's
    state once it has stepped.
    """

    client_id: str
    user: str
    seed: int
    touched: float
    task: str = ""
    intrinsic: NDArray[np.float32] | None = None
    extrinsic: NDArray[np.float32] | None = None
    first: NDArray[np.uint8] | None = None
    joints: NDArray[np.float32] | None = None
    traj: NDArray[np.uint8] | None = None
    c2w: NDArray[np.float32] | None = None
    state: TensorDict | None = None
    chunk: int = 0
    frames: int = 0
    seconds: float = 0.0
    last_action: list[float] | None = None
    last_state: list[float] | None = None
    preview: bytes = b""
    # chunk number, request and answer of the last step, for a client that asks again
    reply: tuple[int, bytes, bytes] | None = None
    lock: asyncio.Lock = field(default_factory=asyncio.Lock)

    def restart(self) -> None:
        """Forget the episode; cameras stay."""
        self.first = self.joints = self.traj = self.c2w = self.state = self.reply = None
        self.chunk = self.frames = 0


@dataclass
class _Job:
    session: Session
    actions: NDArray[np.float32]
    done: asyncio.Future


class SessionHost:
    """Holds sessions and advances them.

    Args:
        simulator, decoder: the world; the decoder's joint states go into its memory and to the client.
        config: limits.
        kinematics: turns joint commands into end-effector poses, for a world that takes those.
        bf16: as in the config of the simulator.
    """

    def __init__(
        self,
        simulator: Simulator,
        decoder: StateDecoder | None,
        config: ServeConfig,
        kinematics: Kinematics | None = None,
        bf16: bool = True,
    ):
        self.simulator, self.decoder, self.config, self.kinematics, self.bf16 = (
            simulator.eval(),
            decoder,
            config,
            kinematics,
            bf16,
        )
        self.sessions: dict[str, Session] = {}
        self.latest: Session | None = None
        self.passes = self.steps = self.opened = 0
        self._jobs: asyncio.Queue[_Job] = asyncio.Queue()
        self._worker: asyncio.Task[None] | None = None
        self._busy = threading.Lock()  # one forward pass at a time, whichever event loop asks

    # -- sessions
    # ------------------------------------------------------------------------------------------------
    def open(self, user: str, seed: int | None) -> Session:
        """A new session.

        Raises:
            NoPlace: if all places are in use.
        """
        self.expire()
        if len(self.sessions) >= self.config.sessions:
            raise NoPlace(
                f"all serve.sessions={self.config.sessions} are in use; close one, or wait until one was idle for serve.idle_s={self.config.idle_s:g} seconds"
            )
        session = Session(
            uuid.uuid4().hex, user, self.config.seed + self.opened if seed is None else seed, time.monotonic()
        )
        self.opened += 1
        self.sessions[session.client_id] = session
        self.latest = session
        return session

    def expire(self) -> None:
        """End the sessions that nobody used for `idle_s` seconds."""
        now = time.monotonic()
        for client in [
            key
            for key, session in self.sessions.items()
            if now - session.touched > self.config.idle_s and not session.lock.locked()
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
        if session.state is not None:
            self.simulator.release(session.state, torch.ones(1, dtype=torch.bool))

    # -- steps
    # ---------------------------------------------------------------------------------------------------
    async def step(
        self, session: Session, actions: NDArray[np.float32]
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32] | None]:
        """Frames uint8 [L, V, 3, H, W] and joint states [L, 16] or None of a session under actions [L, A], L
        at most a chunk.

        Raises:
            ProtocolError: if something was not set up, or actions do not fit the world.
        """
        self._check(session, actions)
        if self._worker is None or self._worker.done():
            self._worker = asyncio.create_task(self._work())
        job = _Job(session, actions, asyncio.get_running_loop().create_future())
        await self._jobs.put(job)
        return await job.done

    def _check(self, session: Session, actions: NDArray[np.float32]) -> None:
        chunk, layout = self.simulator.shape.chunk, self.simulator.shape.layout
        if len(actions) > chunk:
            raise ProtocolError(f"an action chunk of {len(actions)} rows exceeds this world's {chunk}")
        missing = [
            path
            for path, value in (
                ("/set_camera_params", session.intrinsic),
                ("/set_episode_data", session.first),
                ("/set_episode_traj", session.traj),
            )
            if value is None
        ]
        if missing:
            raise ProtocolError(f"{missing} must be called before /step")
        if actions.shape[1] != layout.size and not (
            layout is CommandLayout.EEF and actions.shape[1] == STATE_DIM and self.kinematics is not None
        ):
            also = " (or 16 joints, with simulator.kinematics)" if layout is CommandLayout.EEF else ""
            raise ProtocolError(
                f"this world takes {layout.size} numbers an action, layout {layout.value}{also}; got {actions.shape[1]}"
            )

    async def _work(self) -> None:
        """Take jobs, wait a moment for company, advance them together; runs as long as the server does."""
        while True:
            jobs = [await self._jobs.get()]
            deadline = time.monotonic() + self.config.linger_ms / 1e3
            most = min(self.config.batch, len(self.sessions))
            while len(jobs) < most:
                try:
                    jobs.append(
                        await asyncio.wait_for(self._jobs.get(), max(0.0, deadline - time.monotonic()))
                    )
                except asyncio.TimeoutError:
                    break
            try:
                made = await asyncio.to_thread(self._advance, jobs)
            except Exception as error:  # every client of this pass hears of it; sessions stay as they were
                for job in jobs:
                    if not job.done.done():
                        job.done.set_exception(RuntimeError(f"{type(error).__name__}: {error}"))
                continue
            for job, answer in zip(jobs, made, strict=True):
                if not job.done.done():
                    job.done.set_result(answer)

    @torch.no_grad()
    def _advance(self, jobs: list[_Job]) -> list[tuple[NDArray[np.uint8], NDArray[np.float32] | None]]:
        with self._busy:
            chunk = self.simulator.shape.chunk
            device = next(self.simulator.parameters()).device
            commands = torch.stack([self._commands(job.actions) for job in jobs])
            windows = [self._window(job.session, len(job.actions)) for job in jobs]
            maps = torch.from_numpy(np.stack([maps for maps, _ in windows]))
            c2w = torch.from_numpy(np.stack([c2w for _, c2w in windows]))
            states = [
                job.session.state
                if job.session.state is not None
                else self._begin(job.session, commands[row], maps[row], c2w[row])
                for row, job in enumerate(jobs)
            ]
            state = self.simulator.stack(states).to(device)
            commands = commands.to(device)
            with mixed_precision(device, self.bf16):
                frames, features, state = self.simulator.step(
                    state, commands, maps.to(device), c2w.to(device)
                )
            decoded = None if self.decoder is None else self.decoder.follow(self.simulator, state, features)
            self.passes, self.steps = self.passes + 1, self.steps + len(jobs)
            out = []
            for row, job in enumerate(jobs):
                asked = len(job.actions)
                mine = state[row : row + 1].clone()
                # what was generated beyond the actions did not happen
                mine["length"] = mine["length"] - (chunk - asked)
                job.session.state = mine
                job.session.chunk += 1
                job.session.frames += asked
                out.append(
                    (
                        frames[row, :asked].cpu().numpy(),
                        None if decoded is None else decoded[row, :asked].float().cpu().numpy(),
                    )
                )
            return out

    def _commands(self, actions: NDArray[np.float32]) -> Tensor:
        """Commands [K, A] in the world's layout, the last repeated up to a chunk."""
        values = torch.from_numpy(actions)
        if values.shape[1] != self.simulator.shape.layout.size:
            assert self.kinematics is not None
            values = self.kinematics.flanges(Joints(values, JointLayout.PER_ARM))
        return torch.cat([values, values[-1:].expand(self.simulator.shape.chunk - len(values), -1)])

    def _window(self, session: Session, asked: int) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Pose maps [K, V, 3, H, W] and c2w [K, V, 4, 4] of the chunk: its part of a whole recording, or all
        of what was sent for this step.
        """
        assert session.traj is not None and session.c2w is not None
        chunk, total = self.simulator.shape.chunk, len(session.traj)
        begin = session.chunk * chunk if total >= 2 * chunk else 0
        rows = np.minimum(np.minimum(np.arange(begin, begin + chunk), begin + asked - 1), total - 1)
        return session.traj[rows], session.c2w[rows]

    def _begin(self, session: Session, commands: Tensor, maps: Tensor, c2w: Tensor) -> TensorDict:
        """The first state of a session; its history begins with the first command, as released."""
        assert session.first is not None and session.intrinsic is not None
        device = next(self.simulator.parameters()).device
        joints = (
            session.joints
            if session.joints is not None
            else commands[0].numpy()
            if commands.shape[1] == STATE_DIM
            else np.zeros(STATE_DIM, np.float32)
        )
        where = c2w[0] if session.extrinsic is None else torch.from_numpy(session.extrinsic)
        rows = [
            torch.from_numpy(session.first),
            torch.from_numpy(session.intrinsic),
            where,
            commands[0],
            torch.from_numpy(joints),
            maps[0],
            torch.tensor(session.seed),
        ]
        return self.simulator.reset(*(row[None].to(device) for row in rows))
