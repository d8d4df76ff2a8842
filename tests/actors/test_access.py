"""Who may drive a served simulator: no foreign page, nobody without the token, and nobody who is gone."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator

import pytest
import requests

from actors.serving.app import listening
from actors.serving.sessions import SessionHost
from envs.simulators.remote.connection import Connection, ConnectionOptions, RemoteError
from envs.simulators.remote.protocol import TOKEN
from tests.actors.serving import Running, Stranger, serve_config, tiny_world

PATIENCE = ConnectionOptions(connect_s=5, deadline_s=30, retries=0, user="test")


@pytest.fixture
def server() -> Iterator[Running]:
    running = Running(SessionHost(tiny_world(), None, serve_config(grace_s=2.5), bf16=False))
    yield running
    running.stop()


def opened(server: Running, **headers: str) -> int:
    return requests.post(f"{server.url}/init", json={}, headers=headers, timeout=5).status_code


def test_a_page_of_another_origin_cannot_write(server: Running) -> None:
    own = server.url
    assert opened(server) == 200  # no browser: no origin
    assert opened(server, Origin=own) == 200
    for origin in (
        "http://evil.example",
        "null",
        "http://127.0.0.1:1",
        own.replace("http", "ftp"),
        "http://[",
    ):
        assert opened(server, Origin=origin) == 403, origin
    # DNS that was pointed at loopback: page and host agree, but the name is anybody's
    assert opened(server, Origin="http://evil.example:9", Host="evil.example:9") == 403
    assert requests.get(f"{own}/healthz", headers={"Origin": "http://evil.example"}, timeout=5).ok


def test_a_token_is_asked_of_every_write(server: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(TOKEN, "s3cret")
    for words in ({}, {"Authorization": "Bearer wrong"}, {"Authorization": "s3cret"}):
        assert opened(server, **words) == 401
    assert opened(server, Authorization="Bearer s3cret") == 200
    assert requests.get(server.url, timeout=5).ok
    knows = Connection(server.url, PATIENCE)
    monkeypatch.delenv(TOKEN)
    ignorant = Connection(server.url, PATIENCE)
    monkeypatch.setenv(TOKEN, "s3cret")
    assert knows.ask("/init", {})["success"]
    with pytest.raises(RemoteError, match=TOKEN):
        ignorant.ask("/init", {})


@pytest.mark.long
def test_bound_sessions_end_with_their_connection_and_others_do_not(server: Running) -> None:
    bound, free = Stranger(server.url, bound=True), Stranger(server.url)
    time.sleep(3.0)
    assert set(server.host.sessions) == {bound.id, free.id}  # idle, but still there
    bound.http.close()
    assert bound.post("/set_task", task="again").status_code == 200  # back within the grace
    bound.http.close(), free.http.close()
    deadline = time.monotonic() + 10
    while bound.id in server.host.sessions and time.monotonic() < deadline:
        time.sleep(0.05)
    assert set(server.host.sessions) == {free.id}


def test_a_port_in_use_is_told_by_its_key() -> None:
    with (
        socket.create_server(("127.0.0.1", 0)) as taken,
        pytest.raises(OSError, match=r"serve\.port=\d+: .*in use"),
    ):
        listening(serve_config(port=taken.getsockname()[1]))
