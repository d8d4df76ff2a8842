"""The verdict can say no, and the page shows what a run and its controls have."""

from __future__ import annotations

import base64
import json
import math
import re
from pathlib import Path
from typing import Any

import pytest

from pipeline.config import load_config
from pipeline.evaluation.charts import Curve, line_chart
from pipeline.evaluation.compare import compare
from pipeline.evaluation.heat import heat_maps
from pipeline.evaluation.report import build_report
from pipeline.evaluation.result import unjudged
from pipeline.evaluation.verdict import verdict
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
            "psnr_first_frames": None,
            "psnr_last_frames": 15.0,
            "state": {"median": 0.1, "p90": 0.2},
            "object_px": None,
            "object_lost": 1.0,
        },
    }
    told = {"value": 0.31, "measured": (0.42, 0.1), "known": (0.37, 0.08), "moments": 96}
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
        "scenes": [],
        "exploration": None,
        "rounds": [
            {
                "round": 1,
                "true": entry(40),
                "imagined": entry(44),
                "gap": 0.04,
                "unseen": 80,
                "replayed": table,
            }
        ],
        "trials": [
            {"round": 1, **entry(40), "tasks": {}, "kept": None, "gained": None, "lost": None},
            {"round": 2, **entry(31), "tasks": {"grasp": entry(3)}, "kept": False, "gained": 9, "lost": 18},
        ],
        "worth": [
            {
                "round": 1,
                "worth": {"push": told, "grasp": {**told, "value": 1.0, "measured": None, "known": None}},
            }
        ],
        "episodes_used": 60,
        "episodes_held_out": 10,
        "imagined_episodes_used": [256],
        "stage_seconds": {"collect": 3.0, "rl-1": 9.0},
        "training": {"rl-1": {"samples_per_second": 812.0, "data_share": 0.031}},
        "alarms": [],
    }
    return {**base, **changes}


def video(label: str, seed: int, disagreement: float = 0.1) -> dict[str, Any]:
    """An entry of videos.json."""
    return {
        "file": f"{label}-{seed}.mp4",
        "label": label,
        "fps": 5.0,
        "episode": 0,
        "seed": seed,
        "source": "noisy",
        "instruction": "push <it>",
        "success": True,
        "task": "push",
        "scene": "oak table",
        "recorded": 0.9,
        "generated": 1 - disagreement,
        "claims": disagreement < 0.5,
        "disagreement": disagreement,
        "done": 2,
        "curves": {"recorded": [0.1, 0.5, 0.9, 1.0], "generated": [0.1, 0.2, 0.2, 0.3]},
    }


def test_the_verdict_can_say_no_and_why() -> None:
    assert verdict(result()).startswith("gain")
    small = {"paired": {"gained": 1, "lost": 1, "p": 0.9}}
    fooled = verdict(result(physics_after=entry(41), imagined_after=entry(90), **small))
    assert fooled.startswith("no gain") and "exploits" in fooled
    low = {"imagined_before": entry(2), "imagined_after": entry(20)}
    bleak = verdict(result(physics_after=entry(41), **low, **small))
    assert "too bleak" in bleak and "exploits" not in bleak
    near = verdict(result(physics_after=entry(45), imagined_after=entry(47), **small))
    assert "chance" in near and "exploits" not in near
    flat = verdict(result(physics_after=entry(39), imagined_after=entry(40), **small))
    assert "iterations" in flat
    blind = [{"round": 1, "true": entry(0), "imagined": entry(100), "gap": 1.0}]
    useless = verdict(result(physics_after=entry(40), imagined_after=entry(40), rounds=blind, **small))
    assert "it says 100% of a policy that succeeds in 0%" in useless and "iterations" not in useless
    none = dict.fromkeys(("physics_before", "physics_after", "imagined_before", "imagined_after"), entry(0))
    assert "more demonstrations" in verdict(result(**none, **small))
    alarms = ["tokenizer: collapsed", "rl-2: no reward variance"]
    alarmed = verdict(result(physics_after=entry(39), imagined_after=entry(40), alarms=alarms, **small))
    assert "even imagined success; rl-2: no reward variance" in alarmed
    lost = {"paired": {"gained": 5, "lost": 25, "p": 0.0003}}
    worse = verdict(result(physics_after=entry(20), imagined_after=entry(40), **lost))
    assert "followed noise" in worse and "rl.lr" in worse and "higher" not in worse
    alone = verdict(result(physics_before=None, physics_after=None, paired=None))
    assert "without physics" in alone


