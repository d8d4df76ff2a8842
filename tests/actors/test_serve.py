"""A served simulator: strangers' clients work, sessions share passes and nothing else, bad input harms
nobody.
"""

from __future__ import annotations

import json
import random
import socket
import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest
import requests
import torch

from actors.serving.sessions import ServeConfig, SessionHost
from envs.geometry.kinematics import Kinematics
from envs.simulators.state_experts.head import StateHead
from envs.simulators.unet.engine import UNetSimulator
from tests.actors.serving import Running, Stranger, block, jpeg

REST = np.tile(np.array([0, -0.35, 0, 2.1, 0, 1.39, 0, 0.2] * 2, np.float32), (4, 1))


def make(simulator: UNetSimulator, **config: object) -> Running:
    torch.manual_seed(1)
    decoder = StateHead(simulator.feature_shape[0], simulator.shape.chunk, simulator.shape.memory).eval()
    # type: ignore[arg-type]
    return Running(SessionHost(simulator, decoder, ServeConfig(**config), Kinematics(), bf16=False))


@pytest.fixture
def server(simulator: UNetSimulator) -> Iterator[Running]:
    running = make(simulator, sessions=12, body_mb=8.0)
    yield running
    running.stop()


def test_a_strangers_client_works_unchanged(server: Running) -> None:
    assert requests.get(f"{server.url}/healthz", timeout=5).json()["status"] == "ok"
    client = Stranger(server.url)
    assert client.post("/set_task", task="push it").json() == {"success": True}
    client.prepare(frames=12)
    frames, state = client.step(REST)
    assert frames.shape == (4, 3, 3, 64, 64) and state is not None and state.shape == (4, 16)
    frames, state = client.step(REST[:3])  # fewer actions than a chunk: fewer frames, and no more happened
    assert frames.shape[0] == 3 and state is not None and len(state) == 3
    (session,) = server.host.sessions.values()
    assert session.frames == 7 and int(session.state["length"]) == 8
    said = requests.get(f"{server.url}/api/status", timeout=5).json()
    assert (
        said["step_count"] == 2
        and said["frames_generated"] == 7
        and said["has_preview"]
        and len(said["state"]) == 16
        and said["task"] == "push it"
    )
    assert client.id not in json.dumps(said)
    preview = requests.get(f"{server.url}/api/preview.jpg", timeout=5)
    assert preview.headers["Content-Type"] == "image/jpeg" and preview.content[:2] == b"\xff\xd8"
    assert "world model" in requests.get(server.url, timeout=5).text
    assert client.post("/reset").status_code == 200
    refused = client.send("/step", client.actions(REST))
    assert refused.status_code == 400 and "/set_episode_data" in refused.json()["error"]
    assert client.post("/close").status_code == 200 and client.post("/reset").status_code == 403


def test_pictures_of_another_size_are_resized(server: Running) -> None:
    client = Stranger(server.url)
    client.prepare(size=(96, 128))
    assert client.step(REST)[0].shape[-2:] == (64, 64)


def test_sessions_share_forward_passes_and_nothing_else(simulator: UNetSimulator) -> None:
    server = make(simulator, linger_ms=300.0, batch=4)
    try:
        clients = [Stranger(server.url, seed=n) for n in range(4)]
        for n, client in enumerate(clients):
            client.prepare(seed=n)
        made: dict[int, list[np.ndarray]] = {n: [] for n in range(4)}
        for _ in range(2):
            threads = [
                threading.Thread(target=lambda n=n: made[n].append(clients[n].step(REST)[0]))
                for n in range(4)
            ]
            [thread.start() for thread in threads]
            [thread.join() for thread in threads]
        assert server.host.steps == 8 and server.host.passes <= 4
        alone = Stranger(server.url, seed=2)
        alone.prepare(seed=2)
        for step in range(2):
            assert np.abs(alone.step(REST)[0].astype(int) - made[2][step].astype(int)).mean() < 0.5
        assert np.abs(made[1][1].astype(int) - made[2][1].astype(int)).mean() > 2
    finally:
        server.stop()


