"""simulator=remote: a served world is an ordinary Simulator, and what goes wrong on the other side has a
name.
"""

from __future__ import annotations

import gc
import json
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import requests
import torch
from tensordict import TensorDict
from torch import Tensor

from actors.serving.sessions import SessionHost
from envs.embodiment import Embodiment
from envs.episodes.clips import ClipStore
from envs.simulators import memory
from envs.simulators.base import Simulator
from envs.simulators.dit.engine import DiTSimulator
from envs.simulators.remote.engine import GivenStates, RemoteError, RemoteSimulator
from envs.simulators.remote.protocol import decode_frame, encode_frame
from envs.simulators.replay import replay
from envs.simulators.state_experts.base import StateDecoder
from envs.specs import WorldSpec
from tests.actors.serving import Running, serve_config, tiny_expert, tiny_world
from tests.embodiments import ARM_DELTAS, BIMANUAL_JOINTS, BIMANUAL_POSES, world_spec
from tests.envs.simulators.clips import blocks, clip, first_of, future_of

CONNECTION: dict[str, Any] = {"connect_s": 10.0, "deadline_s": 60.0, "retries": 1, "user": "test"}
ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def near() -> DiTSimulator:
    return tiny_world()


@pytest.fixture
def server(near: DiTSimulator) -> Iterator[Running]:
    running = Running(SessionHost(near, tiny_expert(near), serve_config(sessions=3), bf16=False))
    yield running
    running.stop()


def remote(*urls: str, of: Simulator, **options: Any) -> RemoteSimulator:
    return RemoteSimulator(of.spec, of.memory_frames, urls, CONNECTION | options)


def begin(spec: WorldSpec, rows: int) -> TensorDict:
    """What sessions begin with, [rows]; JPEG keeps its pictures, so that both sides see the same."""
    first = first_of(spec, clip(spec, rows, 3))
    first["frames"] = blocks(first["frames"].shape, torch.Generator().manual_seed(0))
    return first


def following(spec: WorldSpec, rows: int, number: int = 0) -> TensorDict:
    """What chunk `number` of these sessions is asked for, [rows]."""
    return future_of(spec, clip(spec, rows, 3, chunks=2), number)


def through_jpeg(values: Tensor) -> Tensor:
    """Pictures [..., V, 3, H, W] as the other side sees them."""
    views, _, height, width = values.shape[-4:]
    rows = [decode_frame(encode_frame(row.numpy()), views, height, width) for row in values.flatten(0, -5)]
    return torch.from_numpy(np.stack(rows)).reshape(values.shape)


def run(
    world: Simulator, decoder: StateDecoder, batch: int, steps: int = 2
) -> tuple[list[Tensor], list[Tensor]]:
    most = 3  # the first rows of which are the same for any batch
    state = world.reset(begin(world.spec, most)[:batch], torch.arange(batch) + 3)
    frames, states = [], []
    for step in range(steps):
        made, features, state = world.step(state, following(world.spec, most, step)[:batch])
        frames.append(made)
        states.append(decoder.follow(state, world.spec.chunk, features))
    return frames, states


@pytest.mark.parametrize("robot", ["two_arms_poses", "one_arm_deltas"])
def test_a_served_world_is_the_world_but_for_jpegs(robot: str) -> None:
    world = tiny_world(robot)
    expert = tiny_expert(world)
    server = Running(SessionHost(world, expert, serve_config(), bf16=False))
    try:
        far = remote(server.url, of=world)
        assert list(far.parameters()) == [] and far.device == torch.device("cpu")
        frames, states = run(far, GivenStates(far), 2)
        assert server.host.steps == 4 and server.host.passes <= 4
        # The same session by hand, from the pictures that the server was sent.
        spec, first = world.spec, begin(world.spec, 3)[:2]
        first["frames"] = through_jpeg(first["frames"])
        maps = [following(spec, 3, step)[:2] for step in range(2)]
        for future in maps:
            if spec.pose_map:
                future["pose_map"] = through_jpeg(future["pose_map"])
        if spec.pose_map:  # what a session begins with is not sent; as released, it is the first command's
            first["pose_map"] = maps[0]["pose_map"][:, 0]
        alone = world.reset(first[1:], torch.tensor([4]))
        for step, future in enumerate(maps):
            made, features, alone = world.step(alone, future[1:])
            wanted = expert.follow(alone, spec.chunk, features)
            # In another batch the last bits of sums differ, by which JPEG rounds some blocks another way.
            shown = through_jpeg(made)[0].float()
            assert (shown - frames[step][1].float()).abs().mean() < 1.0
            assert (shown - frames[step][0].float()).abs().mean() > 10.0  # another session's
            assert torch.allclose(wanted[0], states[step][1], atol=1e-3)
    finally:
        server.stop()


