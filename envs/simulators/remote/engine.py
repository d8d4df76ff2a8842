"""simulator=remote: any server of GE-Sim's protocol as a Simulator, its sessions being rows of our batch.

A released server holds one session, and a second /init ends the first; ours says in /healthz how many it
holds. So a batch needs as many places as it has rows, over one or several urls. What a server answered is
never guessed: a step that may or may not have happened is repeated only where the server says that it knows
repeats apart.
"""

from __future__ import annotations

import weakref
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict
from torch import Tensor

from envs.commanded_states import as_states, joints_are_states
from envs.conditioning import CANVAS
from envs.ranges import Count
from envs.simulators.base import Simulator
from envs.simulators.remote.connection import Connection, ConnectionOptions, RemoteError
from envs.simulators.state_experts.base import StateDecoder
from envs.specs import WorldSpec
from envs.targets import OptionsOf

_PARALLEL = 32  # calls at once


@dataclass(frozen=True)
class Place:
    """Where a server can hold one session: its url, and whether it knows repeated steps apart."""

    url: str
    repeatable: bool


class RemoteSimulator(Simulator):
    """A Simulator whose chunks are made by servers; it has no parameters.

    Sessions end on the servers when they are released, at `close`, and when this object or the process ends.

    Args:
        spec: as the servers show it; a wrong one is found at the first step.
        memory_frames: of the history that is kept here for the record; servers remember by themselves.
        urls: of servers, such as http://127.0.0.1:9000.
        connection: options of ConnectionOptions.

    Raises:
        ValueError: if there are no urls.
    """

    def __init__(
        self,
        spec: WorldSpec,
        memory_frames: Count,
        urls: tuple[str, ...],
        connection: Annotated[dict[str, Any], OptionsOf(ConnectionOptions)],
    ):
        super().__init__(spec, memory_frames)
        if not urls or any(not url.startswith(("http://", "https://")) for url in urls):
            raise ValueError(
                f"simulator.urls={list(urls)} must be one or more http addresses, as in"
                " simulator.urls=[http://127.0.0.1:9000]"
            )
        self.urls, self.options = tuple(urls), ConnectionOptions(**connection)
        self.feature_shape = (spec.chunk, spec.state_dim)
        self._connections: dict[int, Connection] = {}
        self._places: list[Place] = []
        self._rows: list[int] = []
        self._pool = ThreadPoolExecutor(_PARALLEL)
        self._end = weakref.finalize(self, _close_all, self._connections)

    @property
    def free_places(self) -> int:
        """See Simulator.free_places; as many as servers say that they hold, less the sessions that are open.

        Raises:
            RemoteError: if a server does not answer.
        """
        return len(self._free()[1])

    def resume(
        self, past: TensorDict, length: Tensor, seed: Tensor, capacity: int = 1, stride: int = 1
    ) -> TensorDict:
        """See Simulator.resume; opens a session for every row, or for none.

        Raises:
            RemoteError: if the servers do not have that many places, or refuse; if more than one frame or
                another stride is given, which the protocol has no word for.
        """
        if stride != 1:
            raise RemoteError(f"a server's sessions show every frame, and stride={stride} was asked for")
        if bool((length > 1).any()):
            raise RemoteError("a server's sessions begin with one frame; set rl.starts=first")
        state, first = super().resume(past, length, seed, capacity, stride), past[:, 0]
        places, free = self._free()
        if len(free) < len(first):
            raise RemoteError(
                f"{len(first)} sessions are wanted, the servers at simulator.urls hold {len(free)} more; add"
                " urls, or run fewer episodes side by side"
            )
        mine = {number: Connection(places[number].url, self.options) for number in free[: len(first)]}
        jobs = [
            self._pool.submit(connection.open, _numpy(first[row]), int(seed[row]))
            for row, connection in enumerate(mine.values())
        ]
        try:
            _results(jobs)
        except BaseException:
            _close_all(mine)
            raise
        state["session"] = torch.tensor(list(mine), device=state["seed"].device)
        self._connections.update(mine)
        return state

    def release(self, state: TensorDict, mask: Tensor) -> None:
        """See Simulator.release; their sessions end on the servers."""
        for number in state["session"][mask.to(state["session"].device)].tolist():
            if number in self._connections:
                self._connections.pop(number).close()

    def step(self, state: TensorDict, future: TensorDict) -> tuple[Tensor, Tensor, TensorDict]:
        """See Simulator.step."""
        self._rows = state["session"].tolist()
        return super().step(state, future)

    def predict(self, inputs: TensorDict) -> tuple[Tensor, Tensor]:
        """See Simulator.predict; all sessions at once, so that a server can batch them. Features are the
        servers' joint states [B, K, S], NaN where a server has none.
        """
        jobs = []
        for row, number in enumerate(self._rows):
            future = _numpy(inputs["future"][row])
            if (
                self.spec.embodiment.calibrated and "pose_map" not in future
            ):  # the protocol sends both or none
                blank = (self.spec.chunk, self.spec.views, 3, *self.spec.size)
                future["pose_map"] = np.full(blank, CANVAS, np.uint8)
            jobs.append(
                self._pool.submit(self._connections[number].step, future, self._places[number].repeatable)
            )
        shape = (self.spec.chunk, self.spec.views, 3, *self.spec.size)
        device, frames, states = inputs["future", "commands"].device, [], []
        for made in _results(jobs):
            frames.append(made.frames_of(shape))
            states.append(made.states_of(self.feature_shape))
        return (
            torch.from_numpy(np.stack(frames)).to(device),
            torch.from_numpy(np.stack(states)).to(device),
        )

    def features(self, inputs: TensorDict) -> Tensor:
        """Refused: a server says nothing of what its network makes of inputs, and each step counts.

        Raises:
            RemoteError: always.
        """
        raise RemoteError(
            "simulator=remote has no features to learn from; choose a simulator that runs here, or a judge"
            " that looks at pictures, such as judge=learned"
        )

    def close(self) -> None:
        """End all sessions on the servers."""
        _close_all(self._connections)

    def _free(self) -> tuple[list[Place], list[int]]:
        """All places, and the numbers of those that hold no session. Servers are asked once."""
        if not self._places:
            found: list[Place] = []
            for url in self.urls:
                health = Connection(url, self.options).ask("/healthz")
                if health.get("status") != "ok":
                    raise RemoteError(f"{url}/healthz says {health}")
                place = Place(url, bool(health.get("repeatable", False)))
                found += [place] * int(health.get("sessions", 1))
            self._places = found
        free = [number for number in range(len(self._places)) if number not in self._connections]
        return self._places, free