def test_bad_input_is_refused_by_name(server: Running) -> None:
    client = Stranger(server.url)
    client.prepare()

    def refused(response: requests.Response, status: int, word: str) -> None:
        assert response.status_code == status and word in response.json()["error"], (
            response.status_code,
            response.text,
        )

    refused(
        requests.post(f"{server.url}/reset", json={"client_id": "nobody"}, timeout=5),
        403,
        "unknown client_id",
    )
    refused(requests.post(f"{server.url}/nowhere", json={}, timeout=5), 404, "Not Found")
    refused(client.post("/set_camera_params", intrinsic=[[1, 2], [3]]), 400, "intrinsic")
    refused(client.post("/set_camera_params", intrinsic=np.zeros((3, 3, 3)).tolist()), 400, "invertible")
    refused(client.post("/set_camera_params"), 400, "intrinsic is missing")
    frame = np.zeros((3, 3, 64, 64), np.float32)
    refused(client.send("/set_episode_data", client.first_frame(frame)[:-9]), 400, "announces")
    meta = json.dumps({"client_id": client.id, "frame_shape": [3, 3, 64, 64]}).encode()
    refused(client.send("/set_episode_data", block(jpeg(frame)[:-200]) + block(meta)), 400, "picture")
    refused(client.send("/set_episode_data", block(jpeg(frame[:, :, :32])) + block(meta)), 400, "32 x 192")
    refused(
        client.send(
            "/set_episode_data",
            block(jpeg(frame))
            + block(b'{"client_id": "%s", "frame_shape": [3, 3, 99999, 99999]}' % client.id.encode()),
        ),
        400,
        "larger",
    )
    refused(client.send("/set_episode_data", block(jpeg(frame)) + block(b"[" * 100_000)), 400, "JSON")
    refused(client.send("/step", client.actions(np.full((4, 16), np.nan))), 400, "NaN")
    refused(client.send("/step", client.actions(np.zeros((4, 7)))), 400, "14 numbers")
    refused(client.send("/step", client.actions(np.zeros((5, 16)))), 400, "exceeds")
    refused(client.send("/step", client.actions(REST)[:-5] + b"extra"), 400, "")
    assert client.step(REST)[0].shape[0] == 4


def test_an_enormous_body_is_refused_before_it_is_read(server: Running) -> None:
    with socket.create_connection(("127.0.0.1", server.port), timeout=10) as s:
        s.sendall(
            b"POST /set_episode_traj HTTP/1.1\r\nHost: x\r\nContent-Length: 27917287424\r\n\r\n"
            + b"\0" * 1000
        )
        answer = s.recv(4096)
    assert b" 413 " in answer.split(b"\r\n", 1)[0] and b"body_mb" in answer
    # its size is not announced
    said = requests.post(f"{server.url}/step", data=(b"\0" * 2**20 for _ in range(9)), timeout=30)
    assert said.status_code == 413