def test_the_same_client_gets_the_same_bits_alone_and_in_company(server: Running, near: DiTSimulator) -> None:
    far = remote(server.url, of=near)
    one, _ = run(far, GivenStates(far), 1)
    far.close()
    two, _ = run(far, GivenStates(far), 1)
    far.close()
    assert all(torch.equal(*pair) for pair in zip(one, two, strict=True))
    three, _ = run(far, GivenStates(far), 3)
    alike = [(a[0].int() - b[0].int()).abs().float().mean() for a, b in zip(one, three, strict=True)]
    assert max(alike) < 0.3  # of 255: other batches round otherwise


def test_partial_resets_end_the_sessions_they_replace(server: Running, near: DiTSimulator) -> None:
    far = remote(server.url, of=near)
    state = far.reset(begin(far.spec, 2), torch.tensor([1, 2]))
    kept = set(server.host.sessions)
    assert len(kept) == 2
    mask = torch.tensor([True, False])
    far.release(state, mask)
    state = memory.replace(state, mask, far.reset(begin(far.spec, 1), torch.tensor([3])))
    assert len(server.host.sessions) == 2 and len(kept & set(server.host.sessions)) == 1
    assert far.step(state, following(far.spec, 2))[0].shape[0] == 2


def test_more_rows_than_places_and_many_urls(server: Running, near: DiTSimulator) -> None:
    first, seeds = begin(near.spec, 4), torch.arange(4)
    with pytest.raises(RemoteError, match=r"4 sessions are wanted, the servers at simulator\.urls hold 3"):
        remote(server.url, of=near).reset(first, seeds)
    second = Running(SessionHost(near, None, serve_config(sessions=1), bf16=False))
    try:
        far = remote(server.url, second.url, of=near)
        state = far.reset(first, seeds)
        frames, features, _ = far.step(state, following(far.spec, 4))
        assert frames.shape[0] == 4 and len(second.host.sessions) == 1
        assert torch.isfinite(features[:3]).all() and features[3].isnan().all()  # the second has no decoder
    finally:
        second.stop()
    with pytest.raises(ValueError, match=r"simulator\.urls"):
        remote(of=near)


def test_a_replay_takes_no_more_places_than_there_are_and_leaves_them_free(
    server: Running, tiny_store: Callable[[Embodiment], ClipStore]
) -> None:
    store = tiny_store(BIMANUAL_POSES)
    far = RemoteSimulator(store.spec, 3, (server.url,), CONNECTION)
    assert far.free_places == 3
    for opened in (5, 10):  # five episodes in three places, and again
        made = replay(far, store, torch.arange(5), GivenStates(far), bf16=False, most=1)
        assert made.frames.shape[:2] == (5, store.spec.chunk)
        assert server.host.opened == opened and server.host.sessions == {}
    far.reset(store.first(torch.tensor([0])), torch.tensor([0]))
    assert far.free_places == 2


def test_a_reset_that_fails_leaves_nothing_behind(server: Running, near: DiTSimulator) -> None:
    url, httpd = strange_server(lambda *_: (503, b'{"error": "all places are taken"}'))
    try:
        far = remote(server.url, url, of=near)
        with pytest.raises(RemoteError, match="/init answered 503: all places are taken"):
            far.reset(begin(far.spec, 4), torch.arange(4))
        assert server.host.sessions == {}
        state = far.reset(begin(far.spec, 3), torch.arange(3))  # the three places that do work
        assert far.step(state, following(far.spec, 3))[0].shape[0] == 3
        # A server that is not there yet when it is first asked is there later.
        late = remote("http://127.0.0.1:9", server.url, of=near)
        for _ in range(2):
            with pytest.raises(RemoteError, match="no connection"):
                late.reset(begin(far.spec, 1), torch.arange(1))
        assert late._places == []
    finally:
        httpd.shutdown()


def test_sessions_end_with_their_simulator_and_its_process(server: Running, near: DiTSimulator) -> None:
    far = remote(server.url, of=near)
    far.reset(begin(far.spec, 1), torch.arange(1))
    far.close()
    assert server.host.sessions == {}
    far.reset(begin(far.spec, 1), torch.arange(1))
    del far
    gc.collect()
    assert server.host.sessions == {}
    code = (
        "import torch; from tests.actors.test_remote import *; spec = world_spec(BIMANUAL_POSES);"
        f"far = RemoteSimulator(spec, 3, ('{server.url}',), CONNECTION);"
        "far.reset(begin(spec, 2), torch.arange(2)); print('open', flush=True)"
    ).replace("BIMANUAL_POSES", "__import__('tests.embodiments').embodiments.BIMANUAL_POSES")
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.stdout == "open\n", done.stderr
    assert server.host.opened == 4 and server.host.sessions == {}


