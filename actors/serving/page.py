"""The live page: the last frame of a session, its commands beside its states, asked for once a second."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import numpy as np
from aiohttp import web

from actors.serving.access import json_answer
from actors.serving.session import Session
from actors.serving.sessions import SessionHost
from envs.commanded_states import as_states, same_numbers
from envs.embodiment import Embodiment
from envs.simulators.remote.protocol import ProtocolError


def joint_table(
    robot: Embodiment, action: Sequence[float] | None, state: Sequence[float] | None
) -> list[dict[str, Any]]:
    """A row for every number of the last action and the last predicted state: name, action, state, and state
    minus action, in units of states, where both have a number of that name. None is unknown.
    """
    # Joint commands of a robot that takes poses are no numbers of its own.
    known = action if action and len(action) == robot.action_dim else None
    commanded = dict(zip(robot.action_names, known, strict=True)) if known else {}
    wanted = commanded
    if known and same_numbers(robot):
        wanted = dict(zip(robot.state_names, as_states(robot, np.array(known)).tolist(), strict=True))
    predicted = dict(zip(robot.state_names, state, strict=True)) if state else {}
    rows = []
    for name in dict.fromkeys((*robot.state_names, *robot.action_names)):
        command, found = commanded.get(name), predicted.get(name)
        gap = None if command is None or found is None else found - wanted[name]
        rows.append({"name": name, "action": command, "state": found, "difference": gap})
    return rows


class LivePage:
    """The page at / and what it asks for.

    Args:
        host: the sessions.
        name: of the simulator.
    """

    def __init__(self, host: SessionHost, name: str):
        self.host, self.name = host, name

    def add_to(self, app: web.Application) -> None:
        """Its routes."""
        app.router.add_get("/", self.page)
        app.router.add_get("/api/status", self.status)
        app.router.add_get("/api/preview.jpg", self.preview)

    async def page(self, request: web.Request) -> web.Response:
        """The live page."""
        return web.Response(text=PAGE, content_type="text/html")

    def _chosen(self, request: web.Request) -> Session | None:
        """The session whose number is asked for; without a number the one that stepped last."""
        number = request.query.get("session")
        known = list(self.host.sessions.values())
        if number is None:
            return self.host.latest if self.host.latest in known else (known[-1] if known else None)
        if not re.fullmatch("[0-9]{1,12}", number):
            raise ProtocolError(f"session must be the number of a session, got {number[:40]!r}")
        return next((session for session in known if session.number == int(number)), None)

    async def status(self, request: web.Request) -> web.Response:
        """What the page shows: of one session what the released server says, and a line for each."""
        session, robot = self._chosen(request), self.host.robot
        action, state = (session.last_action, session.last_state) if session else (None, None)
        one = {
            "model": self.name,
            "phase": "running" if any(s.lock.locked() for s in self.host.sessions.values()) else "idle",
            "chunk_size": self.host.spec.chunk,
            "session": session.number if session else None,
            "step_count": session.chunk if session else 0,
            "frames_generated": session.frames if session else 0,
            "has_preview": bool(session and session.preview),
            "state": state,
            "action": action,
            "joints": joint_table(robot, action, state),
            "task": session.task if session else "",
        }
        # no client_id: who knows one may drive it
        rows = [
            {"number": s.number, "user": s.user, "task": s.task, "steps": s.chunk, "frames": s.frames}
            for s in self.host.sessions.values()
        ]
        return json_answer(
            200, {**one, "sessions": rows, "passes": self.host.passes, "steps": self.host.steps}
        )

    async def preview(self, request: web.Request) -> web.Response:
        """The last frame of a session."""
        session = self._chosen(request)
        if session is None or not session.preview:
            return web.Response(status=204)
        return web.Response(
            body=session.preview, content_type="image/jpeg", headers={"Cache-Control": "no-store"}
        )


PAGE = """<!doctype html>
<html lang="en"><meta charset="utf-8"><title>Worldloop: served world model</title>
<style>
:root { color-scheme: light dark }
body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 70rem; padding: 0 1rem }
h1 { font-size: 1.3rem; margin: 0 } .quiet { opacity: .65 }
img { width: 100%; image-rendering: pixelated; background: #8883; border-radius: .5rem; min-height: 8rem;
  margin: 1rem 0 }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; margin: 1rem 0 }
td, th { padding: .1rem 1.2rem .1rem 0; text-align: left }
#joints td + td, #joints th + th { text-align: right }
tr.row { cursor: pointer } tr.chosen { font-weight: 600 }
</style>
<h1 id="model">world model</h1>
<div class="quiet" id="line"></div>
<img id="frame" alt="no frame yet">
<p id="task"></p>
<table id="joints"></table>
<table id="sessions"></table>
<script>
let chosen = null;
const $ = id => document.getElementById(id);
function row(texts, cell = 'td') {
  const tr = document.createElement('tr');
  for (const text of texts) { const td = document.createElement(cell); td.textContent = text; tr.append(td); }
  return tr;
}
const number = v => v === null ? '\\u2013' : (v < 0 ? '\\u2212' : '+') + Math.abs(v).toFixed(4);
async function tick() {
  const which = chosen === null ? '' : '?session=' + chosen;
  try {
    const s = await (await fetch('api/status' + which)).json();
    $('model').textContent = 'world model: ' + s.model;
    const watched = s.session === null ? (chosen === null ? 'no session' : 'session ' + chosen + ' has ended')
      : 'session ' + s.session + (chosen === null ? ' (the latest)' : '');
    $('line').textContent = [s.phase, watched, s.sessions.length + ' sessions',
      s.steps + ' steps in ' + s.passes + ' forward passes'].join(' \\u00b7 ');
    $('task').textContent = s.task ? '\\u201c' + s.task + '\\u201d' : '';
    $('joints').replaceChildren(row(['joint', 'action', 'predicted state', 'difference'], 'th'),
      ...s.joints.map(j => row([j.name, number(j.action), number(j.state), number(j.difference)])));
    if (s.has_preview) $('frame').src = 'api/preview.jpg?t=' + Date.now() + which.replace('?', '&');
    $('sessions').replaceChildren(...s.sessions.map(one => {
      const tr = row(['session ' + one.number, one.user, one.steps + ' steps', one.frames + ' frames',
      one.task]); tr.className = 'row' + (one.number === chosen ? ' chosen' : '');
      tr.title = 'watch this session; once more: the latest';
      tr.onclick = () => { chosen = one.number === chosen ? null : one.number; tick(); };
      return tr; }));
  } catch (e) { $('line').textContent = 'the server does not answer'; }
}
tick(); setInterval(tick, 1000);
</script></html>
"""
