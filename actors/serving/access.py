"""Who may drive a served simulator, and the status codes that say no.

A page in somebody's browser can send requests to loopback; so a write that a browser sends for a page of
another origin is refused, and so is one to a name that a stranger's DNS may have pointed here. A token, if
the server has one, is asked of every write. Reading (the live page) is free for whoever reaches the port.
"""

from __future__ import annotations

import asyncio
import hmac
import ipaddress
import json
import logging
import os
from collections.abc import Awaitable, Callable
from typing import Any
from urllib.parse import urlsplit

from aiohttp import web

from actors.serving.sessions import NoPlace, UnknownSession
from envs.simulators.remote.protocol import TOKEN, ProtocolError

logger = logging.getLogger("worldloop.serve")
Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


def json_answer(status: int, value: Any) -> web.Response:
    """A JSON body that nobody keeps."""
    return web.Response(
        status=status,
        text=json.dumps(value),
        content_type="application/json",
        headers={"Cache-Control": "no-store"},
    )


@web.middleware
async def errors(request: web.Request, handler: Handler) -> web.StreamResponse:
    """Status codes of the protocol: 403 unknown client, 400 bad input, 413 too large, 503 full, 500 model
    failure; all say why in JSON.
    """
    try:
        return await handler(request)
    except UnknownSession as error:
        return json_answer(403, {"error": str(error)})
    except ProtocolError as error:
        return json_answer(400, {"error": str(error)})
    except NoPlace as error:
        return json_answer(503, {"error": str(error)})
    except web.HTTPException as error:
        return json_answer(error.status, {"error": error.reason})
    except (ConnectionResetError, asyncio.CancelledError):
        raise
    except Exception as error:
        logger.exception("%s failed", request.path)
        return json_answer(500, {"error": f"{type(error).__name__}: {error}"})


@web.middleware
async def writes(request: web.Request, handler: Handler) -> web.StreamResponse:
    """Refuse writes from pages of another origin (403) and without the token of $WORLDLOOP_TOKEN (401)."""
    if request.method in ("GET", "HEAD"):
        return await handler(request)
    origin = request.headers.get("Origin")
    if origin is not None and not _own(origin, request.host):
        return json_answer(403, {"error": f"a page of {origin[:80]} may not drive this simulator"})
    token = os.environ.get(TOKEN)
    if token:
        authorization = request.headers.get("Authorization", "")
        if not hmac.compare_digest(authorization.encode(), f"Bearer {token}".encode()):
            return json_answer(401, {"error": f"this server wants a token; set {TOKEN} to its own"})
    return await handler(request)


def _own(origin: str, host: str) -> bool:
    """Whether a page's origin is this server, under a name that nobody else can point at it."""
    try:
        page = urlsplit(origin)
        name = page.hostname or ""
    except ValueError:
        return False
    if page.scheme not in ("http", "https") or page.netloc != host:
        return False
    return name == "localhost" or _address(name)


def _address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True
