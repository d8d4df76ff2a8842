"""One client's episode: what the client has said of it, and what a simulator takes of that."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict
from torch import Tensor

from envs.commanded_states import as_states, joints_are_states
from envs.embodiment import Embodiment
from envs.episodes.pictures import resize_intrinsics
from envs.specs import WorldSpec


@dataclass
class Session:
    """One client's episode. Pictures are uint8 at the simulator's size; `state` is its row of the simulator's
    state once it has stepped.

    Attributes:
        number: counts sessions as they were opened; the page names it, the client_id is a secret.
        intrinsic: in pixels of the client's pictures, whose size is `frame_size`.
        traj_begin: frames that there were when the trajectory (`traj`, `c2w`) was sent: its first row is that
            of the frame after them.
        bound: whether it ends soon after the connection that last used it is lost; else only when it is idle.
        reply: chunk number, request and answer of the last step, for a client that asks again.
    """

    client_id: str
    number: int
    user: str
    seed: int
    touched: float
    bound: bool = False
    connection: asyncio.Transport | None = None
    task: str = ""
    intrinsic: NDArray[np.float32] | None = None
    extrinsic: NDArray[np.float32] | None = None
    first: NDArray[np.uint8] | None = None
    frame_size: tuple[int, int] = (0, 0)
    joints: NDArray[np.float32] | None = None
    command: NDArray[np.float32] | None = None
    traj: NDArray[np.uint8] | None = None
    c2w: NDArray[np.float32] | None = None
    traj_begin: int = 0
    state: TensorDict | None = None
    chunk: int = 0
    frames: int = 0
    last_action: list[float] | None = None
    last_state: list[float] | None = None
    preview: bytes = b""
    reply: tuple[int, bytes, bytes] | None = None
    lock: asyncio.Lock = field(default_factory=asyncio.Lock)

    @property
    def left(self) -> bool:
        """Whether whoever drives it is gone, as far as its connection says so."""
        return self.bound and (self.connection is None or self.connection.is_closing())

    def restart(self) -> None:
        """Forget the episode; cameras stay."""
        self.first = self.joints = self.command = self.traj = self.c2w = self.state = self.reply = None
        self.last_action = self.last_state = None
        self.chunk = self.frames = self.traj_begin = 0


def needs_cameras(spec: WorldSpec) -> bool:
    """Whether a world is conditioned on cameras, so that a client must send them."""
    return spec.pose_map or spec.ray_map


def of_calibrated(cameras: NDArray[np.float32], robot: Embodiment) -> NDArray[np.float32]:
    """Matrices [V, ...] of a client's cameras, zeros of those that this world takes to be uncalibrated."""
    known = np.array([camera.calibrated for camera in robot.cameras])
    return cameras * known.reshape(-1, *[1] * (cameras.ndim - 1)).astype(np.float32)


def next_chunk(session: Session, commands: Tensor, spec: WorldSpec) -> TensorDict:
    """What Simulator.step takes of one session, [1], under commands [L, A].

    The last command is repeated up to a chunk; of pose maps and cameras it is the part of the trajectory that
    belongs to the chunk, whether a whole recording was sent once or a part of it for each step. Beyond its
    end the last row is repeated.
    """
    commanded, chunk = len(commands), spec.chunk
    last = commands[-1:].expand(chunk - commanded, -1)
    future = {"commands": torch.cat([commands, last])[None]}
    if needs_cameras(spec):
        assert session.traj is not None and session.c2w is not None
        total, begin = len(session.traj), session.frames - session.traj_begin
        rows = np.minimum(np.minimum(np.arange(begin, begin + chunk), begin + commanded - 1), total - 1)
        future["c2w"] = torch.from_numpy(session.c2w[rows])[None]
        if spec.pose_map:
            future["pose_map"] = torch.from_numpy(session.traj[rows])[None]
    return TensorDict(future, [1])


def first_frame(session: Session, future: TensorDict, spec: WorldSpec) -> TensorDict:
    """What Simulator.reset takes of one session, [1], whose first chunk is `future`.

    What a client of the released server does not say begins with its first command, as released.
    """
    assert session.first is not None
    robot, command = spec.embodiment, future["commands"][:, 0]
    if session.command is not None:
        command = torch.from_numpy(session.command)[None].to(command.device)
    if session.joints is not None:
        joints = torch.from_numpy(session.joints)[None]
    else:
        joints = as_states(robot, command) if joints_are_states(robot) else torch.zeros(1, robot.state_dim)
    first = {"frames": torch.from_numpy(session.first)[None], "command": command, "state": joints}
    if needs_cameras(spec):
        assert session.intrinsic is not None
        intrinsic = resize_intrinsics(session.intrinsic, session.frame_size, spec.size)
        first["intrinsic"] = torch.from_numpy(intrinsic)[None]
        own = session.extrinsic
        first["c2w"] = future["c2w"][:, 0] if own is None else torch.from_numpy(own)[None]
    if spec.pose_map:
        first["pose_map"] = future["pose_map"][:, 0]
    return TensorDict(first, [1])
