"""A real server of OpenAI's chat completions, with a model that sees; it misbehaves when told."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import hashlib
import json
import threading
from collections import deque
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from aiohttp import web
from numpy.typing import NDArray

MODEL = "tiny-vlm"


@dataclass(frozen=True)
class Asked:
    """A question as it arrived: words, pictures uint8 [H, W, 3], RGB, the seed, and headers."""

    text: str
    pictures: tuple[NDArray[np.uint8], ...]
    seed: int
    headers: dict[str, str]


Answer = Callable[[Asked], str]
Fault = Callable[[web.Request], Awaitable[web.StreamResponse]]


def seeing(asked: Asked) -> str:
    """Says what moving_square.py wants to know: whether the square is in the corner of the first camera."""
    view = asked.pictures[-1][:, : asked.pictures[-1].shape[0]].astype(int)
    rows, columns = np.nonzero((view[..., 0] > 150) & (view[..., 2] < 90))
    done = len(rows) > 0 and min(rows.mean(), columns.mean()) > 0.69 * view.shape[0]
    return f"The square moved.\n\nAnswer: {'Yes' if done else 'No'}"


def hashing(asked: Asked) -> str:
    """Of nine votes as many say yes as a hash of all words and pixels decides."""
    found = hashlib.sha256(asked.text.encode())
    for picture in asked.pictures:
        found.update(picture.tobytes())
    return f"Answer: {'Yes' if asked.seed < found.digest()[0] % 10 else 'No'}"


def refuse(status: int, said: str = "come again", **headers: str) -> Fault:
    """A fault that answers another status."""

    async def fault(request: web.Request) -> web.StreamResponse:
        return web.json_response({"error": {"message": said}}, status=status, headers=headers)

    return fault


def say(text: str, **headers: str) -> Fault:
    """A fault that answers 200 with something else than a completion."""

    async def fault(request: web.Request) -> web.StreamResponse:
        return web.Response(body=text.encode(), headers=headers)

    return fault


def sleep(seconds: float) -> Fault:
    """A fault that lets the client wait, and then trickles."""

    async def fault(request: web.Request) -> web.StreamResponse:
        response = web.StreamResponse()
        await response.prepare(request)
        for _ in range(20):
            await asyncio.sleep(seconds / 20)
            await response.write(b" ")
        return response

    return fault


async def half(request: web.Request) -> web.StreamResponse:
    """A fault that begins a completion and cuts the connection."""
    response = web.StreamResponse(headers={"Content-Length": "5000"})
    await response.prepare(request)
    await response.write(b'{"choices": [{"message": {"content": "Answer: Y')
    assert request.transport is not None
    request.transport.abort()
    return response


class ChatServer:
    """Serves until `close`.

    Args:
        answer: what the model says.
        key: that clients must bring; "" asks for none.

    Attributes:
        faults: of the next requests, one each; then all goes well.
        seen: questions that were answered.
        most: questions at once at most.
        usage: tokens that each answer is said to have taken; None leaves them out.
    """

    def __init__(self, answer: Answer = seeing, key: str = ""):
        self.answer, self.key, self.faults = answer, key, deque[Fault]()
        self.seen: list[Asked] = []
        self.tries = self.most = self._now = 0
        self.usage: tuple[int, int] | None = (100, 10)
        self.think = 0.0  # seconds
        self._loop = asyncio.new_event_loop()
        started: threading.Event = threading.Event()
        self._thread = threading.Thread(target=self._serve, args=(started,), daemon=True)
        self._thread.start()
        assert started.wait(10)

    def _serve(self, started: threading.Event) -> None:
        asyncio.set_event_loop(self._loop)
        app = web.Application(client_max_size=1 << 26)
        app.router.add_get("/v1/models", self._models)
        app.router.add_post("/v1/chat/completions", self._complete)
        runner = web.AppRunner(app, handler_cancellation=True, shutdown_timeout=0.1)
        self._loop.run_until_complete(runner.setup())
        site = web.TCPSite(runner, "127.0.0.1", 0)
        self._loop.run_until_complete(site.start())
        port = runner.addresses[0][1]
        self.url = f"http://127.0.0.1:{port}/v1"
        started.set()
        self._loop.run_forever()
        self._loop.run_until_complete(runner.cleanup())
        self._loop.close()

    def close(self) -> None:
        """Stop serving."""
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(10)

    async def _models(self, request: web.Request) -> web.StreamResponse:
        return web.json_response({"object": "list", "data": [{"id": MODEL}, {"id": "another"}]})

    async def _complete(self, request: web.Request) -> web.StreamResponse:
        self.tries += 1
        self._now += 1
        self.most = max(self.most, self._now)
        try:
            body = await request.json()
            if self.faults:
                return await self.faults.popleft()(request)
            if self.key and request.headers.get("Authorization") != f"Bearer {self.key}":
                return await refuse(401, f"wrong key: {request.headers.get('Authorization')}")(request)
            await asyncio.sleep(self.think)
            asked = _asked(body, dict(request.headers))
            self.seen.append(asked)
            return web.json_response(completion(self.answer(asked), self.usage))
        finally:
            self._now -= 1


def completion(text: str, usage: tuple[int, int] | None) -> dict[str, Any]:
    """The JSON of an answer."""
    out: dict[str, Any] = {"choices": [{"message": {"role": "assistant", "content": text}}]}
    if usage is not None:
        out["usage"] = {"prompt_tokens": usage[0], "completion_tokens": usage[1]}
    return out


def _asked(body: dict[str, Any], headers: dict[str, str]) -> Asked:
    assert body["model"] == MODEL, json.dumps(body)[:200]
    (message,) = body["messages"]
    text = [part["text"] for part in message["content"] if part["type"] == "text"]
    urls = [part["image_url"]["url"] for part in message["content"] if part["type"] == "image_url"]
    pictures = []
    for url in urls:
        data = base64.b64decode(url.removeprefix("data:image/jpeg;base64,"), validate=True)
        found = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        assert found is not None
        pictures.append(cv2.cvtColor(found, cv2.COLOR_BGR2RGB))
    return Asked("\n".join(text), tuple(pictures), body["seed"], headers)


@contextlib.contextmanager
def serving(answer: Answer = seeing, key: str = "") -> Iterator[ChatServer]:
    """A server while the context lasts."""
    server = ChatServer(answer, key)
    try:
        yield server
    finally:
        server.close()
