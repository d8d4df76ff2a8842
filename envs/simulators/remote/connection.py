"""One session on one server of GE-Sim's protocol."""

from __future__ import annotations

import contextlib
import json
import os
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import requests
from numpy.typing import NDArray

from envs.ranges import Natural, Positive
from envs.simulators.remote.protocol import (
    TOKEN,
    ProtocolError,
    decode_frame,
    encode_frame,
    floats,
    pack,
    parse,
    shape_in,
    unpack,
)

_LONGEST_PAUSE_S = 2.0  # between tries


class RemoteError(RuntimeError):
    """A world-model server cannot be reached, refused, failed, or said something that is not the protocol."""


@dataclass(frozen=True)
class ConnectionOptions:
    """How patient a connection is.

    Args:
        connect_s: seconds to wait for a connection.
        deadline_s: seconds to wait for an answer.
        retries: of calls that can be repeated without harm.
        user: name that sessions are opened under.
    """

    connect_s: Positive
    deadline_s: Positive
    retries: Natural
    user: str


@dataclass(frozen=True)
class Made:
    """What a server answered to /step: frames uint8 [K, V, 3, H, W], and states [K, S] if it has any."""

    url: str
    frames: NDArray[np.uint8]
    states: NDArray[np.float32] | None

    def frames_of(self, shape: tuple[int, ...]) -> NDArray[np.uint8]:
        """The frames, which must be [K, V, 3, H, W] as wanted.

        Raises:
            RemoteError: if they are not.
        """
        if self.frames.shape != shape:
            raise RemoteError(
                f"{self.url}/step answered frames {list(self.frames.shape)} [T,V,3,H,W], wanted"
                f" {list(shape)}; set task.chunk, task.size and the robot's cameras as the server's are"
            )
        return self.frames

    def states_of(self, shape: tuple[int, ...]) -> NDArray[np.float32]:
        """The states, which must be [K, S] as wanted; NaN if the server has none.

        Raises:
            RemoteError: if they are of another shape.
        """
        if self.states is None:
            return np.full(shape, np.nan, np.float32)
        if self.states.shape != shape:
            raise RemoteError(
                f"{self.url}/step answered states {list(self.states.shape)}, this robot's are {list(shape)}"
            )
        return self.states


