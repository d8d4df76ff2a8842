"""The live page: the last frame of a session, its joint state and its commands, asked for once a second."""

PAGE = """<!doctype html>
<html lang="en"><meta charset="utf-8"><title>Worldloop: served world model</title>
<style>
:root { color-scheme: light dark }
body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 70rem; padding: 0 1rem }
h1 { font-size: 1.3rem; margin: 0 } .quiet { opacity: .65 }
img { width: 100%; image-rendering: pixelated; background: #8883; border-radius: .5rem; min-height: 8rem; margin: 1rem 0 }
table { border-collapse: collapse; font-variant-numeric: tabular-nums } td, th { padding: .15rem .8rem .15rem 0; text-align: left }
tr.row { cursor: pointer } tr.chosen { font-weight: 600 }
.bars { display: grid; grid-template-columns: repeat(16, 1fr); gap: .3rem; height: 6rem; align-items: center }
.bars div { background: #4a8; border-radius: .2rem; min-height: 1px }
.two { display: grid; grid-template-columns: 1fr 1fr; gap: 2rem }
</style>
<h1 id="model">world model</h1>
<div class="quiet" id="line"></div>
<img id="frame" alt="no frame yet">
<div class="two"><div><b>joint state</b><div class="bars" id="state"></div></div><div><b>last action</b><div class="bars" id="action"></div></div></div>
<p id="task"></p>
<table id="sessions"></table>
<script>
let chosen = null;
const $ = id => document.getElementById(id);
function bars(id, values) {
  $(id).replaceChildren(...(values || []).map(v => { const d = document.createElement('div');
    d.style.height = Math.min(100, 3 + Math.abs(v) / Math.PI * 100) + '%'; d.title = v.toFixed(3); return d; }));
}
async function tick() {
  const which = chosen === null ? '' : '?session=' + chosen;
  try {
    const s = await (await fetch('api/status' + which)).json();
    $('model').textContent = 'world model: ' + s.model;
    $('line').textContent = s.phase + ' \\u00b7 ' + s.sessions.length + ' sessions \\u00b7 ' + s.steps + ' steps in ' + s.passes + ' forward passes';
    $('task').textContent = s.task ? '\\u201c' + s.task + '\\u201d' : '';
    bars('state', s.state); bars('action', s.action);
    if (s.has_preview) $('frame').src = 'api/preview.jpg?t=' + Date.now() + which.replace('?', '&');
    $('sessions').replaceChildren(...s.sessions.map((row, n) => { const tr = document.createElement('tr'); tr.className = 'row' + (n === chosen ? ' chosen' : '');
      tr.onclick = () => { chosen = n; tick(); };
      for (const text of [row.user, row.steps + ' steps', row.frames + ' frames', row.task]) { const td = document.createElement('td'); td.textContent = text; tr.append(td); } return tr; }));
  } catch (e) { $('line').textContent = 'the server does not answer'; }
}
tick(); setInterval(tick, 1000);
</script></html>
"""