def test_a_client_that_vanishes_harms_nobody(server: Running) -> None:
    bystander, gone = Stranger(server.url, seed=5), Stranger(server.url)
    bystander.prepare(), gone.prepare()
    body = gone.actions(REST)
    for sent in (len(body) // 2, len(body)):
        with socket.create_connection(("127.0.0.1", server.port)) as s:
            s.sendall(
                f"POST /step HTTP/1.1\r\nHost: x\r\nContent-Length: {len(body)}\r\n\r\n".encode()
                + body[:sent]
            )
    assert bystander.step(REST)[0].shape[0] == 4
    until = time.monotonic() + 10
    while server.host.sessions[gone.id].chunk < 1 and time.monotonic() < until:
        time.sleep(0.05)  # the whole request was taken, its step is made although nobody waits
    assert gone.step(REST)[0].shape[0] == 4


def test_a_repeated_step_is_answered_again_and_not_made_again(server: Running) -> None:
    client = Stranger(server.url, seed=1)
    client.prepare()
    body = client.actions(REST, chunk=0)
    first, again = client.send("/step", body), client.send("/step", body)
    assert first.content == again.content and server.host.sessions[client.id].chunk == 1
    assert client.send("/step", client.actions(REST, chunk=7)).status_code == 400
    assert client.send("/step", client.actions(REST, chunk=1)).status_code == 200


def test_full_servers_say_so_and_idle_sessions_make_room(simulator: UNetSimulator) -> None:
    server = make(simulator, sessions=2, idle_s=0.5)
    try:
        clients = [Stranger(server.url) for _ in range(2)]
        full = requests.post(f"{server.url}/init", json={}, timeout=5)
        assert full.status_code == 503 and "serve.sessions=2" in full.json()["error"]
        for _ in range(6):
            time.sleep(0.2)
            assert clients[1].post("/set_task", task="still here").status_code == 200
        assert len(server.host.sessions) == 1  # the other one ended by itself
        assert Stranger(server.url).id
        assert clients[0].post("/reset").status_code == 403 and clients[1].post("/reset").status_code == 200
    finally:
        server.stop()


def test_a_failing_model_is_a_500_and_the_session_goes_on(
    server: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    client = Stranger(server.url)
    client.prepare()
    step = server.host.simulator.step
    monkeypatch.setattr(server.host.simulator, "step", lambda *_: 1 / 0)
    failed = client.send("/step", client.actions(REST))
    assert failed.status_code == 500 and "ZeroDivisionError" in failed.json()["error"]
    monkeypatch.setattr(server.host.simulator, "step", step)
    assert client.step(REST)[0].shape[0] == 4


def test_six_hundred_mutated_bodies(server: Running) -> None:
    bystander, twin, victim = Stranger(server.url, seed=9), Stranger(server.url, seed=9), Stranger(server.url)
    for client in (bystander, twin, victim):
        client.prepare()
    before = bystander.step(REST)[0]
    rng = random.Random(0)
    c2w = np.tile(np.eye(4, dtype=np.float32), (3, 4, 1, 1))
    bodies = {
        "/set_episode_data": victim.first_frame(np.zeros((3, 3, 64, 64), np.float32)),
        "/set_episode_traj": victim.trajectory(np.zeros((3, 3, 4, 64, 64), np.float32), c2w),
        "/step": victim.actions(REST),
        "/init": b'{"user_name": "fuzz", "seed": 3}',
        "/set_camera_params": json.dumps({"client_id": victim.id, "intrinsic": np.eye(3).tolist()}).encode(),
        "/set_task": json.dumps({"client_id": victim.id, "task": "x"}).encode(),
    }
    seen: dict[int, int] = {}
    for number in range(600):
        path = list(bodies)[number % len(bodies)]
        body = bytearray(bodies[path])
        for _ in range(rng.choice((1, 1, 3, 20))):
            kind, at = rng.randrange(5), rng.randrange(max(1, len(body)))
            if kind == 0:
                body[at : at + 1] = bytes([rng.randrange(256)])
            elif kind == 1:
                del body[at:]
            elif kind == 2:
                body[at:at] = bytes(rng.randrange(256) for _ in range(rng.randrange(1, 40)))
            elif kind == 3:
                body[: min(4, len(body))] = rng.choice(
                    (b"\0\0\0\0", b"\xff\xff\xff\xff", b"\x7f\xff\xff\xff")
                )
            else:
                body += bytes(body[: rng.randrange(200)])
        status = victim.send(path, bytes(body)).status_code
        seen[status] = seen.get(status, 0) + 1
    assert set(seen) <= {200, 400, 403, 413, 503} and seen[400] > 200, seen
    assert np.array_equal(twin.step(REST)[0], before)
    assert bystander.step(REST)[0].shape[0] == 4
