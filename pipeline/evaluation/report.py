"""result.json and report.html: what was claimed, what was measured, and how far imagination could be trusted."""

from __future__ import annotations

import html
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from pipeline.artefact import read_manifest, write_text
from pipeline.evaluation.media import inline, plot, smooth
from pipeline.evaluation.statistics import mcnemar

Found = Mapping[str, Path]


def _result(found: Found, name: str) -> dict[str, Any]:
    manifest = read_manifest(found[name])
    assert manifest is not None, f"{name} is a parent of the report and must be finished"
    return dict(manifest["result"])


def build_result(cfg: Mapping[str, Any], found: Found, rounds: int) -> dict[str, Any]:
    """The figures of a run; see the README for the fields."""
    outcomes = {
        when: torch.load(found[f"evaluate-{when}"] / "outcomes.pt", weights_only=True)["success"]
        for when in ("before", "after")
    }
    physics = {
        when: {k: _result(found, f"evaluate-{when}")[k] for k in ("successes", "episodes", "low", "high")}
        for when in outcomes
    }
    imagined = _result(found, "evaluate-imagined")
    gaps = [_result(found, f"gap-{n}") for n in range(1, rounds + 1)]
    used = _result(found, "collect")["episodes"] + sum(
        _result(found, f"deploy-{n}")["episodes"] for n in range(1, rounds + 1)
    )
    # type: ignore[index]
    seconds = {name: read_manifest(folder)["seconds"] for name, folder in found.items()}
    paired = mcnemar(outcomes["before"], outcomes["after"])
    measured = _result(found, "measure")
    result = {
        "name": cfg["name"],
        "seed": cfg["seed"],
        "engine": cfg["simulator"]["engine"],
        "algorithm": cfg["algorithm"]["name"],
        "physics_before": physics["before"],
        "physics_after": physics["after"],
        "paired": paired,
        "imagined_before": imagined["before"],
        "imagined_after": imagined["after"],
        "judge": measured["judge"],
        "rollout": measured["rollout"],
        "frames_per_second": measured["frames_per_second"],
        "rounds": gaps,
        "physics_episodes_used": used,
        "imagined_episodes_used": [
            _result(found, f"rl-{n}")["ledger"]["learned"] for n in range(1, rounds + 1)
        ],
        "physics_episodes_held_out": _result(found, "held-out")["episodes"],
        "stage_seconds": seconds,
        "alarms": [text for n in range(1, rounds + 1) for text in _result(found, f"rl-{n}")["alarms"]],
    }
    result["verdict"] = verdict(result)
    return result


def verdict(result: Mapping[str, Any]) -> str:
    """One sentence: gain or none, and in the latter case what the figures say of why."""
    before, after, paired = result["physics_before"], result["physics_after"], result["paired"]
    points = 100 * (after["successes"] / after["episodes"] - before["successes"] / before["episodes"])
    head = f"true success {before['successes']}/{before['episodes']} -> {after['successes']}/{after['episodes']} ({points:+.1f} points, McNemar p = {paired['p']:.2g})"
    if points > 0 and paired["p"] < 0.01:
        return f"gain: {head}"
    dreamt = 100 * (_rate(result["imagined_after"]) - _rate(result["imagined_before"]))
    gap = result["rounds"][-1]["gap"] if result["rounds"] else float("nan")
    if min(points, dreamt) > 0 and dreamt - points < 5:
        why = f"true success rose as imagined success did ({dreamt:+.0f} points), but too little to tell from chance; give RL more iterations (rounds.iterations) or evaluate on more episodes"
    elif dreamt > 5:
        why = f"imagined success rose by {dreamt:.0f} points and true success did not follow: the policy exploits the simulator (gap in the last round {100 * gap:+.0f} points); deploy more episodes per round"
    elif dreamt > -2 and result["alarms"]:
        why = f"RL did not improve even imagined success; {result['alarms'][0]}"
    else:
        why = f"RL moved imagined success by {dreamt:+.0f} points only; give it more iterations (rounds.iterations) or a higher rl.lr"
    return f"no gain: {head}. {why}"


