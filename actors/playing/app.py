"""The browser's side of a game: one page, its pictures, and what a person does in it.

Whoever reaches the port plays, so the protections are those of a served simulator (serving/access.py): it
listens on loopback unless told otherwise, and a page of another origin cannot write.
"""

from __future__ import annotations

import asyncio
import base64
import importlib.resources
import socket
from collections.abc import AsyncIterator, Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from typing import Any

import cv2
import numpy as np
from aiohttp import web
from numpy.typing import NDArray

from actors.playing.game import Game, Shown, Unplayable
from actors.serving.access import errors, json_answer, writes
from envs.simulators.remote.protocol import ProtocolError, parse
from envs.targets import ConfigError

_BODY = 2**16  # bytes of a request at most
_SEEDS = 2**31


class PlayServer:
    """Routes over a game, which one thread plays: OpenGL contexts belong to the thread that made them.

    Args:
        make: builds the game, in that thread.
        greeting: is printed once the game can be played.
    """

    def __init__(self, make: Callable[[], Game], greeting: str = ""):
        self._make, self._greeting = make, greeting
        self._thread = ThreadPoolExecutor(1, "game")
        self._turn = asyncio.Lock()

    def app(self) -> web.Application:
        """The application, to be run by aiohttp."""
        app = web.Application(middlewares=[errors, writes], client_max_size=_BODY)
        app.cleanup_ctx.append(self._opened)
        app.router.add_get("/", self.page)
        app.router.add_get("/api/game", self.about)
        app.router.add_post("/api/reset", self.reset)
        app.router.add_post("/api/hand_over", self.hand_over)
        app.router.add_post("/api/step", self.step)
        return app

    async def _opened(self, app: web.Application) -> AsyncIterator[None]:
        """The game with its first episode, for as long as the server runs."""

        def first() -> tuple[Game, Shown]:
            game = self._make()
            return game, game.reset(0)

        try:
            self.game, self._last = await self._in_turn(first)
            if self._greeting:
                print(self._greeting, flush=True)
            yield
        finally:
            self._thread.shutdown()

    async def _in_turn(self, work: Callable[[], Any]) -> Any:
        async with self._turn:
            return await asyncio.get_running_loop().run_in_executor(self._thread, work)

    async def _play(self, work: Callable[[], Shown]) -> web.Response:
        def played() -> dict[str, Any]:
            try:
                shown = work()
            except (ConfigError, Unplayable) as error:  # such as an unknown task
                raise ProtocolError(str(error)) from error
            if shown.true or shown.imagined:
                self._last = shown
            return {**self._standing(), "frames": _pictures(shown)}

        return json_answer(200, await self._in_turn(played))

    def _standing(self) -> dict[str, Any]:
        """How the game stands."""
        game = self.game
        seen, dreamt = game.seen, game.dreamt
        return {
            "task": game.task,
            "seed": game.seed,
            "steps": game.steps,
            "driver": game.driven_by,
            "instruction": game.instruction,
            "command": [round(float(value), 4) for value in game.command],
            "true": None if seen is None else {"success": seen.success, "progress": seen.progress},
            "imagined": None if dreamt is None else {"success": dreamt.success, "progress": dreamt.progress},
        }

    # -- routes
    # ----------------------------------------------------------------------------------------------
    async def page(self, request: web.Request) -> web.Response:
        """The page."""
        text = importlib.resources.files("actors.playing").joinpath("page.html").read_text()
        return web.Response(text=text, content_type="text/html")

    async def about(self, request: web.Request) -> web.Response:
        """The robot, what can be chosen, and the last frames."""

        def description() -> dict[str, Any]:
            game, robot = self.game, self.game.robot
            last = Shown(self._last.true[-1:], self._last.imagined[-1:])
            return {
                "robot": robot.robot,
                "views": list(robot.views),
                "fps": robot.fps,
                "chunk": game.chunk,
                "tasks": list(game.tasks),
                "arms": game.controls.arms,
                "channels": [asdict(channel) for channel in game.controls.channels],
                "expert": game.suite is not None,
                "recorded": [played.title for played in game.recorded],
                **self._standing(),
                "frames": _pictures(last),
            }

        return json_answer(200, await self._in_turn(description))

    async def reset(self, request: web.Request) -> web.Response:
        """Lay out an episode: {"seed": n, "task": name or ""}."""
        body = parse(await request.read())
        seed = _whole(body, "seed", 0, _SEEDS)
        return await self._play(lambda: self.game.reset(seed, str(body.get("task") or "")))

    async def hand_over(self, request: web.Request) -> web.Response:
        """Let somebody else drive: {"to": "expert", "noise_level": x} or {"to": "recorded", "number": n}."""
        body = parse(await request.read())
        number = _whole(body, "number", 0, _SEEDS, 0)
        noise = _number(body, "noise_level", 0.0, 1.0, 0.0)
        return await self._play(lambda: self.game.hand_over(str(body.get("to")), number, noise))

    async def step(self, request: web.Request) -> web.Response:
        """Some actions: {"actions": n, "held": {position: -1..1}, "speed": x}; without "held" of whoever
        drives.
        """
        body = parse(await request.read())
        count = _whole(body, "actions", 1, self.game.chunk, 1)
        if body.get("held") is None:
            return await self._play(lambda: self.game.go_on(count))
        speed, width = _number(body, "speed", 0.0, 10.0, 1.0), self.game.robot.action_dim
        if not isinstance(body["held"], dict):
            raise ProtocolError('held must be an object such as {"0": 1, "6": -1}')
        known = {str(number): number for number in range(width)}
        strange = sorted(body["held"].keys() - known.keys())
        if strange:
            raise ProtocolError(f"held names {strange[:4]}; the numbers of an action are 0..{width - 1}")
        held = {known[key]: _number(body["held"], key, -1.0, 1.0) for key in body["held"]}
        return await self._play(lambda: self.game.press(held, speed, count))


def _whole(body: dict[str, Any], name: str, low: int, high: int, default: int | None = None) -> int:
    value = body.get(name, default)
    if type(value) is not int or not low <= value <= high:
        raise ProtocolError(f"{name}={str(value)[:40]} must be a whole number in {low}..{high}")
    return value


def _number(body: dict[str, Any], name: str, low: float, high: float, default: float | None = None) -> float:
    value = body.get(name, default)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= value <= high:
        raise ProtocolError(f"{name}={str(value)[:40]} must be a number in {low:g}..{high:g}")
    return float(value)


def _pictures(shown: Shown) -> dict[str, list[str]]:
    """The frames of each side as data URLs, all views side by side."""
    return {"true": [_url(one) for one in shown.true], "imagined": [_url(one) for one in shown.imagined]}


def _url(views: NDArray[np.uint8]) -> str:
    row = np.concatenate(list(views.transpose(0, 2, 3, 1)), 1)
    _, data = cv2.imencode(".png", cv2.cvtColor(row, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_PNG_COMPRESSION, 1])
    return f"data:image/png;base64,{base64.b64encode(data.tobytes()).decode()}"


def play(make: Callable[[], Game], server: socket.socket, greeting: str) -> None:
    """Serve a game on a bound socket until interrupted; see PlayServer."""
    web.run_app(
        PlayServer(make, greeting).app(), sock=server, print=None, access_log=None, shutdown_timeout=2.0
    )
