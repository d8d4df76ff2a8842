"""A served simulator that is asked badly, fails, or is left: it says so, and harms nobody."""

from __future__ import annotations

import gzip
import json
import random
import socket
import time

import numpy as np
import pytest
import requests

from tests.actors.serving import POSES, Running, Stranger, block, jpeg


def test_broken_compression_is_bad_input(server: Running) -> None:
    good = gzip.compress(b'{"user_name": "zip"}' * 1)
    for body, status in (
        (good, 200),
        (good[:-12], 400),
        (b"no gzip at all", 400),
        (b"\x1f\x8b" + b"x" * 50, 400),
    ):
        for kind in ("gzip", "deflate"):
            if kind == "deflate" and status == 200:
                continue
            said = requests.post(
                f"{server.url}/init", data=body, headers={"Content-Encoding": kind}, timeout=10
            )
            assert said.status_code == status and ("error" in said.json() or status == 200), (body, said.text)


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
    frame = np.zeros((3, 3, 32, 32), np.float32)
    refused(client.send("/set_episode_data", client.first_frame(frame)[:-9]), 400, "announces")
    meta = json.dumps({"client_id": client.id, "frame_shape": [3, 3, 32, 32]}).encode()
    refused(client.send("/set_episode_data", block(jpeg(frame)[:-200]) + block(meta)), 400, "picture")
    refused(client.send("/set_episode_data", block(jpeg(frame[:, :, :16])) + block(meta)), 400, "16 x 96")
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
    refused(client.send("/step", client.actions(np.full((4, 14), np.nan))), 400, "NaN")
    refused(client.send("/step", client.actions(np.zeros((4, 7)))), 400, "14 numbers")
    refused(client.send("/step", client.actions(np.zeros((5, 14)))), 400, "exceeds")
    refused(client.send("/step", client.actions(POSES)[:-5] + b"extra"), 400, "")
    assert client.step(POSES)[0].shape[0] == 4


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
    body = gone.actions(POSES)
    for sent in (len(body) // 2, len(body)):
        with socket.create_connection(("127.0.0.1", server.port)) as s:
            s.sendall(
                f"POST /step HTTP/1.1\r\nHost: x\r\nContent-Length: {len(body)}\r\n\r\n".encode()
                + body[:sent]
            )
    assert bystander.step(POSES)[0].shape[0] == 4
    until = time.monotonic() + 10
    while server.host.sessions[gone.id].chunk < 1 and time.monotonic() < until:
        time.sleep(0.05)  # the whole request was taken, its step is made although nobody waits
    assert gone.step(POSES)[0].shape[0] == 4


def test_a_failing_model_is_a_500_and_the_session_goes_on(
    server: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    client = Stranger(server.url)
    client.prepare()
    step = server.host.simulator.step
    monkeypatch.setattr(server.host.simulator, "step", lambda *_: 1 / 0)
    failed = client.send("/step", client.actions(POSES))
    assert failed.status_code == 500 and "ZeroDivisionError" in failed.json()["error"]
    monkeypatch.setattr(server.host.simulator, "step", step)
    assert client.step(POSES)[0].shape[0] == 4


def test_six_hundred_mutated_bodies(server: Running) -> None:
    bystander, twin, victim = Stranger(server.url, seed=9), Stranger(server.url, seed=9), Stranger(server.url)
    for client in (bystander, twin, victim):
        client.prepare()
    before = bystander.step(POSES)[0]
    rng = random.Random(0)
    c2w = np.tile(np.eye(4, dtype=np.float32), (3, 4, 1, 1))
    bodies = {
        "/set_episode_data": victim.first_frame(np.zeros((3, 3, 32, 32), np.float32)),
        "/set_episode_traj": victim.trajectory(np.zeros((3, 3, 4, 32, 32), np.float32), c2w),
        "/step": victim.actions(POSES),
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
    assert np.array_equal(twin.step(POSES)[0], before)
    assert bystander.step(POSES)[0].shape[0] == 4
