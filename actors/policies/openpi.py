"""policy=openpi: any openpi policy server (websocket, msgpack) drives either world in evaluation.

The server sees pictures, the robot's state, and the instruction, and says a chunk of absolute commands.
"""

from __future__ import annotations

import socket
from typing import Any, ClassVar, Literal
from urllib.parse import ParseResult, urlparse

import numpy as np
import torch
import torch.nn.functional as F
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from envs.conditioning.joint_commands import JointCommands
from envs.embodiment import Embodiment
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

# It asks for an old numpy, which nothing in it needs; msgpack and websockets, which it needs, are ours.
INSTALL = "python -m pip install --no-deps openpi-client==0.1.2"


class PolicyServerError(RuntimeError):
    """An openpi server cannot be reached, or answered with something else than a chunk of commands."""


class OpenPIPolicy(TensorDictModuleBase):
    """Asks an openpi server for every chunk.

    Args:
        spec: of the worlds.
        url: ws://host:port or wss://host, whose path and query are kept.
        mode: of the world's chunks.
        joints: whether the server says joints of a robot whose actions are end-effector poses; they go
            through the robot's kinematics.
        grippers_last: whether the server wants the state's grippers behind all its other numbers, as GE-Sim's
            policies do; in the state they must have the names that they have in an action.
        longer: what becomes of answers longer than the spec's chunk. "first" takes their first rows,
            "compress" makes one chunk of all of them, as GE-Sim 2.0 does, so that the robot moves that much
            faster.

    Raises:
        PolicyServerError: if nobody listens there, or an option cannot be with this robot.
        EmbodimentError: if joints are of no use to this robot.
    """

    in_keys: ClassVar[list[Any]] = [IMAGE, STATE, COMMAND, INSTRUCTION_UTF8]
    out_keys: ClassVar[list[Any]] = [CHUNK]
    rehearsed = False  # it calls its server

    def __init__(
        self,
        spec: WorldSpec,
        url: str,
        mode: str,
        joints: bool,
        grippers_last: bool,
        longer: Literal["first", "compress"],
    ):
        super().__init__()
        robot, place = spec.embodiment, _address(url)
        if longer not in ("first", "compress"):
            raise PolicyServerError(f"policy.longer={longer!r} must be first or compress")
        if longer == "compress" and robot.delta:
            raise PolicyServerError(
                f"policy.longer=compress averages targets, and actions of {robot.robot} are changes, which"
                " would have to be added up; set policy.longer=first"
            )
        if joints and robot.kinematics is None:
            raise PolicyServerError(
                f"policy.joints=true needs the kinematics of {robot.robot}; set simulator.kinematics"
            )
        self.spec, self.url, self.mode, self.longer = spec, url, ActionMode(mode), longer
        self.to_poses = (
            JointCommands(robot, Kinematics(robot.kinematics)) if joints and robot.kinematics else None
        )
        # Numbers and grippers of what the server says.
        self.width, self.grippers = (
            (robot.action_dim, robot.grippers)
            if self.to_poses is None
            else (self.to_poses.size, self.to_poses.grippers)
        )
        last = _grippers_in_state(robot) if grippers_last else []
        self.state_order = [k for k in range(robot.state_dim) if k not in last] + last
        self._client = _connect(place)

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
        rows = torch.from_numpy(np.array(actions))
        rows = compress(rows, chunk, self.grippers) if self.longer == "compress" else rows[:chunk]
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


def _grippers_in_state(robot: Embodiment) -> list[int]:
    """Positions of the grippers in the state, found by the names that they have in an action; commands of
    joints keep the robot's own grippers.

    Raises:
        PolicyServerError: if the state has no such names.
    """
    names = [robot.action_names[k] for k in robot.grippers]
    if missing := [name for name in names if name not in robot.state_names]:
        raise PolicyServerError(
            f"policy.grippers_last=true looks for the grippers {missing} of {robot.robot} in its state, which"
            f" has {list(robot.state_names)}; set policy.grippers_last=false"
        )
    return [robot.state_names.index(name) for name in names]


def _address(url: str) -> ParseResult:
    """A websocket's address.

    Raises:
        PolicyServerError: if it is none.
    """
    try:
        place = urlparse(url)
        valid = place.scheme in ("ws", "wss") and bool(place.hostname) and place.port != 0
    except ValueError:  # a port that is no port
        valid = False
    if not valid:
        raise PolicyServerError(
            f"policy.url={url!r} must be the address of an openpi server, such as ws://127.0.0.1:8000"
        )
    return place


def _connect(place: ParseResult) -> Any:
    """openpi's own client; it waits for a server for ever, so whether one listens is asked before.

    Raises:
        PolicyServerError: if it is not installed, or nobody listens.
    """
    try:
        from openpi_client.websocket_client_policy import WebsocketClientPolicy
    except ImportError as error:
        raise PolicyServerError(
            f"policy=openpi needs openpi's client, which does not import ({error}): {INSTALL}"
        ) from error

    host, port = place.hostname or "", place.port or (443 if place.scheme == "wss" else 80)
    try:
        socket.create_connection((host, port), timeout=10).close()
    except OSError as error:
        raise PolicyServerError(f"no openpi server listens at {host}:{port} ({error})") from error
    return WebsocketClientPolicy(place.geturl())