class Connection:
    """One session on one server.

    Args:
        url: of the server.
        options: deadlines.
    """

    def __init__(self, url: str, options: ConnectionOptions):
        self.url, self.options = url.rstrip("/"), options
        self.http = requests.Session()
        if os.environ.get(TOKEN):
            self.http.headers["Authorization"] = f"Bearer {os.environ[TOKEN]}"
        self.client_id = ""
        self.chunks = 0

    def call(self, path: str, body: bytes | dict[str, Any] | None = None, repeat: bool = True) -> bytes:
        """What the server answers with status 200.

        Raises:
            RemoteError: with the server's own words if it refuses, or why there is no answer.
        """
        attempts = self.options.retries + 1 if repeat else 1
        for attempt in range(attempts):
            try:
                answer = self._send(path, body)
                break
            except requests.RequestException as error:
                nobody = "refused" in str(error).lower()  # nothing listens there: waiting does not help
                if nobody or attempt + 1 == attempts:
                    raise RemoteError(f"{self.url}{path}: {self._why(error, attempt + 1)}") from error
                time.sleep(min(_LONGEST_PAUSE_S, 0.2 * 2**attempt))
        if answer.status_code == 200:
            return answer.content
        try:
            reason = parse(answer.content).get("error", "")
        except ProtocolError:
            reason = answer.content[:200].decode("utf-8", "replace")
        if answer.status_code == 403 and self.client_id:
            reason = f"{reason}; the session was ended by the server or by another client's /init"
        raise RemoteError(f"{self.url}{path} answered {answer.status_code}: {reason or 'nothing'}")

    def _send(self, path: str, body: bytes | dict[str, Any] | None) -> requests.Response:
        timeout = (self.options.connect_s, self.options.deadline_s)
        if body is None:
            return self.http.get(self.url + path, timeout=timeout)
        if isinstance(body, dict):
            return self.http.post(self.url + path, json=body, timeout=timeout)
        kind = {"Content-Type": "application/octet-stream"}
        return self.http.post(self.url + path, data=body, headers=kind, timeout=timeout)

    def _why(self, error: requests.RequestException, tries: int) -> str:
        """Why there is no answer."""
        tried = f" after {tries} tries" if tries > 1 else ""
        detail = f"{type(error).__name__}: {error}"
        if isinstance(error, requests.ConnectTimeout):
            limit = f"simulator.connection.connect_s={self.options.connect_s:g}"
            return f"no connection within {limit}{tried} ({detail})"
        if isinstance(error, requests.Timeout):
            limit = f"simulator.connection.deadline_s={self.options.deadline_s:g}"
            return f"no answer within {limit}{tried} ({detail})"
        return f"no connection, or it broke{tried} ({detail})"

    def ask(self, path: str, body: dict[str, Any] | bytes | None = None) -> dict[str, Any]:
        """A JSON answer."""
        try:
            return parse(self.call(path, body))
        except ProtocolError as error:
            raise RemoteError(f"{self.url}{path} answered with no JSON object: {error}") from error

    def open(self, first: dict[str, NDArray[Any]], seed: int) -> None:
        """Begin an episode.

        Args:
            first: frames uint8 [V, 3, H, W] and state [S]; of calibrated cameras intrinsic [V, 3, 3] and c2w
                [V, 4, 4].
            seed: of the episode; like `bound`, `state` and `chunk` it is ours, and released servers overlook
                it.
        """
        # bound: if this process dies, the session ends with its connection
        answer = self.ask("/init", {"user_name": self.options.user, "seed": seed, "bound": True})
        client = answer.get("client_id")
        if not isinstance(client, str) or not client:
            raise RemoteError(f"{self.url}/init answered {answer} without a client_id")
        self.client_id, self.chunks = client, 0
        if "intrinsic" in first:
            cameras = {"intrinsic": first["intrinsic"].tolist(), "extrinsic": first["c2w"].tolist()}
            self.ask("/set_camera_params", {"client_id": client, **cameras})
        views, _, height, width = first["frames"].shape
        meta = {"client_id": client, "frame_shape": [3, views, height, width]}
        meta |= {name: first[name].tolist() for name in ("state", "command")}
        self.ask("/set_episode_data", pack([encode_frame(first["frames"]), _dump(meta)]))

    def step(self, future: dict[str, NDArray[Any]], repeatable: bool) -> Made:
        """One chunk.

        Args:
            future: commands [K, A]; of calibrated cameras pose_map uint8 [K, V, 3, H, W] and c2w [K, V, 4,
                4].
            repeatable: whether a lost answer may be asked for again.
        """
        if "c2w" in future:
            self._send_trajectory(future["pose_map"], future["c2w"])
        actions = future["commands"]
        meta = {"client_id": self.client_id, "action_shape": list(actions.shape), "chunk": self.chunks}
        answer = self.call("/step", pack([actions.astype("<f4").tobytes(), _dump(meta)]), repeat=repeatable)
        try:
            made = self._read(answer)
        except ProtocolError as error:
            raise RemoteError(
                f"{self.url}/step answered something that is not the protocol: {error}"
            ) from error
        self.chunks += 1
        return made

    def _send_trajectory(self, pose_map: NDArray[np.uint8], c2w: NDArray[np.float32]) -> None:
        count, views, _, height, width = pose_map.shape
        meta = {
            "client_id": self.client_id,
            "traj_shape": [3, views, count, height, width],
            "c2w_shape": [views, count, 4, 4],
        }
        pictures = pack([encode_frame(frame) for frame in pose_map])
        poses = c2w.transpose(1, 0, 2, 3).astype("<f4").tobytes()
        self.ask("/set_episode_traj", pack([pictures, poses, _dump(meta)]))

    def _read(self, answer: bytes) -> Made:
        blocks = unpack(answer)
        if not blocks:
            raise ProtocolError("the answer is empty")
        meta = parse(blocks[0])
        count, _, views, height, width = shape_in(meta, "frame_shape", "T,3,V,H,W")
        if len(blocks) != count + 2:
            raise ProtocolError(f"{count} frames were announced, {len(blocks) - 2} pictures came")
        frames = np.stack([decode_frame(block, views, height, width) for block in blocks[1:-1]])
        if meta.get("state_shape") is None:
            return Made(self.url, frames, None)
        return Made(self.url, frames, floats(blocks[-1], shape_in(meta, "state_shape", "T,S"), "state"))

    def close(self) -> None:
        """End the session; a server that is gone has ended it already."""
        if self.client_id:
            client, self.client_id = self.client_id, ""
            with contextlib.suppress(requests.RequestException):
                self.http.post(f"{self.url}/close", json={"client_id": client}, timeout=(1.0, 5.0))
        self.http.close()


def _dump(meta: dict[str, Any]) -> bytes:
    return json.dumps(meta).encode()
