"""The live page: the last frame of a session, its commands beside its states, asked for once a second."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any


def joint_table(
    action_names: Sequence[str],
    action: Sequence[float] | None,
    state_names: Sequence[str],
    state: Sequence[float] | None,
) -> list[dict[str, Any]]:
    """A row for every number of the last action and the last predicted state: name, action, state, and state
    minus action where both have a number of that name. None is unknown.
    """
    # Joint commands of a robot that takes poses are no numbers of its own.
    commanded = (
        dict(zip(action_names, action, strict=True)) if action and len(action) == len(action_names) else {}
    )
    predicted = dict(zip(state_names, state, strict=True)) if state else {}
    rows = []
    for name in dict.fromkeys((*state_names, *action_names)):
        told, found = commanded.get(name), predicted.get(name)
        gap = None if told is None or found is None else found - told
        rows.append({"name": name, "action": told, "state": found, "difference": gap})
    return rows


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
