"""policy=openpi: any openpi policy server (websocket, msgpack) drives either world in evaluation.

The server sees pictures, the joint state with grippers last, and the words of the task, and says absolute
joints
[L7, Lg, R7, Rg]. Worlds that take end-effector poses get them through the robot's kinematics.
"""

from __future__ import annotations

import socket
from typing import Any, ClassVar
from urllib.parse import urlparse

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from envs.geometry.kinematics import Kinematics
from envs.layouts import CommandLayout, JointLayout, Joints, compress
from envs.specs import CHUNK, COMMAND, IMAGE, STATE, ActionMode, to_relative


class PolicyServerError(RuntimeError):
    """An openpi server cannot be reached, or answered with something else than a chunk of joints."""


class OpenPIPolicy(TensorDictModuleBase):
    """Asks an openpi server for every chunk.

    Args:
        url: ws://host:port.
        views: names of the cameras, in the order of the world's pictures.
        chunk: rows a world takes; longer answers are compressed to it, as GE-Sim does.
        layout, mode: of the world's commands.
        kinematics: of the robot, for layout EEF.

    Attributes:
        instructions: words for every row of the batch, set by whoever runs the episodes.
    """

    in_keys: ClassVar[list[Any]] = [IMAGE, STATE, COMMAND]
    out_keys: ClassVar[list[Any]] = [CHUNK]

    def __init__(
        self,
        url: str,
        views: tuple[str, ...],
        chunk: int,
        layout: CommandLayout,
        mode: ActionMode,
        kinematics: Kinematics | None = None,
    ):
        super().__init__()
        place = urlparse(url)
        if place.scheme not in ("ws", "wss") or not place.hostname:
            raise PolicyServerError(
                f"url={url!r} must be the address of an openpi server, such as ws://127.0.0.1:8000"
            )
        if layout is CommandLayout.EEF and kinematics is None:
            raise PolicyServerError(
                "openpi policies say joints; a world of end-effector commands needs simulator.kinematics ({} is the bench)"
            )
        self.url, self.views, self.chunk, self.layout, self.mode, self.kinematics = (
            url,
            views,
            chunk,
            layout,
            mode,
            kinematics,
        )
        self.instructions: list[str] = []
        self._client = _connect(f"{place.scheme}://{place.hostname}", place.port)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the chunk float32 [B, K, A]."""
        rows = [
            self._ask(
                tensordict[IMAGE][row],
                tensordict[STATE][row],
                self.instructions[row] if self.instructions else "",
            )
            for row in range(len(tensordict))
        ]
        chunk = torch.stack(rows).to(tensordict.device or "cpu")
        if self.mode is ActionMode.RELATIVE:
            chunk = to_relative(chunk, tensordict[COMMAND])
        tensordict[CHUNK] = chunk
        return tensordict

    def _ask(self, image: Tensor, state: Tensor, words: str) -> Tensor:
        """Commands [K, A] of one episode, image uint8 [V, 3, H, W], state [16]."""
        seen: dict[str, Any] = {
            f"observation.images.{view}": image[k].permute(1, 2, 0).contiguous().cpu().numpy()
            for k, view in enumerate(self.views)
        }
        seen |= {
            "observation.state": Joints(state.cpu(), JointLayout.PER_ARM)
            .to(JointLayout.GRIPPERS_LAST)
            .numpy()
            .astype(np.float32),
            "prompt": words,
        }
        try:
            answer = self._client.infer(seen)
        except Exception as error:  # the client raises whatever the socket or the server did
            raise PolicyServerError(f"{self.url}: {type(error).__name__}: {error}") from error
        said = np.asarray(answer.get("actions") if isinstance(answer, dict) else None, dtype=np.float32)
        said = said[0] if said.ndim == 3 and len(said) == 1 else said
        if said.ndim != 2 or said.shape[1] != 16 or len(said) < self.chunk or not np.isfinite(said).all():
            raise PolicyServerError(
                f"{self.url} answered actions of shape {said.shape}, wanted at least {self.chunk} finite rows of 16 joints [L7,Lg,R7,Rg]"
            )
        rows = torch.from_numpy(np.array(said))
        if self.layout is CommandLayout.JOINTS:
            return compress(rows, self.chunk, CommandLayout.JOINTS)
        assert self.kinematics is not None
        return self.kinematics.flanges(
            Joints(compress(rows, self.chunk, CommandLayout.JOINTS), JointLayout.PER_ARM)
        )


def _connect(host: str, port: int | None) -> Any:
    """openpi's own client; it waits for a server for ever, so whether one listens is asked before."""
    from openpi_client.websocket_client_policy import WebsocketClientPolicy

    name = urlparse(host).hostname or ""
    try:
        socket.create_connection((name, port or 80), timeout=10).close()
    except OSError as error:
        raise PolicyServerError(f"no openpi server listens at {host}:{port} ({error})") from error
    return WebsocketClientPolicy(host, port)
