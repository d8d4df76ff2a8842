"""The verdict can say no, and the page shows what a run and its controls have."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from pipeline.evaluation.report import build_report
from pipeline.evaluation.result import verdict
from pipeline.graph.stage import Inputs


def entry(successes: int) -> dict[str, Any]:
    return {"successes": successes, "episodes": 100, "low": 0.1, "high": 0.9}


def result(**changes: Any) -> dict[str, Any]:
    table = {"tp": 1, "fp": 2, "fn": 3, "tn": 4, "accuracy": 0.5}
    rows = {
        "expert": {
            "episodes": 4,
            "psnr_first_frames": 20.0,
            "psnr_last_frames": 15.0,
            "state": {"median": 0.1, "p90": 0.2},
            "object_px": {"median": 1.0, "p90": 2.0},
            "object_lost": 0.25,
        },
        "random": {
            "episodes": 4,
            "psnr_first_frames": 20.0,
            "psnr_last_frames": 15.0,
            "state": {"median": 0.1, "p90": 0.2},
        },
    }
    base = {
        "name": "tiny <run>",
        "seed": 0,
        "task": "push",
        "simulator": "UNetSimulator",
        "policy": "ChunkPolicy",
        "algorithm": "PPO",
        "physics_before": entry(40),
        "physics_after": entry(70),
        "paired": {"gained": 35, "lost": 5, "p": 1e-6},
        "imagined_before": entry(40),
        "imagined_after": entry(75),
        "judge": {"expert": {"recorded": table, "generated": table}},
        "rollout": rows,
        "frames_per_second": {"batch 1": 30.0, "batch 32": 300.0},
        "tasks": {},
        "rounds": [{"round": 1, "true": entry(40), "imagined": entry(44), "gap": 0.04, "replayed": table}],
        "episodes_used": 60,
        "episodes_held_out": 10,
        "imagined_episodes_used": [256],
        "stage_seconds": {"collect": 3.0, "rl-1": 9.0},
        "alarms": [],
    }
    return {**base, **changes}


def test_the_verdict_can_say_no_and_why() -> None:
    assert verdict(result()).startswith("gain")
    small = {"paired": {"gained": 1, "lost": 1, "p": 0.9}}
    fooled = verdict(result(physics_after=entry(41), imagined_after=entry(90), **small))
    assert fooled.startswith("no gain") and "exploits" in fooled
    near = verdict(result(physics_after=entry(45), imagined_after=entry(47), **small))
    assert "chance" in near and "exploits" not in near
    flat = verdict(result(physics_after=entry(39), imagined_after=entry(40), **small))
    assert "iterations" in flat
    alone = verdict(result(physics_before=None, physics_after=None, paired=None))
    assert "without physics" in alone


@pytest.fixture
def inputs(tmp_path: Path) -> Inputs:
    rl, videos = tmp_path / "rl-1-abc", tmp_path / "videos-abc"
    (videos / "media").mkdir(parents=True)
    rl.mkdir()
    for name in ("before-1-0", "after-1-0"):
        (videos / "media" / f"{name}.mp4").write_bytes(b"video")
    ledger = {"asked": 256, "learned": 256, "dropped": {"judge": 2}}
    for folder, stage, made in ((rl, "rl-1", {"ledger": ledger, "alarms": []}), (videos, "videos", {})):
        manifest = {"stage": stage, "seconds": 1.0, "result": made}
        (folder / "manifest.json").write_text(json.dumps(manifest))
    rows = [{"step": n, "rl/success": 0.1 * n, "rl/time/rollout": 2.0} for n in range(3)]
    (rl / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    return Inputs({"stages": (rl, videos), "videos": videos})


def test_the_page_is_one_file_with_everything(inputs: Inputs) -> None:
    page = build_report({"name": "tiny", "rl": {"lr": 0.1}}, inputs, {**result(), "verdict": "gain: yes"})
    assert page.count("data:video/mp4") == 2 and page.index("before-1-0") < page.index("after-1-0")
    assert "tiny &lt;run&gt;" in page and "worldloop controls" in page and "lr: 0.1" in page
    assert "http" not in page.replace("http://www.w3.org", "").split("<h2>Config")[0]
    assert "2 judge" in page and "25.0%" in page


def test_the_page_shows_tasks(inputs: Inputs) -> None:
    whole = {f"physics_{when}": entry(n) for when, n in (("before", 10), ("after", 35))}
    tasks = {
        "open": {**whole, "paired": {"gained": 25, "lost": 0, "p": 1e-6}, "imagined_before": entry(77)},
        "close": {"physics_before": None, "physics_after": None, "paired": None, "imagined_after": entry(88)},
    }
    page = build_report({}, inputs, {**result(tasks=tasks), "verdict": "gain"})
    assert "Task by task" in page and "+25.0" in page and "77.0%" in page and "88.0%" in page
    assert "Task by task" not in build_report({}, inputs, {**result(), "verdict": "gain"})


def test_the_page_shows_controls_and_runs_without_physics(inputs: Inputs) -> None:
    row = {**entry(50), "gain": 10.0, "paired": {"gained": 12, "lost": 2, "p": 0.01}, "physics_episodes": 16}
    controls = {"before": {**entry(40), "paired": None, "physics_episodes": 0}, "filtered BC": row}
    page = build_report({}, inputs, {**result(), "verdict": "gain"}, controls)
    assert "filtered BC" in page and "+10.0" in page and "have not been run" not in page
    alone = result(physics_before=None, physics_after=None, paired=None, rounds=[], verdict="imagined")
    assert "no physics to try" in build_report({}, inputs, alone)
