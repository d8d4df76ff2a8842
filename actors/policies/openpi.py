"""policy=openpi: any openpi policy server (websocket, msgpack) drives either world in evaluation.

The server sees pictures, the robot's state, and the instruction, and says a chunk of absolute commands.
"""

from __future__ import annotations

import socket
from typing import Any, ClassVar
from urllib.parse import urlparse

import numpy as np
import torch
import torch.nn.functional as F
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from envs.conditioning.joint_commands import JointCommands
from envs.geometry.kinematics import Kinematics
from envs.specs import (
    CHUNK,
    COMMAND,
    IMAGE,
    INSTRUCTION_UTF8,
    STATE,
    ActionMode,
    WorldSpec,
    bytes_to_text,
    to_chunk,
)


class PolicyServerError(RuntimeError):
    """An openpi server cannot be reached, or answered with something else than a chunk of commands."""


class OpenPIPolicy(TensorDictModuleBase):
    """Asks an openpi server for every chunk.

    Args:
        spec: of the worlds; longer answers are compressed to its chunk, as GE-Sim does.
        url: ws://host:port.
        mode: of the world's chunks.
        joints: whether the server says joints of a robot whose actions are end-effector poses; they go
            through the robot's kinematics.
        grippers_last: whether the server wants the state's grippers behind all its other numbers, as GE-Sim's
            policies do; the state must then hold the numbers of a command.

    Raises:
        PolicyServerError: if nobody listens there.
        EmbodimentError: if joints are of no use to this robot.
    """

    in_keys: ClassVar[list[Any]] = [IMAGE, STATE, COMMAND, INSTRUCTION_UTF8]
    out_keys: ClassVar[list[Any]] = [CHUNK]

    def __init__(self, spec: WorldSpec, url: str, mode: str, joints: bool, grippers_last: bool):
        super().__init__()
        place, robot = urlparse(url), spec.embodiment
        if place.scheme not in ("ws", "wss") or not place.hostname:
            raise PolicyServerError(
                f"policy.url={url!r} must be the address of an openpi server, such as ws://127.0.0.1:8000"
            )
        if joints and robot.kinematics is None:
            raise PolicyServerError(
                f"policy.joints=true needs the kinematics of {robot.robot}; set simulator.kinematics"
            )
        self.spec, self.url, self.mode = spec, url, ActionMode(mode)
        self.to_poses = (
            JointCommands(robot, Kinematics(robot.kinematics)) if joints and robot.kinematics else None
        )
        # Numbers and grippers of what the server says.
        self.width, self.grippers = (
            (robot.action_dim, robot.grippers)
            if self.to_poses is None
            else (self.to_poses.size, self.to_poses.grippers)
        )
        last = [k for k in self.grippers if k < robot.state_dim] if grippers_last else []
        self.state_order = [k for k in range(robot.state_dim) if k not in last] + last
        self._client = _connect(f"{place.scheme}://{place.hostname}", place.port)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the chunk float32 [B, K, A]."""
        words = bytes_to_text(tensordict[INSTRUCTION_UTF8])
        rows = [
            self._infer(tensordict[IMAGE][row], tensordict[STATE][row], text)
            for row, text in enumerate(words)
        ]
        commands = torch.stack(rows).to(tensordict[IMAGE].device)
        tensordict[CHUNK] = to_chunk(commands, tensordict[COMMAND], self.mode)
        return tensordict

    def _infer(self, image: Tensor, state: Tensor, words: str) -> Tensor:
        """Commands [K, A] of one episode, image uint8 [V, 3, H, W], state [S]."""
        seen: dict[str, Any] = {
            f"observation.images.{view}": image[k].permute(1, 2, 0).contiguous().cpu().numpy()
            for k, view in enumerate(self.spec.embodiment.views)
        }
        seen["observation.state"] = state[self.state_order].cpu().numpy().astype(np.float32)
        seen["prompt"] = words
        try:
            answer = self._client.infer(seen)
        except Exception as error:  # the client raises whatever the socket or the server did
            raise PolicyServerError(f"{self.url}: {type(error).__name__}: {error}") from error
        actions = np.asarray(answer.get("actions") if isinstance(answer, dict) else None, dtype=np.float32)
        actions = actions[0] if actions.ndim == 3 and len(actions) == 1 else actions
        chunk = self.spec.chunk
        fits = actions.ndim == 2 and actions.shape[1] == self.width and len(actions) >= chunk
        if not fits or not np.isfinite(actions).all():
            raise PolicyServerError(
                f"{self.url} answered actions of shape {actions.shape}, wanted at least {chunk} finite rows"
                f" of {self.width} numbers"
            )
        rows = compress(torch.from_numpy(np.array(actions)), chunk, self.grippers)
        return rows if self.to_poses is None else self.to_poses(rows)


def compress(commands: Tensor, count: int, grippers: tuple[int, ...]) -> Tensor:
    """A longer chunk [N, A] as one of `count` rows, as GE-Sim 2.0 does it: grippers take the nearest row,
    other numbers keep the first and the last and average what lies between.
    """
    total = len(commands)
    if total == count or count == 1:
        return commands[:count]
    inner = F.adaptive_avg_pool1d(commands[1:-1].T[None], count - 2)[0].T if count > 2 else commands[:0]
    out = torch.cat([commands[:1], inner, commands[-1:]])
    nearest = torch.linspace(0, total - 1, count, dtype=torch.float64).round().long()
    out[:, list(grippers)] = commands[nearest][:, list(grippers)]
    return out


def _connect(host: str, port: int | None) -> Any:
    """openpi's own client; it waits for a server for ever, so whether one listens is asked before."""
    from openpi_client.websocket_client_policy import WebsocketClientPolicy

    name = urlparse(host).hostname or ""
    try:
        socket.create_connection((name, port or 80), timeout=10).close()
    except OSError as error:
        raise PolicyServerError(f"no openpi server listens at {host}:{port} ({error})") from error
    return WebsocketClientPolicy(host, port)