def _rate(entry: Mapping[str, Any]) -> float:
    return entry["successes"] / max(1, entry["episodes"])


_STYLE = """
:root{color-scheme:light dark;--ink:#1d2430;--dim:#667085;--line:#e4e7ec;--card:#fff;--page:#f6f7f9;--good:#12805c;--bad:#b42318;--blue:#2f6fed}
@media(prefers-color-scheme:dark){:root{--ink:#e8ebf0;--dim:#98a2b3;--line:#2b3240;--card:#171b23;--page:#0f1218;--good:#3ecf8e;--bad:#f97066;--blue:#7aa7ff}img.plot{filter:invert(.9) hue-rotate(180deg)}}
*{box-sizing:border-box}body{margin:0;background:var(--page);color:var(--ink);font:15px/1.5 system-ui,sans-serif}
main{max-width:1080px;margin:0 auto;padding:36px 20px 80px}h1{font-size:30px;margin:0 0 4px}h2{font-size:19px;margin:40px 0 12px}
.dim{color:var(--dim)}.verdict{font-size:17px;padding:14px 18px;border-radius:10px;background:var(--card);border-left:5px solid var(--good);margin:18px 0}
.verdict.none{border-color:var(--bad)}.grid{display:grid;grid-template-columns:repeat(auto-fit,minmax(220px,1fr));gap:14px}
.card{background:var(--card);border:1px solid var(--line);border-radius:10px;padding:14px 16px}.card b{display:block;font-size:28px;letter-spacing:-.02em}
.wide{display:grid;grid-template-columns:repeat(auto-fit,minmax(440px,1fr));gap:14px}table{border-collapse:collapse;width:100%;background:var(--card);border:1px solid var(--line);border-radius:10px;overflow:hidden}
th,td{padding:7px 12px;text-align:right;border-bottom:1px solid var(--line);font-variant-numeric:tabular-nums}th:first-child,td:first-child{text-align:left}th{font-weight:600;color:var(--dim);font-size:13px}td{white-space:nowrap}
tr:last-child td{border-bottom:0}img.plot{width:100%}video{width:100%;border-radius:8px;background:#000}.bar{height:10px;border-radius:5px;background:var(--line);position:relative;margin:10px 0 2px}
.bar i{position:absolute;top:0;bottom:0;border-radius:5px;background:var(--blue);opacity:.35}.bar u{position:absolute;top:-3px;width:3px;height:16px;background:var(--blue);border-radius:2px}code{font-size:13px}
"""


def build_report(
    cfg: Mapping[str, Any], found: Found, result: Mapping[str, Any], rounds: int, path: Path
) -> None:
    """Write one self-contained HTML file: verdict, curves, tables, confusion matrices, paired videos."""
    good = result["verdict"].startswith("gain")
    parts = [
        f"<h1>{html.escape(str(result['name']))}</h1><div class=dim>seed {result['seed']} · {result['engine']} simulator · {result['algorithm']} in imagination · "
        f"{result['physics_episodes_used']} physics episodes learned from</div>",
        f"<div class='verdict{'' if good else ' none'}'>{html.escape(result['verdict'])}</div>",
        "<div class=grid>" + "".join(_rate_card(title, result[key]) for title, key in _CARDS) + "</div>",
        "<h2>Imagined above true</h2><p class=dim>Each video shows the policy in physics (below) and the simulator under the same actions (above), from the first frame on.</p>",
        "<div class=wide>" + "".join(_video(file) for file in _pick_videos(found)) + "</div>",
        "<h2>Rounds</h2><p class=dim>The stochastic policy just deployed, in physics and in the refreshed simulator, from the same starts.</p>"
        + _rounds_table(result),
        "<h2>Learning</h2><div class=wide>"
        + "".join(f"<div class=card><img class=plot src='{url}'></div>" for url in _curves(found, rounds))
        + "</div>",
        "<h2>How far to trust the simulator</h2><p class=dim>Held-out episodes rolled out from their first frame under their true actions; 'stick' is the error of the colour locator itself on true video.</p>"
        + _rollout_table(result),
        "<h2>How far to trust the judge</h2>" + _judge_table(result),
        "<h2>Where the time went</h2>" + _time_table(result),
        "<h2>Hosts and learner</h2><p class=dim>While learning in imagination, means over the iterations of a round.</p>"
        + _hosts_table(found, rounds),
        f"<h2>Config</h2><details><summary class=dim>resolved config</summary><pre>{html.escape(json.dumps(cfg, indent=1, default=str))}</pre></details>",
    ]
    page = f"<!doctype html><html lang=en><meta charset=utf-8><meta name=viewport content='width=device-width'><title>{html.escape(str(result['name']))} · Worldloop</title><style>{_STYLE}</style><main>{''.join(parts)}</main></html>"
    write_text(path, page)


