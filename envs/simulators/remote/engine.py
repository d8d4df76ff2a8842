"""simulator=remote: any server of GE-Sim's protocol as a Simulator, its sessions being rows of our batch.

A released server holds one session, and a second /init ends the first; ours says in /healthz how many it
holds. So a
batch needs as many places as it has rows, over one or several urls. What a server answered is never guessed:
a step
that may or may not have happened is repeated only where the server says that it knows repeats apart.
"""

from __future__ import annotations

import json
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
import requests
import torch
from tensordict import TensorDict
from torch import Tensor

from envs.simulators.base import Simulator, WorldShape
from envs.simulators.remote.protocol import (
    ProtocolError,
    decode_frame,
    encode_frame,
    floats,
    pack,
    parse,
    shape_in,
    unpack,
)
from envs.simulators.state_experts.base import StateDecoder
from envs.specs import STATE_DIM


class RemoteError(RuntimeError):
    """A world-model server cannot be reached, refused, failed, or said something that is not the protocol."""


@dataclass(frozen=True)
class RemoteConfig:
    """Where the worlds are.

    Args:
        urls: of servers, such as http://127.0.0.1:9000.
        connect_s: seconds to wait for a connection.
        deadline_s: seconds to wait for an answer.
        retries: of calls that can be repeated without harm.
        user: name that sessions are opened under.
    """

    urls: tuple[str, ...] = ()
    connect_s: float = 10.0
    deadline_s: float = 300.0
    retries: int = 3
    user: str = "worldloop"

    def __post_init__(self) -> None:
        if not self.urls or any(not url.startswith(("http://", "https://")) for url in self.urls):
            raise ValueError(
                f"urls={list(self.urls)} must be one or more http addresses, as in simulator.model.urls=[http://127.0.0.1:9000]"
            )


