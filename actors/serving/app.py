"""The HTTP side of a served simulator: GE-Sim's endpoints and their status codes.

Clients written for the released server work unchanged. What is new is overlooked by them: many sessions
instead of one, `seed` and `bound` in /init, `state` beside the first frame, `chunk` in /step (a repeated step
is answered again, not made again), and what /healthz says beside "ok".
"""

from __future__ import annotations

import asyncio
import json
import socket
import zlib
from collections.abc import AsyncIterator
from typing import Any

import numpy as np
from aiohttp import web
from aiohttp.http_exceptions import HttpProcessingError
from numpy.typing import NDArray

from actors.serving.access import errors, json_answer, writes
from actors.serving.page import LivePage
from actors.serving.session import Session, of_calibrated
from actors.serving.sessions import ServeConfig, SessionHost
from envs.episodes.pictures import resize_frames
from envs.simulators.remote.protocol import (
    ProtocolError,
    decode_frame,
    encode_frame,
    floats,
    numbers,
    pack,
    parse,
    shape_in,
    unpack,
)


class Server:
    """Routes of the protocol over a SessionHost.

    Args:
        host: the sessions.
        name: of the simulator, for the page.
    """

    def __init__(self, host: SessionHost, name: str):
        self.host, self.name = host, name
        self.limit = int(host.config.body_mb * 2**20)

    def app(self) -> web.Application:
        """The application, to be run by aiohttp."""
        app = web.Application(middlewares=[errors, writes], client_max_size=self.limit)
        for path, call in (
            ("/init", self.init),
            ("/reset", self.reset),
            ("/set_task", self.set_task),
            ("/set_camera_params", self.set_camera_params),
            ("/close", self.close),
            ("/set_episode_data", self.set_episode_data),
            ("/set_episode_traj", self.set_episode_traj),
            ("/step", self.step),
        ):
            app.router.add_post(path, call)
        app.cleanup_ctx.append(self._sweep)
        app.router.add_get("/healthz", self.healthz)
        LivePage(self.host, self.name).add_to(app)
        return app

    async def _sweep(self, app: web.Application) -> AsyncIterator[None]:
        """End idle sessions for as long as the server runs."""

        async def forever() -> None:
            while True:
                await asyncio.sleep(min(self.host.config.grace_s, self.host.config.idle_s) / 2)
                self.host.expire()

        task = asyncio.create_task(forever())
        yield
        task.cancel()

    def _session(self, request: web.Request, meta: dict[str, Any]) -> Session:
        """The session that a request names, reached by the request's connection from now on."""
        session = self.host.get(meta.get("client_id"))
        session.connection = request.transport
        return session

    async def _body(self, request: web.Request) -> bytes:
        if (request.content_length or 0) > self.limit:
            # Refused by its own announcement, before a byte of it is kept.
            raise web.HTTPRequestEntityTooLarge(
                max_size=self.limit,
                actual_size=request.content_length or 0,
                reason=f"the body has {request.content_length} bytes,"
                f" serve.body_mb={self.host.config.body_mb:g} allows {self.limit}",
            )
        try:
            return await request.read()
        except (web.RequestPayloadError, HttpProcessingError, zlib.error) as error:
            raise ProtocolError(f"the body cannot be read: {error or type(error).__name__}") from error

    # -- JSON endpoints
    async def init(self, request: web.Request) -> web.Response:
        """Open a session."""
        body = parse(await self._body(request))
        seed = body.get("seed")
        if seed is not None and (type(seed) is not int or not 0 <= seed < 2**62):
            raise ProtocolError(f"seed must be a whole number from 0, got {str(seed)[:80]}")
        session = self.host.open(str(body.get("user_name", "anonymous"))[:80], seed)
        session.bound, session.connection = body.get("bound") is True, request.transport
        return json_answer(200, {"success": True, "client_id": session.client_id})

    async def reset(self, request: web.Request) -> web.Response:
        """Forget the episode of a session."""
        session = self._session(request, parse(await self._body(request)))
        async with session.lock:
            session.restart()
        return json_answer(200, {"success": True})

    async def set_task(self, request: web.Request) -> web.Response:
        """Remember the task's words; no simulator reads them."""
        body = parse(await self._body(request))
        self._session(request, body).task = str(body.get("task", ""))[:1000]
        return json_answer(200, {"success": True})

    async def set_camera_params(self, request: web.Request) -> web.Response:
        """Intrinsics in pixels of the client's pictures, and cameras at the start if they are known."""
        body = parse(await self._body(request))
        session, robot = self._session(request, body), self.host.robot
        views = len(robot.cameras)
        if "intrinsic" not in body:
            raise ProtocolError("intrinsic is missing")
        intrinsic = numbers(body["intrinsic"], (views, 3, 3), "intrinsic")
        known = list(robot.calibrated_views)
        if known and np.abs(np.linalg.det(intrinsic[known])).min() < 1e-6:
            raise ProtocolError("intrinsic must be invertible")
        intrinsic, extrinsic = of_calibrated(intrinsic, robot), None
        if body.get("extrinsic") is not None:
            extrinsic = of_calibrated(numbers(body["extrinsic"], (views, 4, 4), "extrinsic"), robot)
        async with session.lock:
            session.intrinsic, session.extrinsic = intrinsic, extrinsic
        return json_answer(200, {"success": True})

    async def close(self, request: web.Request) -> web.Response:
        """End a session."""
        session = self._session(request, parse(await self._body(request)))
        async with session.lock:
            self.host.close(session.client_id)
        return json_answer(200, {"success": True})

    # -- binary endpoints
    async def set_episode_data(self, request: web.Request) -> web.Response:
        """The first frame; whatever came of an earlier one is forgotten."""
        picture, header = unpack(await self._body(request), 2)
        meta = parse(header)
        session = self._session(request, meta)
        _, views, height, width = shape_in(meta, "frame_shape", f"3,{self.host.spec.views},H,W")
        frame = await asyncio.to_thread(
            lambda: resize_frames(decode_frame(picture, views, height, width)[None], self.host.spec.size)[0]
        )
        robot = self.host.robot
        sizes = {"state": robot.state_dim, "command": robot.action_dim}
        known = {
            name: numbers(meta[name], (size,), name)
            for name, size in sizes.items()
            if meta.get(name) is not None
        }
        async with session.lock:
            # The released order of calls is data, then trajectory; either order works, and a trajectory that
            # came first begins with the episode.
            traj, c2w = session.traj, session.c2w
            session.restart()
            session.first, session.frame_size = frame, (height, width)
            session.joints, session.command = known.get("state"), known.get("command")
            session.traj, session.c2w = traj, c2w
        return json_answer(200, {"success": True})

    async def set_episode_traj(self, request: web.Request) -> web.Response:
        """Pose maps and cameras of a whole recording, or of the chunk to come."""
        pictures, poses, header = unpack(await self._body(request), 3)
        meta = parse(header)
        session = self._session(request, meta)
        _, views, count, height, width = shape_in(meta, "traj_shape", f"3,{self.host.spec.views},T,H,W")
        shape_in(meta, "c2w_shape", f"{views},{count},4,4")
        c2w = of_calibrated(floats(poses, (views, count, 4, 4), "c2w"), self.host.robot).transpose(1, 0, 2, 3)

        def read() -> NDArray[np.uint8]:
            blocks = unpack(pictures)
            if len(blocks) != count:
                raise ProtocolError(f"traj_shape announces {count} pictures, {len(blocks)} came")
            return np.concatenate(
                [
                    resize_frames(decode_frame(block, views, height, width)[None], self.host.spec.size)
                    for block in blocks
                ]
            )

        maps = await asyncio.to_thread(read)
        async with session.lock:
            session.traj, session.c2w = maps, np.ascontiguousarray(c2w)
            session.traj_begin = session.frames
        return json_answer(200, {"success": True})

    async def step(self, request: web.Request) -> web.Response:
        """One chunk: frames as JPEGs, and joint states."""
        body = await self._body(request)
        values, header = unpack(body, 2)
        meta = parse(header)
        session = self._session(request, meta)
        actions = floats(values, shape_in(meta, "action_shape", "L,A"), "actions")
        async with session.lock:
            requested = meta.get("chunk")
            if (
                requested is not None
                and session.reply is not None
                and requested == session.reply[0]
                and body == session.reply[1]
            ):
                return web.Response(body=session.reply[2], content_type="application/octet-stream")
            if requested is not None and requested != session.chunk:
                raise ProtocolError(f"chunk {requested} was requested, this session is at {session.chunk}")
            frames, states = await self.host.step(session, actions)
            answer, session.preview = await asyncio.to_thread(_answer, frames, states)
            session.reply = (session.chunk - 1, body, answer)
            session.last_action, session.last_state = (
                actions[-1].tolist(),
                None if states is None else states[-1].tolist(),
            )
        self.host.latest = session
        return web.Response(body=answer, content_type="application/octet-stream")

    async def healthz(self, request: web.Request) -> web.Response:
        """Whether it lives, how many sessions it holds, and that repeated steps are known apart."""
        return json_answer(200, {"status": "ok", "sessions": self.host.config.sessions, "repeatable": True})


