"""Which rows of a sent trajectory a step of a served simulator is conditioned on."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from actors.serving.sessions import SessionHost
from tests.actors.serving import Running, Stranger, serve_config, tiny_world

ACTIONS = np.zeros((4, 14), np.float32)


class Watched:
    """A running server, and the rows of cameras that each step took."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch):
        world = tiny_world()
        self.rows: list[list[int]] = []
        step = world.step

        def watch(state: TensorDict, future: TensorDict) -> tuple[torch.Tensor, torch.Tensor, TensorDict]:
            self.rows.append(future["c2w"][0, :, 0, 0, 3].int().tolist())
            return step(state, future)

        monkeypatch.setattr(world, "step", watch)
        self.server = Running(SessionHost(world, None, serve_config(linger_ms=0.0), None, bf16=False))
        self.client = Stranger(self.server.url)
        self.client.prepare()

    def send(self, first: int, count: int) -> None:
        """A trajectory whose cameras are numbered from `first`."""
        c2w = np.tile(np.eye(4, dtype=np.float32), (3, count, 1, 1))
        c2w[:, :, 0, 3] = np.arange(first, first + count)
        maps = np.zeros((3, 3, count, 32, 32), np.float32)
        assert self.client.send("/set_episode_traj", self.client.trajectory(maps, c2w)).status_code == 200

    def begin(self) -> None:
        """A first frame."""
        frame = np.zeros((3, 3, 32, 32), np.float32)
        assert self.client.send("/set_episode_data", self.client.first_frame(frame)).status_code == 200


@pytest.fixture
def watched(monkeypatch: pytest.MonkeyPatch) -> Iterator[Watched]:
    made = Watched(monkeypatch)
    yield made
    made.server.stop()


def test_a_recording_of_less_than_two_chunks_goes_on_where_the_last_step_ended(watched: Watched) -> None:
    watched.send(0, 7)
    for _ in range(3):
        watched.client.step(ACTIONS)
    assert watched.rows == [[0, 1, 2, 3], [4, 5, 6, 6], [6, 6, 6, 6]]


def test_steps_shorter_than_a_chunk_take_the_frames_that_there_were(watched: Watched) -> None:
    watched.send(0, 12)
    for count in (3, 4, 1, 4):
        watched.client.step(ACTIONS[:count])
    assert watched.rows == [[0, 1, 2, 2], [3, 4, 5, 6], [7, 7, 7, 7], [8, 9, 10, 11]]


def test_what_is_sent_for_a_step_begins_with_it(watched: Watched) -> None:
    for first, count in ((0, 4), (10, 4), (20, 8)):
        watched.send(first, count)
        watched.client.step(ACTIONS)
    watched.client.step(ACTIONS)  # what was sent last reaches this far
    assert [rows[0] for rows in watched.rows] == [0, 10, 20, 24]


def test_a_trajectory_that_comes_before_the_first_frame_begins_with_the_episode(watched: Watched) -> None:
    watched.send(0, 8)
    watched.client.step(ACTIONS)
    watched.send(10, 8)
    watched.begin()
    for _ in range(2):
        watched.client.step(ACTIONS)
    assert [rows[0] for rows in watched.rows] == [0, 10, 14]