NOTHING = {"successes": 0, "episodes": 0, "low": 0.0, "high": 1.0, "dropped": 16}


def test_what_was_not_judged_is_not_a_failure(inputs: Inputs, tmp_path: Path) -> None:
    none = {"imagined_before": NOTHING, "imagined_after": NOTHING}
    small = {"paired": {"gained": 1, "lost": 1, "p": 0.9}, "physics_after": entry(41)}
    alarms = unjudged(load_config(["experiment=smoke"]), NOTHING)
    assert "16 of 16 imagined episodes" in alarms[0] and "judge." in alarms[0]
    assert not unjudged(load_config(["experiment=smoke"]), {**NOTHING, "episodes": 16})
    flat = verdict(result(**none, **small, alarms=alarms))
    assert "16 of 16" in flat and "+0 points" not in flat and "rl.lr" not in flat
    assert verdict(result(**none)).startswith("gain: ")
    alone = {"physics_before": None, "physics_after": None, "paired": None}
    blind = verdict(result(**none, **alone, alarms=alarms))
    assert blind.startswith("nobody knows") and "16 of 16" in blind and "+0.0" not in blind
    assert "choose another" in verdict(result(**none, **alone))
    crashed = verdict(result(physics_after=NOTHING))
    assert crashed.startswith("nobody knows") and "task.suite" in crashed
    told = result(**none, tasks={"push": {**alone, **none}}, verdict="-")
    told["rounds"][0] |= {"true": NOTHING, "imagined": NOTHING, "gap": None}
    page = build_report({}, inputs, told)
    assert page.count("<td>not judged</td>") == 4 and page.count("<b>not judged</b>") == 2
    (tmp_path / "one").mkdir()
    (tmp_path / "one/result.json").write_text(json.dumps(told))
    table = compare([tmp_path / "one"])
    assert "| imagined before → after | not judged → not judged |" in table


