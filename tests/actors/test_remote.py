"""simulator=remote: a served world is an ordinary WorldEnv, and what goes wrong on the other side has a name."""

from __future__ import annotations

import json
import socket
import threading
import time
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import pytest
import torch
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs

from actors.serving.sessions import ServeConfig, SessionHost
from envs.episodes.clips import ClipStore
from envs.judges import LearnedJudge
from envs.simulators.base import WorldShape
from envs.simulators.remote.engine import GivenStates, RemoteConfig, RemoteError, RemoteSimulator
from envs.simulators.state_experts.head import StateHead
from envs.simulators.unet.engine import UNetSimulator
from envs.specs import CHUNK, EPISODE, IMAGE, STATE, Rewards
from envs.transforms import world_transforms
from envs.world import InitialStates, WorldEnv
from tests.actors.serving import Running

SHAPE = WorldShape(chunk=4, sides=())


@pytest.fixture
def decoder(simulator: UNetSimulator) -> StateHead:
    torch.manual_seed(1)
    return StateHead(simulator.feature_shape[0], 4, 4).eval()


@pytest.fixture
def server(simulator: UNetSimulator, decoder: StateHead) -> Iterator[Running]:
    running = Running(SessionHost(simulator, decoder, ServeConfig(sessions=3, linger_ms=100.0), bf16=False))
    yield running
    running.stop()


def world(simulator: object, decoder: object, store: ClipStore, batch: int) -> TransformedEnv:
    torch.manual_seed(2)
    # type: ignore[arg-type]
    base = WorldEnv(simulator, InitialStates.of(store), batch, horizon=8, bf16=False)
    # type: ignore[arg-type]
    return TransformedEnv(base, world_transforms(decoder, LearnedJudge(3, 4), Rewards(), store.views))


def test_a_served_world_is_the_world_up_to_jpeg(
    server: Running, simulator: UNetSimulator, decoder: StateHead, store: ClipStore
) -> None:
    far, near = (
        world(RemoteSimulator(SHAPE, RemoteConfig((server.url,))), GivenStates(4), store, 2),
        world(simulator, decoder, store, 2),
    )
    torch.manual_seed(3)
    actions = 0.05 * torch.randn(2, 2, 4, 14)
    last = []
    for env in (far, near):
        env.base_env.schedule([1, 2])
        now = env.reset()
        for chunk in actions:
            now[CHUNK] = chunk
            now = env.step(now)["next"]
        last.append(now)
    assert torch.equal(last[0][EPISODE], last[1][EPISODE])
    assert (last[0][IMAGE].float() - last[1][IMAGE].float()).abs().mean() < 6
    assert (last[0][STATE] - last[1][STATE]).abs().mean() < 0.1
    assert server.host.steps == 4 and server.host.passes <= 3


def test_specs_and_partial_resets(server: Running, store: ClipStore) -> None:
    env = world(RemoteSimulator(SHAPE, RemoteConfig((server.url,))), GivenStates(4), store, 2)
    check_env_specs(env)
    env.base_env.schedule([1, 2, 3])
    now = env.reset()
    kept = set(server.host.sessions)
    assert len(kept) == 2
    now["_reset"] = torch.tensor([[True], [False]])
    env.reset(now)
    assert len(server.host.sessions) == 2 and len(kept & set(server.host.sessions)) == 1


def test_more_rows_than_places_and_many_urls(
    server: Running, simulator: UNetSimulator, decoder: StateHead, store: ClipStore
) -> None:
    with pytest.raises(
        RemoteError, match=r"4 sessions are wanted, the servers at simulator\.model\.urls hold 3"
    ):
        world(RemoteSimulator(SHAPE, RemoteConfig((server.url,))), GivenStates(4), store, 4).reset()
    second = Running(SessionHost(simulator, decoder, ServeConfig(sessions=1), bf16=False))
    try:
        env = world(RemoteSimulator(SHAPE, RemoteConfig((server.url, second.url))), GivenStates(4), store, 4)
        now = env.reset()
        now[CHUNK] = torch.zeros(4, 4, 14)
        assert env.step(now)["next", IMAGE].shape[0] == 4 and len(second.host.sessions) == 1
    finally:
        second.stop()
    with pytest.raises(ValueError, match=r"simulator\.model\.urls"):
        RemoteConfig(())


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
            "task.chunk",
        ),
    ],
)
def test_servers_that_answer_nonsense(
    path: str, status: int, body: bytes, message: str, store: ClipStore
) -> None:
    def answer(asked: str, _: bytes) -> tuple[int, bytes]:
        return (status, body) if asked == path else (200, json.dumps({"client_id": "x"}).encode())

    url, httpd = strange_server(answer)
    try:
        env = world(RemoteSimulator(SHAPE, RemoteConfig((url,), retries=1)), GivenStates(4), store, 1)
        with pytest.raises(RemoteError, match=message):
            now = env.reset()
            now[CHUNK] = torch.zeros(1, 4, 14)
            env.step(now)
    finally:
        httpd.shutdown()


def test_servers_that_never_answer_and_that_are_not_there(store: ClipStore) -> None:
    # type: ignore[func-returns-value]
    url, httpd = strange_server(lambda *_: (time.sleep(3), (200, b"{}"))[1])
    try:
        began = time.monotonic()
        with pytest.raises(RemoteError, match=r"deadline_s=0\.3 after 2 tries"):
            world(
                RemoteSimulator(SHAPE, RemoteConfig((url,), deadline_s=0.3, retries=1)),
                GivenStates(4),
                store,
                1,
            ).reset()
        assert time.monotonic() - began < 2.5
    finally:
        httpd.shutdown()
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        port = s.getsockname()[1]
    with pytest.raises(RemoteError, match="no answer"):
        world(
            RemoteSimulator(SHAPE, RemoteConfig((f"http://127.0.0.1:{port}",), retries=0)),
            GivenStates(4),
            store,
            1,
        ).reset()


def test_a_lost_answer_is_asked_for_again_where_that_is_safe(
    server: Running, store: ClipStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    import requests

    env = world(RemoteSimulator(SHAPE, RemoteConfig((server.url,), retries=1)), GivenStates(4), store, 1)
    now = env.reset()
    post, lost = requests.Session.post, []

    def flaky(self: requests.Session, url: str, **more: object) -> requests.Response:
        answer = post(self, url, **more)  # type: ignore[arg-type]
        if url.endswith("/step") and not lost:
            lost.append(url)
            raise requests.ConnectionError("the line broke after the step was made")
        return answer

    monkeypatch.setattr(requests.Session, "post", flaky)
    now[CHUNK] = torch.zeros(1, 4, 14)
    env.step(now)
    (session,) = server.host.sessions.values()
    assert lost and session.chunk == 1


def test_given_states_need_states_or_joints() -> None:
    nothing = torch.full((1, 4, 16), torch.nan)
    joints = torch.randn(1, 4, 16)
    zero = torch.zeros(1, dtype=torch.int64)
    assert torch.equal(GivenStates(4).decode(nothing, joints, joints, joints, zero, zero), joints)
    with pytest.raises(RemoteError, match="no joint states"):
        GivenStates(4).decode(nothing, torch.zeros(1, 4, 14), joints, joints, zero, zero)
    assert np.isfinite(joints).all()