_CARDS = (
    ("True success before", "physics_before"),
    ("True success after", "physics_after"),
    ("Imagined before", "imagined_before"),
    ("Imagined after", "imagined_after"),
)


def _rate_card(title: str, entry: Mapping[str, Any]) -> str:
    rate = 100 * _rate(entry)
    low, high = 100 * entry["low"], 100 * entry["high"]
    return (
        f"<div class=card><span class=dim>{title}</span><b>{rate:.1f}%</b><div class=bar><i style='left:{low:.1f}%;width:{high - low:.1f}%'></i><u style='left:{rate:.1f}%'></u></div>"
        f"<span class=dim>{entry['successes']}/{entry['episodes']}, 95% [{low:.1f}, {high:.1f}]</span></div>"
    )


def _pick_videos(found: Found) -> list[Path]:
    files = sorted((found["videos"] / "media").glob("*.mp4"))
    before, after = ([f for f in files if f.name.startswith(w)] for w in ("before", "after"))
    return [file for pair in zip(before, after, strict=False) for file in pair]


def _video(file: Path) -> str:
    return f"<div class=card><video controls autoplay loop muted playsinline src='{inline(file.read_bytes(), 'video/mp4')}'></video><span class=dim>{html.escape(file.stem)}</span></div>"


def _table(head: list[str], rows: list[list[str]]) -> str:
    cells = "".join("<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>" for row in rows)
    return "<table><tr>" + "".join(f"<th>{cell}</th>" for cell in head) + f"</tr>{cells}</table>"


def _rounds_table(result: Mapping[str, Any]) -> str:
    rows = []
    for entry in result["rounds"]:
        replayed = entry.get("replayed", {})
        rows.append(
            [
                f"round {entry['round']}",
                f"{100 * _rate(entry['true']):.1f}% of {entry['true']['episodes']}",
                f"{100 * _rate(entry['imagined']):.1f}% of {entry['imagined']['episodes']}",
                f"{100 * entry['gap']:+.1f}",
                f"{100 * replayed['accuracy']:.1f}%" if replayed else "-",
            ]
        )
    return _table(["", "true", "imagined", "gap, points", "per-episode accuracy, held out"], rows)


def _pm(entry: Mapping[str, float], digits: int = 2) -> str:
    return f"{entry['median']:.{digits}f} / {entry['p90']:.{digits}f}"


def _rollout_table(result: Mapping[str, Any]) -> str:
    rows = [
        [
            name,
            str(e["episodes"]),
            _pm(e["object_px"]),
            _pm(e["object_cm"]),
            _pm(e["object_cm_at_end"]),
            _pm(e["place_cm"]),
            f"{100 * e['object_lost']:.1f}%",
            f"{e['psnr_first_frames']:.1f} → {e['psnr_last_frames']:.1f}",
            _pm(e["state_rad"], 4),
            _pm(e["stick_px"]),
        ]
        for name, e in result["rollout"].items()
    ]
    speed = ", ".join(f"{name}: {value:.0f}" for name, value in result["frames_per_second"].items())
    head = [
        "episodes",
        "n",
        "object px, median / p90",
        "cm",
        "cm at the end",
        "own account cm",
        "lost",
        "PSNR dB, first → last",
        "state rad",
        "stick px",
    ]
    return (
        _table(head, rows)
        + f"<p class=dim>frames per second (all views of a time step count once): {speed}</p>"
    )


