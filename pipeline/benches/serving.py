"""worldloop bench serving: steps per second over HTTP, and whether hours of traffic would fill the memory."""

from __future__ import annotations

import asyncio
import gc
import os
import tempfile
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from aiohttp import web
from numpy.typing import NDArray

from actors.factory import build_simulator, build_state_decoder, open_clips
from actors.process import prepare_process
from actors.serving.app import Server, listening
from actors.serving.sessions import ServeConfig, SessionHost
from envs.episodes.clips import ClipStore
from envs.simulators.remote.connection import Connection, ConnectionOptions
from envs.simulators.replay import future_of
from envs.targets import options
from pipeline.commands.demo_world import demo_recipe

_CLIENTS, _CHUNKS = 4, 3  # at once; steps of a session, after which it is closed or left


def serving(cfg: dict[str, Any], seconds: float) -> None:
    """Sessions are opened, stepped and closed (every third one is just left) by four clients; resident memory
    is read every tenth of the `seconds`, and its slope over the second half is said.
    """
    prepare_process(0, 0)
    config = options(ServeConfig, {**cfg["serve"], "port": 0, "grace_s": 1.0}, "serve")
    with tempfile.TemporaryDirectory() as folder:
        recipe = demo_recipe(cfg, Path(folder), 1)
        store, simulator = open_clips(cfg, recipe.data), build_simulator(cfg)
        host = SessionHost(simulator, build_state_decoder(cfg, simulator).eval(), config, bf16=False)
        with _running(host, config) as url:
            _drive(url, host, store, seconds)


@contextmanager
def _running(host: SessionHost, config: ServeConfig) -> Iterator[str]:
    """The host behind HTTP, in a thread."""
    loop, ready = asyncio.new_event_loop(), threading.Event()
    runner = web.AppRunner(
        Server(host, "bench").app(),
        access_log=None,
        keepalive_timeout=config.idle_s,
        shutdown_timeout=5.0,
    )
    taken = listening(config)

    async def begin() -> None:
        await runner.setup()
        await web.SockSite(runner, taken).start()
        ready.set()

    def run() -> None:
        asyncio.set_event_loop(loop)
        loop.run_until_complete(begin())
        loop.run_forever()

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    ready.wait(30)
    try:
        yield f"http://{config.host}:{taken.getsockname()[1]}"
    finally:
        asyncio.run_coroutine_threadsafe(runner.cleanup(), loop).result(30)
        loop.call_soon_threadsafe(loop.stop)
        thread.join(30)


def _drive(url: str, host: SessionHost, store: ClipStore, seconds: float) -> None:
    first = store.first(store.start.new_zeros(1))
    rows = store.start[:1][:, None] + store.start.new_tensor(range(1, store.spec.chunk + 1))
    future = future_of(host.simulator, store, rows)
    begin = {name: value[0].numpy() for name, value in first.items()}
    ahead = {name: value[0].numpy() for name, value in future.items()}
    end, sessions, stop = time.monotonic() + seconds, [0] * _CLIENTS, threading.Event()
    with ThreadPoolExecutor(_CLIENTS) as clients:
        jobs = [clients.submit(_client, url, begin, ahead, n, sessions, stop) for n in range(_CLIENTS)]
        times, sizes, steps = [], [], []
        while time.monotonic() < end:
            time.sleep(seconds / 10)
            gc.collect()
            times.append(time.monotonic())
            sizes.append(_resident())
            steps.append(host.steps)
            held = len(host.sessions)
            print(f"{sum(sessions)} sessions, {held} open, {host.steps} steps, {sizes[-1]:.0f} MB")
        stop.set()
        for job in jobs:
            job.result()
    half = len(times) // 2
    slope = np.polyfit(steps[half:], sizes[half:], 1)[0]
    rate = (steps[-1] - steps[0]) / (times[-1] - times[0])
    print(f"{rate:.1f} steps/s; {1000 * slope:+.2f} MB per 1000 steps over the second half")


def _client(
    url: str,
    first: dict[str, NDArray[Any]],
    future: dict[str, NDArray[Any]],
    number: int,
    sessions: list[int],
    stop: threading.Event,
) -> None:
    patience = ConnectionOptions(connect_s=10.0, deadline_s=60.0, retries=2, user=f"bench-{number}")
    while not stop.is_set():
        connection = Connection(url, patience)
        connection.open(first, seed=sessions[number])
        for _ in range(_CHUNKS):
            connection.step(future, repeatable=True)
        sessions[number] += 1
        if sessions[number] % 3:
            connection.close()
        else:
            connection.http.close()  # as if it had died


def _resident() -> float:
    """Megabytes of this process in main memory."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20