def _numpy(row: TensorDict) -> dict[str, NDArray[Any]]:
    return {name: value.cpu().numpy() for name, value in row.items()}


def _results(jobs: list[Future]) -> list[Any]:
    """Results of all jobs, once all have ended; the first error, if there is one."""
    wait(jobs)
    return [job.result() for job in jobs]


def _close_all(connections: dict[int, Connection]) -> None:
    while connections:
        connections.popitem()[1].close()


class GivenStates(StateDecoder):
    """Joint states that came with the frames; where a server has none, the command in force stands in, if it
    is all the joints of the state by their names.

    Args:
        simulator: whose features are states.
    """

    normalised = True

    def __init__(self, simulator: Simulator):
        super().__init__(1)
        self.robot = simulator.spec.embodiment

    def decode(
        self, features: Tensor, commands: Tensor, history: TensorDict, seed: Tensor, chunk_index: Tensor
    ) -> Tensor:
        """See StateDecoder.decode.

        Raises:
            RemoteError: if there are no states, and commands are none either.
        """
        known = torch.isfinite(features)
        if known.all():
            return features
        if not joints_are_states(self.robot):
            raise RemoteError(
                "the server decodes no joint states, and this robot's commands are no joints with the names"
                f" of its state, {list(self.robot.state_names)}; serve a world with a state decoder"
            )
        return torch.where(known, features, as_states(self.robot, commands))