def strange_server(answer: Callable[[str, bytes], tuple[int, bytes]]) -> tuple[str, ThreadingHTTPServer]:
    """Something that listens and answers POSTs as told."""

    class Handler(BaseHTTPRequestHandler):
        def log_message(self, *_: object) -> None: ...

        def say(self, status: int, body: bytes) -> None:
            self.send_response(status)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def do_GET(self) -> None:
            self.say(200, b'{"status": "ok"}')

        def do_POST(self) -> None:
            self.say(*answer(self.path, self.rfile.read(int(self.headers["Content-Length"]))))

    httpd = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=httpd.serve_forever, daemon=True).start()
    return f"http://127.0.0.1:{httpd.server_address[1]}", httpd


@pytest.mark.parametrize(
    ("path", "status", "body", "message"),
    [
        ("/init", 500, b'{"error": "out of memory"}', "/init answered 500: out of memory"),
        ("/init", 200, b"<html>", "no JSON object"),
        ("/init", 200, b"{}", "without a client_id"),
        ("/step", 500, b"\xff\xfe", "/step answered 500"),
        ("/step", 403, b'{"error": "unknown client_id"}', "ended by the server or by another client"),
        ("/step", 200, b"", "the answer is empty"),
        ("/step", 200, b"\0\0\0\x05{}", "announces 5 bytes"),
        (
            "/step",
            200,
            b'\0\0\0\x3f{"frame_shape": [25, 3, 3, 384, 512], "state_shape": [25, 16]} ',
            r"announced, -1 pictures|task\.chunk",
        ),
    ],
)
def test_servers_that_answer_nonsense(path: str, status: int, body: bytes, message: str) -> None:
    def answer(asked: str, _: bytes) -> tuple[int, bytes]:
        return (status, body) if asked == path else (200, json.dumps({"client_id": "x"}).encode())

    url, httpd = strange_server(answer)
    try:
        far = RemoteSimulator(world_spec(ARM_DELTAS), 3, (url,), CONNECTION)
        with pytest.raises(RemoteError, match=message):
            state = far.reset(begin(far.spec, 1), torch.zeros(1, dtype=torch.int64))
            far.step(state, following(far.spec, 1))
    finally:
        httpd.shutdown()


def test_servers_that_never_answer_and_that_are_not_there(near: DiTSimulator) -> None:
    # type: ignore[func-returns-value]
    url, httpd = strange_server(lambda *_: (time.sleep(12), (200, b"{}"))[1])
    first, seed = begin(near.spec, 1), torch.zeros(1, dtype=torch.int64)
    try:
        began = time.monotonic()
        with pytest.raises(RemoteError, match=r"deadline_s=0\.3 after 2 tries"):
            remote(url, of=near, deadline_s=0.3).reset(first, seed)
        assert time.monotonic() - began < 11
    finally:
        httpd.shutdown()
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        port = s.getsockname()[1]
    began = time.monotonic()
    with pytest.raises(RemoteError, match="no connection") as refused:
        remote(f"http://127.0.0.1:{port}", of=near, retries=5).reset(first, seed)
    assert time.monotonic() - began < 1.0 and "deadline" not in str(refused.value)


def test_a_refusal_is_told_at_once_in_the_servers_words(near: DiTSimulator) -> None:
    server = Running(SessionHost(near, None, serve_config(body_mb=0.0003), bf16=False))
    try:
        began = time.monotonic()
        with pytest.raises(RemoteError, match=r"413.*serve\.body_mb=0\.0003"):
            remote(server.url, of=near, retries=5).reset(begin(near.spec, 1), torch.zeros(1).long())
        assert time.monotonic() - began < 1.0 and server.host.sessions == {}
    finally:
        server.stop()


def test_a_lost_answer_is_asked_for_again_where_that_is_safe(
    server: Running, near: DiTSimulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    far = remote(server.url, of=near)
    state = far.reset(begin(far.spec, 1), torch.arange(1))
    post, lost = requests.Session.post, []

    def flaky(self: requests.Session, url: str, **more: object) -> requests.Response:
        answer = post(self, url, **more)  # type: ignore[arg-type]
        if url.endswith("/step") and not lost:
            lost.append(url)
            raise requests.ConnectionError("the line broke after the step was made")
        return answer

    monkeypatch.setattr(requests.Session, "post", flaky)
    far.step(state, following(far.spec, 1))
    (session,) = server.host.sessions.values()
    assert lost and session.chunk == 1


def test_given_states_need_states_or_joints(near: DiTSimulator) -> None:
    nothing, commands = torch.full((1, 4, 16), torch.nan), torch.randn(1, 4, 16)
    zero, none = torch.zeros(1, dtype=torch.int64), TensorDict({}, [1])
    joints = RemoteSimulator(world_spec(BIMANUAL_JOINTS), 3, ("http://127.0.0.1:9",), CONNECTION)
    assert torch.equal(GivenStates(joints).decode(nothing, commands, none, zero, zero), commands)
    with pytest.raises(RemoteError, match="no joint states"):
        GivenStates(near).decode(nothing[..., :14], commands[..., :14], none, zero, zero)