def _judge_table(result: Mapping[str, Any]) -> str:
    rows = []
    for group, kinds in result["judge"].items():
        for kind, table in kinds.items():
            rows.append(
                [
                    f"{group}, {kind}",
                    *(str(table[k]) for k in ("tp", "fp", "fn", "tn")),
                    f"{100 * table['accuracy']:.1f}%",
                ]
            )
    return _table(
        ["", "true positive", "false positive", "false negative", "true negative", "accuracy"], rows
    )


def _time_table(result: Mapping[str, Any]) -> str:
    total = sum(result["stage_seconds"].values())
    rows = [
        [name, f"{seconds:.1f} s", f"{100 * seconds / max(total, 1e-9):.1f}%"]
        for name, seconds in result["stage_seconds"].items()
    ]
    return _table(["stage", "time", "share"], [*rows, ["<b>total</b>", f"<b>{total:.0f} s</b>", ""]])


def _hosts_table(found: Found, rounds: int) -> str:
    rows = []
    for number in range(1, rounds + 1):
        metrics = read_metrics(found[f"rl-{number}"])
        mean = (
            {key.removeprefix("rl/"): sum(row[key] for row in metrics) / len(metrics) for key in metrics[0]}
            if metrics
            else {}
        )
        ledger = _result(found, f"rl-{number}").get("ledger", {})
        if not mean or not ledger:
            continue
        dropped = (
            ", ".join(f"{count} {html.escape(reason)}" for reason, count in ledger["dropped"].items())
            or "none"
        )
        shares = (mean["time/actors_idle_share"], mean["time/forward_share"])
        rows.append(
            [
                f"round {number}",
                str(ledger["asked"]),
                str(ledger["learned"]),
                dropped,
                f"{mean['time/rollout']:.1f} s",
                f"{mean['time/update']:.1f} s",
                *(f"{100 * share:.0f}%" for share in shares),
            ]
            + [
                f"{mean['time/sync_ms']:.1f} ms",
                f"{mean['wire_bytes'] / 2**20:.1f} MiB",
                f"{mean['policy_lag']:.1f}",
            ]
        )
    return _table(
        [
            "",
            "episodes asked",
            "learned from",
            "dropped",
            "rollout",
            "update",
            "hosts idle",
            "in networks",
            "weights sent",
            "on the wire",
            "policy lag",
        ],
        rows,
    )


def read_metrics(folder: Path) -> list[dict[str, float]]:
    """Rows of a stage's metrics.jsonl, empty if there is none."""
    path = folder / "metrics.jsonl"
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def _curves(found: Found, rounds: int) -> list[str]:
    urls = []
    success, offset = [], 0
    for number in range(1, rounds + 1):
        rows = read_metrics(found[f"rl-{number}"])
        success.append(
            (f"round {number}", [offset + row["step"] for row in rows], [row["rl/success"] for row in rows])
        )
        offset += len(rows)
    urls.append(plot(success, "Imagined success while learning (stochastic)", "iteration", "success"))
    for stage, metric, title in (
        ("vision", "vision/loss", "Simulator loss"),
        ("judge", "judge/frame_accuracy", "Judge frame accuracy"),
        ("imitation", "imitation/loss", "Imitation loss"),
    ):
        curves = []
        for name in found:
            if name == stage or name.startswith(f"{stage}-"):
                rows = read_metrics(found[name])
                values = smooth([row[metric] for row in rows], 25)
                curves.append((name, list(range(len(values))), values))
        urls.append(plot(curves, title, "step", metric.split("/")[1].replace("_", " ")))
    curves = []
    for part, key, label in (
        ("sight", "found_cm", "found in the first view"),
        ("contact", "way_cm", "moved by commands"),
    ):
        values = smooth([row[f"{part}/{key}"] for row in read_metrics(found["vision-1"] / part)], 50)
        curves.append((label, list(range(len(values))), values))
    if any(values for _, _, values in curves):  # empty where no episode knows its objects' places
        urls.append(plot(curves, "Objects' places, round 1", "step", "error in cm"))
    return urls