def _answer(frames: NDArray[np.uint8], states: NDArray[np.float32] | None) -> tuple[bytes, bytes]:
    """The body that answers /step, and its last picture."""
    count, views, _, height, width = frames.shape
    meta = {
        "frame_shape": [count, 3, views, height, width],
        "state_shape": None if states is None else list(states.shape),
    }
    pictures = [encode_frame(frame) for frame in frames]
    return pack(
        [json.dumps(meta).encode(), *pictures, b"" if states is None else states.astype("<f4").tobytes()]
    ), pictures[-1]


def listening(config: ServeConfig) -> socket.socket:
    """A bound socket, taken before anything is built.

    Raises:
        OSError: if nobody may listen there, naming the key and the fix.
    """
    try:
        family, kind, _, _, address = socket.getaddrinfo(
            config.host, config.port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        server = socket.socket(family, kind)
        server.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        server.bind(address)
    except OSError as error:
        raise OSError(
            error.errno,
            f"cannot listen on serve.host={config.host} serve.port={config.port}: {error.strerror}; choose"
            " another port, or 0 for any free one",
        ) from error
    return server


def serve(host: SessionHost, name: str, server: socket.socket) -> None:
    """Serve on a bound socket until interrupted."""
    web.run_app(
        Server(host, name).app(),
        sock=server,
        print=None,
        access_log=None,
        # a client may think for long between its steps, and is not gone because of that
        keepalive_timeout=host.config.idle_s,
        # twice this is what a request may delay the end: a body that never comes, a client that never reads
        shutdown_timeout=5.0,
    )