@pytest.fixture
def inputs(tmp_path: Path) -> Inputs:
    rl, videos = tmp_path / "rl-1-abc", tmp_path / "videos-abc"
    (videos / "media").mkdir(parents=True)
    rl.mkdir()
    shown = [
        video("worst", 8, 0.9),
        video("before", 1),
        video("before", 2),
        video("after", 1),
        video("after", 2, 0.8),
    ]
    for one in shown:
        (videos / "media" / one["file"]).write_bytes(one["file"].encode())
    (videos / "videos.json").write_text(json.dumps(shown))
    ledger = {"requested": 256, "learned": 256, "dropped": {"judge": 2}}
    for folder, stage, made in ((rl, "rl-1", {"ledger": ledger, "alarms": []}), (videos, "videos", {})):
        manifest = {"stage": stage, "seconds": 1.0, "result": made}
        (folder / "manifest.json").write_text(json.dumps(manifest))
    rows = [{"step": n, "rl/success": 0.1 * n, "rl/time/rollout": 2.0} for n in range(3)]
    (rl / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    return Inputs({"stages": (rl, videos), "videos": videos})


def test_the_page_is_one_file_with_everything(inputs: Inputs) -> None:
    page = build_report({"name": "tiny", "rl": {"lr": 0.1}}, inputs, {**result(), "verdict": "gain: yes"})
    assert "tiny &lt;run&gt;" in page and "worldloop controls" in page and "lr: 0.1" in page
    assert not re.findall(r'(?:src|href)=(?!"data:|"#)', page) and "url(" not in page
    assert "http" not in page.split("<h2 id=config>")[0]
    assert "2 judge" in page and "25.0%" in page and "3.1%" in page and "812" in page
    assert "held-out starts" in page and "<td>80</td>" in page
    assert (
        "<td>round 1, push</td><td>0.31</td>" in page
        and "0.42 &plusmn; 0.10" in page
        and "0.37 &plusmn; 0.08" in page
    )
    assert "<td>round 1, grasp</td><td>1.00</td>" in page and "nothing told" in page


def test_the_page_tells_alarms_and_what_nobody_knows(inputs: Inputs) -> None:
    said = result(alarms=["rl-1: no reward variance: <why>"], judge={}, rollout={}, verdict="-")
    page = build_report({}, inputs, said)
    assert "<li>rl-1: no reward variance: &lt;why&gt;</li>" in page
    assert "No episode was held out" in page and "nobody knows how often the judge is right" in page
    page = build_report({}, inputs, {**result(), "verdict": "-"})
    assert "Alarms" not in page and "nobody knows" not in page


def test_the_page_says_of_how_many_answers_nobody_knows_the_cost(inputs: Inputs) -> None:
    cost = {"calls": 3.0, "unusable": 0.0, "uncounted": 2.0, "prompt_tokens": 100.0, "cost": 0.001}
    page = build_report({}, inputs, {**result(), "verdict": "-", "judge_cost": cost})
    assert "calls 3, prompt tokens 100, cost 0.001, tokens of 2 answers unknown" in page
    page = build_report({}, inputs, {**result(), "verdict": "-", "judge_cost": {**cost, "uncounted": 0.0}})
    assert "Asked for by the whole run: calls 3, prompt tokens 100, cost 0.001.</p>" in page


def test_a_judge_that_judged_nothing_is_not_wrong(inputs: Inputs, tmp_path: Path) -> None:
    nothing = {"tp": 0, "fp": 0, "fn": 0, "tn": 0, "accuracy": None, "dropped": 4}
    told = result()
    told["judge"]["expert"]["generated"] = told["rounds"][0]["replayed"] = nothing
    page = build_report({}, inputs, {**told, "verdict": "-"})
    assert "<td>0</td><td>-</td><td>4</td>" in page and "0.0%</td><td>4</td>" not in page
    assert "+4.0</td>\n<td>-</td></tr>" in page
    (tmp_path / "one").mkdir()
    (tmp_path / "one/result.json").write_text(json.dumps(told))
    table = compare([tmp_path / "one"])
    assert "| verdicts that are right, recorded video | expert 1/4 successes, 4/6 failures |" in table
    assert "| verdicts that are right, generated video | expert none judged |" in table
    # nor is what nobody knows of a rollout a number
    assert "| object px | expert 1.00 / 2.00; random - |" in table
    assert "| PSNR dB, first → last frames | expert 20.0 → 15.0; random - → 15.0 |" in table
    assert "<td>- → 15.0</td>" in page and "nan" not in page


def test_the_worst_disagreements_come_first_and_pairs_stay_together(inputs: Inputs) -> None:
    page = build_report({}, inputs, {**result(), "verdict": "gain: yes"})
    order = [base64.b64decode(data).decode() for data in re.findall(r"data:video/mp4;base64,([^\"]+)", page)]
    assert order == ["worst-8.mp4", "before-2.mp4", "after-2.mp4", "before-1.mp4", "after-1.mp4"]
    assert page.count("svg class=progress") == 5 and page.count("badge apart") == 2
    assert "push, oak table · seed 8" in page and "“push &lt;it&gt;”" in page
    assert "Success by task" not in page  # one task in one scene: the figures above say it


def test_the_page_shows_tasks(inputs: Inputs) -> None:
    whole = {f"physics_{when}": entry(n) for when, n in (("before", 10), ("after", 35))}
    tasks = {
        "open": {**whole, "paired": {"gained": 25, "lost": 0, "p": 1e-6}, "imagined_before": entry(77)},
        "close": {"physics_before": None, "physics_after": None, "paired": None, "imagined_after": entry(88)},
    }
    page = build_report({}, inputs, {**result(tasks=tasks), "verdict": "gain"})
    title = "Before and after, task by task"
    assert title in page and "+25.0" in page and "77.0%" in page and "88.0%" in page
    assert title not in build_report({}, inputs, {**result(), "verdict": "gain"})


def test_the_page_shows_how_widely_the_policy_explores_by_task(inputs: Inputs) -> None:
    level = {**entry(31), "tasks": {"open": entry(13), "close": entry(18)}}
    page = build_report({}, inputs, {**result(), "verdict": "gain"})
    assert "Exploration" not in page
    found = {
        "level": {"name": "x0.35 on 50%", "width": 0.35, "share": 0.5},
        "mode": {**level, **entry(44)},
        "levels": {"x1 on 100%": entry(3), "x0.35 on 50%": level},
    }
    page = build_report({}, inputs, {**result(exploration=found), "verdict": "gain"})
    assert "<b>x0.35 on 50%</b>" in page and "44/100" in page and "3/100" in page and "31/100" in page
    assert page.count("18/100") == 2  # of the mode and of the level


def test_the_page_shows_which_policy_was_kept(inputs: Inputs) -> None:
    page = build_report({}, inputs, {**result(), "verdict": "gain"})
    table = page.split("Which policy was kept")[1].split("</table>")[0]
    rows = [re.findall(r"<td>(.*?)</td>", row, re.DOTALL) for row in table.split("<tr")[2:]]
    assert rows[0] == ["round 1", "40/100 = 40.0%", "10.0, 90.0", "-", "-", "-"]
    assert rows[1] == ["after the last", "31/100 = 31.0%", "10.0, 90.0", "9", "18", "no"]
    assert "grasp" in rows[2][0] and rows[2][1].startswith("3/100")
    assert "Which policy was kept" not in build_report({}, inputs, {**result(trials=[]), "verdict": "gain"})


def test_the_page_shows_controls_and_runs_without_physics(inputs: Inputs) -> None:
    row = {**entry(50), "gain": 10.0, "paired": {"gained": 12, "lost": 2, "p": 0.01}, "physics_episodes": 16}
    controls = {"before": {**entry(40), "paired": None, "physics_episodes": 0}, "filtered BC": row}
    page = build_report({}, inputs, {**result(), "verdict": "gain"}, controls)
    assert "filtered BC" in page and "+10.0" in page and "have not been run" not in page
    assert "privileged" not in page
    told = {**controls, "RL in physics": {**row, "note": "rewarded by what is privileged"}}
    page = build_report({}, inputs, {**result(), "verdict": "gain"}, told)
    assert page.count("rewarded by what is privileged") == 1
    alone = result(physics_before=None, physics_after=None, paired=None, rounds=[], verdict="imagined")
    assert "no physics to try" in build_report({}, inputs, alone)


def test_success_by_task_and_scene_is_a_heat_map(inputs: Inputs) -> None:
    cells = [
        {"task": task, "scene": scene, "physics_before": entry(20), "physics_after": entry(40), **more}
        for task, scene, more in (
            ("pull", "oak", {"imagined_after": entry(85)}),
            ("pull", "pine", {"imagined_after": entry(10)}),
            ("push", "oak", {}),
        )
    ]
    heat = heat_maps(cells)
    assert heat is not None and heat.scenes == ["oak", "pine"] and heat.wide
    assert [one.title for one in heat.maps] == [
        "true before",
        "true after",
        "imagined after",
        "imagined − true",
    ]
    gap = heat.maps[-1].rows
    assert [cell and cell.text for cell in gap["pull"]] == ["+45", "-30"] and gap["push"] == [None, None]
    assert gap["pull"][0] is not None and "--bad" in gap["pull"][0].colour
    page = build_report({}, inputs, {**result(scenes=cells), "verdict": "gain"})
    assert "Success by task and scene" in page and page.count("<td class=none>") == 1 + 1 + 2 + 2
    alone = [{**cell, "scene": ""} for cell in cells[:1]] + [{**cells[2], "scene": ""}]
    assert heat_maps(alone).scenes == [""]  # type: ignore[union-attr]
    assert "Success by task and scene" not in build_report(
        {}, inputs, {**result(scenes=alone), "verdict": "-"}
    )
    assert heat_maps([]) is None


def test_charts_are_drawn_within_their_frame() -> None:
    chart = line_chart(
        [Curve("a", [0, 1, 2], [1.0, math.nan, 3.0]), Curve("b <", [0, 5], [2.0, 2.5])], "T", "x", "y"
    )
    numbers = [
        float(n)
        for part in re.findall(r'class="line c\d" d="([^"]+)"', chart)
        for n in re.findall(r"[\d.]+", part)
    ]
    assert len(numbers) == 8 and min(numbers) >= 0 and max(numbers) <= 520
    assert "b &lt;" in chart and "nan" not in chart
    assert line_chart([Curve("a", [0], [math.nan])], "T", "x", "y") == ""