class Connection:
    """One session on one server.

    Args:
        url: of the server.
        config: deadlines.
    """

    def __init__(self, url: str, config: RemoteConfig):
        self.url, self.config = url.rstrip("/"), config
        self.http = requests.Session()
        self.client_id = ""
        self.chunks = 0

    def call(self, path: str, body: bytes | dict[str, Any] | None = None, repeat: bool = True) -> bytes:
        """What the server answers with status 200.

        Raises:
            RemoteError: if it does not.
        """
        attempts = self.config.retries + 1 if repeat else 1
        for attempt in range(attempts):
            try:
                timeout = (self.config.connect_s, self.config.deadline_s)
                if body is None:
                    answer = self.http.get(self.url + path, timeout=timeout)
                elif isinstance(body, dict):
                    answer = self.http.post(self.url + path, json=body, timeout=timeout)
                else:
                    answer = self.http.post(
                        self.url + path,
                        data=body,
                        headers={"Content-Type": "application/octet-stream"},
                        timeout=timeout,
                    )
                break
            except requests.RequestException as error:
                if attempt + 1 == attempts:
                    tried = f" after {attempts} tries" if attempts > 1 else ""
                    raise RemoteError(
                        f"{self.url}{path}: no answer within simulator.model.deadline_s={self.config.deadline_s:g}{tried} ({type(error).__name__}: {error})"
                    ) from error
                time.sleep(min(2.0, 0.2 * 2**attempt))
        if answer.status_code == 200:
            return answer.content
        try:
            said = parse(answer.content).get("error", "")
        except ProtocolError:
            said = answer.content[:200].decode("utf-8", "replace")
        if answer.status_code == 403 and self.client_id:
            said = f"{said}; the session was ended by the server or by another client's /init"
        raise RemoteError(f"{self.url}{path} answered {answer.status_code}: {said or 'nothing'}")

    def ask(self, path: str, body: dict[str, Any] | bytes | None = None) -> dict[str, Any]:
        """A JSON answer."""
        try:
            return parse(self.call(path, body))
        except ProtocolError as error:
            raise RemoteError(f"{self.url}{path} answered with no JSON object: {error}") from error

    def open(
        self, frame: np.ndarray, intrinsic: np.ndarray, c2w: np.ndarray, state: np.ndarray, seed: int
    ) -> None:
        """Begin an episode: frame uint8 [V, 3, H, W], intrinsic [V, 3, 3], c2w [V, 4, 4], state [16]; the
        last two and the seed are said to servers that know them.
        """
        # `seed`, `state` and `chunk` are ours; released servers overlook them.
        answer = self.ask("/init", {"user_name": self.config.user, "seed": seed})
        client = answer.get("client_id")
        if not isinstance(client, str) or not client:
            raise RemoteError(f"{self.url}/init answered {answer} without a client_id")
        self.client_id, self.chunks = client, 0
        self.ask(
            "/set_camera_params",
            {"client_id": client, "intrinsic": intrinsic.tolist(), "extrinsic": c2w.tolist()},
        )
        views, _, height, width = frame.shape
        self.ask(
            "/set_episode_data",
            pack(
                [
                    encode_frame(frame),
                    _dump(
                        {
                            "client_id": client,
                            "frame_shape": [3, views, height, width],
                            "state": state.tolist(),
                        }
                    ),
                ]
            ),
        )

    def step(
        self, actions: np.ndarray, pose_map: np.ndarray, c2w: np.ndarray, repeatable: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        """One chunk: actions [K, A], pose_map uint8 [K, V, 3, H, W], c2w [K, V, 4, 4] -> frames uint8 [K, V,
        3, H, W] and states [K, 16], NaN where the server has none.
        """
        count, views, _, height, width = pose_map.shape
        meta = {
            "client_id": self.client_id,
            "traj_shape": [3, views, count, height, width],
            "c2w_shape": [views, count, 4, 4],
        }
        self.ask(
            "/set_episode_traj",
            pack(
                [
                    pack([encode_frame(frame) for frame in pose_map]),
                    c2w.transpose(1, 0, 2, 3).astype("<f4").tobytes(),
                    _dump(meta),
                ]
            ),
        )
        body = pack(
            [
                actions.astype("<f4").tobytes(),
                _dump(
                    {"client_id": self.client_id, "action_shape": list(actions.shape), "chunk": self.chunks}
                ),
            ]
        )
        answer = self.call("/step", body, repeat=repeatable)
        try:
            made = self._read(answer, count, views, height, width)
        except ProtocolError as error:
            raise RemoteError(
                f"{self.url}/step answered something that is not the protocol: {error}"
            ) from error
        self.chunks += 1
        return made

    @staticmethod
    def _read(
        answer: bytes, count: int, views: int, height: int, width: int
    ) -> tuple[np.ndarray, np.ndarray]:
        blocks = unpack(answer)
        if not blocks:
            raise ProtocolError("the answer is empty")
        said = parse(blocks[0])
        shape = shape_in(said, "frame_shape", "T,3,V,H,W")
        if shape != (count, 3, views, height, width) or len(blocks) != count + 2:
            raise ProtocolError(
                f"frames {list(shape)} in {len(blocks) - 2} pictures, wanted {[count, 3, views, height, width]}; set task.chunk, task.views and task.size as the server's are"
            )
        frames = np.stack([decode_frame(block, views, height, width) for block in blocks[1:-1]])
        if said.get("state_shape") is None:
            return frames, np.full((count, STATE_DIM), np.nan, np.float32)
        return frames, floats(blocks[-1], shape_in(said, "state_shape", f"{count},{STATE_DIM}"), "state")

    def close(self) -> None:
        """End the session; a server that is gone has ended it already."""
        if self.client_id:
            client, self.client_id = self.client_id, ""
            try:
                self.http.post(f"{self.url}/close", json={"client_id": client}, timeout=(1.0, 5.0))
            except requests.RequestException:
                return


def _dump(meta: dict[str, Any]) -> bytes:
    return json.dumps(meta).encode()


class RemoteSimulator(Simulator):
    """A Simulator whose chunks are made by servers.

    Args:
        shape: as the servers show it; a wrong one is found at the first step.
        config: where they are.
    """

    def __init__(self, shape: WorldShape, config: RemoteConfig):
        super().__init__(shape)
        self.config = config
        self.feature_shape = (shape.chunk, STATE_DIM)
        self._connections: dict[int, Connection] = {}
        # per place its url, and whether steps there can be repeated
        self._places: list[tuple[str, bool]] | None = None
        self._rows: list[int] = []
        self._pool = ThreadPoolExecutor(32)

    def _free(self) -> list[int]:
        """Numbers of the places that hold no session."""
        if self._places is None:
            self._places = []
            for url in self.config.urls:
                health = Connection(url, self.config).ask("/healthz")
                if health.get("status") != "ok":
                    raise RemoteError(f"{url}/healthz says {health}")
                self._places += [(url, bool(health.get("repeatable", False)))] * int(
                    health.get("sessions", 1)
                )
        return [number for number in range(len(self._places)) if number not in self._connections]

    def reset(
        self,
        frames: Tensor,
        intrinsic: Tensor,
        c2w: Tensor,
        command: Tensor,
        state: Tensor,
        pose_map: Tensor,
        seed: Tensor,
        *,
        likeliest: bool = False,
        capacity: int = 1,
    ) -> TensorDict:
        """See Simulator; opens a session for every row.

        Raises:
            RemoteError: if the servers do not have that many places.
        """
        fresh = super().reset(
            frames, intrinsic, c2w, command, state, pose_map, seed, likeliest=likeliest, capacity=capacity
        )
        free = self._free()
        if len(free) < len(frames):
            raise RemoteError(
                f"{len(frames)} sessions are wanted, the servers at simulator.model.urls hold {len(free)}; add urls, or run fewer episodes side by side"
            )
        assert self._places is not None
        mine = free[: len(frames)]
        for number in mine:
            self._connections[number] = Connection(self._places[number][0], self.config)
        jobs = [
            self._pool.submit(
                self._connections[number].open,
                frames[row].cpu().numpy(),
                intrinsic[row].cpu().numpy(),
                c2w[row].cpu().numpy(),
                state[row].cpu().numpy(),
                int(seed[row]),
            )
            for row, number in enumerate(mine)
        ]
        for job in jobs:
            job.result()
        fresh["session"] = torch.tensor(mine)
        return fresh

    def release(self, state: TensorDict, mask: Tensor) -> None:
        """See Simulator; their sessions end."""
        for number in state["session"][mask.to(state["session"].device)].tolist():
            if number in self._connections:
                self._connections.pop(number).close()

    def step(
        self, state: TensorDict, commands: Tensor, pose_map: Tensor, c2w: Tensor
    ) -> tuple[Tensor, Tensor, TensorDict]:
        """See Simulator."""
        self._rows = state["session"].tolist()
        return super().step(state, commands, pose_map, c2w)

    def predict(self, inputs: TensorDict) -> tuple[Tensor, Tensor]:
        """See Simulator; all sessions at once, so that a server can batch them. Features are the servers'
        joint states.
        """
        assert self._places is not None
        future = inputs["future"]
        sent = [future[name].cpu().numpy() for name in ("commands", "pose_map", "c2w")]
        jobs = [
            self._pool.submit(
                self._connections[number].step,
                sent[0][row],
                sent[1][row],
                sent[2][row],
                self._places[number][1],
            )
            for row, number in enumerate(self._rows)
        ]
        answers = [job.result() for job in jobs]
        frames, states = (torch.from_numpy(np.stack(values)) for values in zip(*answers, strict=True))
        return frames, states

    def close(self) -> None:
        """End all sessions."""
        for connection in self._connections.values():
            connection.close()
        self._connections = {}


class GivenStates(StateDecoder):
    """Joint states that came with the frames; the command in force stands in where a server has none, if it
    is joints.
    """

    normalised = True

    def __init__(self, chunk: int):
        super().__init__(1)
        self.chunk = chunk

    def decode(
        self,
        features: Tensor,
        commands: Tensor,
        past_commands: Tensor,
        past_states: Tensor,
        seed: Tensor,
        chunk_index: Tensor,
    ) -> Tensor:
        """See StateDecoder.

        Raises:
            RemoteError: if there are no states, and commands are none either.
        """
        if torch.isfinite(features).all():
            return features
        if commands.shape[-1] != STATE_DIM:
            raise RemoteError(
                "the server decodes no joint states, and simulator.layout=eef has no others; serve a world with a state decoder"
            )
        return torch.where(torch.isfinite(features), features, commands)
