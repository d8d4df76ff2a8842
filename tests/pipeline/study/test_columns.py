"""Columns: what they read from finished stages, how seeds are pooled, and which row is the best."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import torch

from envs.manifest import write_manifest
from envs.physics.suite import build_suite
from envs.targets import ConfigError
from learners.training.fit import FitConfig
from pipeline.config import load_config
from pipeline.evaluation.by_task import variant_of
from pipeline.graph.stage import Inputs
from pipeline.stages import pace
from pipeline.study.columns import Measured, Success
from pipeline.study.curves import SuccessOverTime
from pipeline.study.judges import FramesShown
from pipeline.study.show import OVER_SEEDS, markdown
from pipeline.study.side_by_side import best_of, headlines
from pipeline.study.worlds import Gain, Gap, Rollout, Speed, Training, Verdicts


def finished(folder: Path, stage: str, result: Mapping[str, Any]) -> Path:
    """A folder as a stage leaves it."""
    folder.mkdir(parents=True, exist_ok=True)
    write_manifest(folder, {"stage": stage, "result": result, "seconds": 1.0})
    return folder


def outcome(folder: Path, success: list[bool]) -> Path:
    """A folder of an evaluation in physics on the seeds 0, 1, ..."""
    folder.mkdir(parents=True, exist_ok=True)
    kept = {
        "success": torch.tensor(success),
        "counted": torch.ones(len(success), dtype=torch.bool),
        "seeds": torch.arange(len(success)),
    }
    torch.save(kept, folder / "outcomes.pt")
    return finished(folder, "evaluate", {})


@pytest.fixture(scope="module")
def cfg() -> dict[str, Any]:
    """Of the smallest experiment, on one task."""
    return load_config(["experiment=soak", "rl.evaluate_every=1", "rl.evaluate_episodes=4"])


def test_a_rollout_is_told_along_its_frames_as_far_as_there_are_any(
    tmp_path: Path, cfg: dict[str, Any]
) -> None:
    made, still = [30.0, 28.0, 26.0, 24.0, 20.0, 18.0, None], [25.0, 25.0, 25.0, 25.0, 19.0, 19.0, None]
    result = {"by_frame": {"psnr": made}, "still": {"psnr": still}, "object_lost": None, "chunk": 2}
    column = Rollout("video")
    cells = column.read(cfg, [finished(tmp_path, "video-errors", result)]).cells
    said = {label: column.text(cell) for label, cell in cells.items()}
    assert said == {
        "first chunk": "29.0 dB",
        "half way": "22.0 dB",
        "last frames": "19.0 dB",
        "still picture, last frames": "19.0 dB",
        "better than it for": "3 of 6 frames",
        "object lost": "-",
    }
    assert list(cells) == column.labels(cfg)


def test_figures_of_worlds(tmp_path: Path, cfg: dict[str, Any]) -> None:
    tables = {"tp": 3, "fp": 1, "fn": 0, "tn": 4, "dropped": 0, "accuracy": 0.875}
    worse = {**tables, "tp": 1, "fn": 2}
    measured = finished(
        tmp_path / "measure",
        "measure",
        {
            "frames_per_second": {"batch 1": 10.2, "batch 32": 90.0},
            "judge": {"on-policy": {"recorded": tables, "generated": worse}, "noisy": {"recorded": {}}},
        },
    )
    speed, verdicts = Speed("speed"), Verdicts("verdicts")
    assert speed.text(speed.read(cfg, [measured]).cells["batch 1"]) == "10 frames/s"
    found = verdicts.read(cfg, [measured]).cells
    assert [verdicts.text(found[label]) for label in verdicts.labels(cfg)] == [
        "3/3 successes, 4/5 failures",
        "1/3 successes, 4/5 failures",
    ]
    gap = Gap("gap")
    rates = {
        "true": {"successes": 2, "episodes": 8},
        "imagined": {"successes": 4, "episodes": 8},
        "gap": 0.25,
    }
    cell = gap.read(cfg, [finished(tmp_path / "gap", "gap-1", rates)]).cells["last"]
    assert gap.text(cell) == "+25.0 points (50% imagined, 25% true)" and gap.merit(cell) == -0.25
    stages = [
        finished(tmp_path / name, name, {"data_seconds": 1.0, "compute_seconds": 2.0, "steps": 7})
        for name in ("simulator-1", "state-1")
    ]
    training = Training("training")
    said = {label: training.text(cell) for label, cell in training.read(cfg, stages).cells.items()}
    assert said == {"simulator": "3 s, 7 steps", "state expert": "3 s, 7 steps"}
    assert list(said) == training.labels(cfg)


def test_gains_are_paired_and_pooled_over_seeds(tmp_path: Path, cfg: dict[str, Any]) -> None:
    column, before, after = Gain("gain"), [True, False, False, False], [True, True, True, False]
    one = column.read(cfg, [outcome(tmp_path / "before", before), outcome(tmp_path / "after", after)])
    cell = one.cells["all"]
    assert (cell["gain"], cell["gained"], cell["lost"], cell["episodes"]) == (50.0, 2, 0, 4)
    assert column.labels(cfg) == ["all"] and "75.0%" in column.text(cell) and "+50.0" in column.text(cell)
    other = column.read(cfg, [outcome(tmp_path / "b", after), outcome(tmp_path / "a", before)])
    both = column.pool([one, other]).cells["all"]
    assert (both["gain"], both["gained"], both["lost"], both["episodes"]) == (0.0, 2, 2, 8)
    pooled = Success("success").pool([one, other])
    assert pooled.cells["all"]["successes"] == 4 and len(pooled.outcomes) == 8
    means = Speed("speed").pool([Measured({"a": {"frames": 1.0}}), Measured({"a": {"frames": 3.0}})])
    assert means.cells == {"a": {"frames": 2.0}}


def test_a_curve_goes_on_from_stage_to_stage_in_the_time_of_learning(
    tmp_path: Path, cfg: dict[str, Any]
) -> None:
    first = outcome(tmp_path / "before", [False, True, False, False, True, True])
    rows = [(10.0, 0.25), (20.0, 0.75)], [(5.0, 0.5)]
    folders = []
    for number, some in enumerate(rows):
        folder = tmp_path / f"rl-{number}"
        folder.mkdir()
        lines = [{"step": 0, "rl/time/learning": 1.0}]
        lines += [{"rl/time/learning": seconds, "rl/true_success": rate} for seconds, rate in some]
        (folder / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
        folders.append(finished(folder, "rl", {"rollout_seconds": 15.0, "update_seconds": 6.0}))
    column = SuccessOverTime("curve", 40.0)
    one = column.read(cfg, [first, *folders])
    assert one.curve == [(0.0, 0.25), (10.0, 0.25), (20.0, 0.75), (26.0, 0.5)]
    said = [column.text(one.cells[label]) for label in column.labels(cfg)]
    assert [text.split(" ")[0] for text in said] == ["1/4", "3/4", "2/4", "20", "42"]
    never = column.read(cfg, [first, folders[1]])
    assert column.text(never.cells["+40 points after"]) == "not reached"
    pooled = column.pool([never, never])
    assert pooled.curve == never.curve and pooled.cells["first"]["episodes"] == 8
    unlike = column.pool([one, never])  # whose RL ended after one trial
    assert unlike.curve == [(0.0, 0.25), (7.5, 0.375), (12.5, 0.625), (15.5, 0.5)]
    assert unlike.cells["last"]["successes"] == unlike.cells["last"]["episodes"] / 2 == 4
    drawn = column.chart({"proxy": one, "learned": never})
    assert drawn.count('<path class="line') == 2 and "proxy" in drawn


def test_the_best_of_a_place_is_named_by_what_it_is_best_at() -> None:
    columns = {"speed": Speed("speed"), "training": Training("training")}

    def row(title: str, place: str, frames: float | None) -> dict[str, Any]:
        cell = None if frames is None else {"frames": frames}
        cells = {"speed": {"batch 1": None, "batch 32": cell}, "training": {"simulator": None}}
        return {"row": title, "place": place, "title": f"{title}, {place}", "seed": 0, "cells": cells}

    rows = [
        row("unet", "push", 9.0),
        row("dit", "push", 3.0),
        row("unet", "lift", 5.0),
        row("dit", "lift", None),
    ]
    table = {"rows": rows, "pooled": []}
    assert best_of(table, columns) == ["Best in push, of what was run: speed: unet, push."]
    lines = headlines(table, columns)
    assert lines[0] == ["", "speed, batch 32", "training, simulator"]
    assert lines[1] == ["unet, push", "9 frames/s", "not run"] and lines[-1][1] == "not run"


def test_what_cannot_be_shown_is_told() -> None:
    with pytest.raises(ConfigError, match="frames=0 should be all, ends, or a number"):
        FramesShown("frames", ["all", 0], 8)
    column = FramesShown("frames", [4, "ends"], 8)
    assert column.labels({}) == ["every 4th", "first and last"]
    none = {"tp": 0, "fp": 0, "fn": 0, "tn": 0, "accuracy": None, "dropped": 6, "shown": 2.0}
    assert column.text(none) == "none judged, 6 not judged (2 frames)" and column.merit(none) is None
    assert column.merit({**none, "tn": 6}) == 1.0
    assert column.merit({**none, "tn": 5, "fn": 1}) == 0.5  # a judge that always says no


@pytest.mark.parametrize(("simulator", "shares"), [("unet_small", (0.85, 0.15)), ("dit_small", (0.65, 0.15))])
def test_seconds_are_shared_out_among_the_parts_that_there_are(
    simulator: str, shares: tuple[float, float]
) -> None:
    cfg = load_config(["experiment=soak", f"simulator={simulator}", "equal_time.seconds=100"])
    parts = [pace.seconds_of(cfg, part, "first")["seconds"] for part in ("simulator", "state")]
    assert parts == pytest.approx([100 * share for share in shares])
    later = [pace.seconds_of(cfg, part, "refresh")["seconds"] for part in ("simulator", "state")]
    assert later == pytest.approx([8.5, 1.5])
    assert pace.seconds_of(load_config(["experiment=soak"]), "state", "first") == {}
    with pytest.raises(ConfigError, match=r"equal_time\.tokenizer=0\.9 and equal_time\.state=0\.15"):
        load_config(["equal_time.tokenizer=0.9"])


def test_a_state_expert_takes_the_steps_that_fit_with_its_features(tmp_path: Path) -> None:
    measured = {"state_sample_seconds": 0.001, "state_clip_seconds": 0.01, "state_clip_bytes": 10}
    folder = finished(tmp_path, "pace", {**measured, "simulator_speed": 40.0})
    inputs, fit = Inputs({"pace": folder}, {"seconds": 200.01}), FitConfig(steps=1, batch=50, lr=1e-3)
    assert pace.in_time(inputs, "simulator", fit).steps == 160
    expert, clips = pace.state_in_time(inputs, fit, 6000)
    assert (expert.steps, clips) == ((200 - 60) / 0.05, 6000)
    assert pace.state_in_time(inputs, fit, 100)[1] == 100
    other = Inputs({"pace": finished(tmp_path / "other", "pace", {})}, {"seconds": 200.0})
    assert pace.state_in_time(other, fit, 6000) == (fit, 6000)  # of what learns nothing
    assert pace.in_time(inputs, "tokenizer", fit) == fit


def test_a_task_without_episodes_is_not_called_not_run() -> None:
    whole = {"successes": 1, "episodes": 2, "low": 0.1, "high": 0.9}
    row = {"row": "mine", "place": "", "seed": 0, "note": "", "physics_episodes": {}, "minutes": 1.0}
    cells = {"push": whole, "pull": None, "all": whole}
    table = {
        "name": "study",
        "columns": {"success": {"title": "success", "labels": list(cells)}},
        "rows": [
            {**row, "title": "mine", "cells": {"success": cells}},
            {**row, "title": "other", "cells": {"success": dict.fromkeys(cells)}},
        ],
        "pooled": [],
        "comparisons": [],
    }
    lines = markdown(table, {"success": Success("success")}).splitlines()
    (mine,), (other,) = (
        [line for line in lines if line.startswith(f"| {name} |")] for name in ("mine", "other")
    )
    assert mine.count("no episode") == 1 and "not run" not in mine
    assert other.count("not run") == 3 and "no episode" not in other


def test_what_leaves_out_a_variant_that_a_task_has_not_is_an_option_of_any_study(
    cfg: dict[str, Any],
) -> None:
    with pytest.raises(ConfigError, match="has no variants") as refused:
        variant_of(cfg, "out_of_domain")
    told = re.findall(r"column by ([^ ]+)\)", str(refused.value))
    assert load_config(["experiment=soak", *told])["study"]["columns"] == ["success"]


def test_success_is_drawn_by_task_and_scene_of_a_variant(tmp_path: Path, cfg: dict[str, Any]) -> None:
    words = ["experiment=soak", "task=tabletop", "task.name=[push,pull]", "task.size=[32,32]"]
    many, column = load_config(words), Success("out of domain", "out_of_domain")
    one = column.read(many, [outcome(tmp_path / "one", [True, False, True, True])])
    both = column.pool([one, column.read(many, [outcome(tmp_path / "two", [False] * 4)])])
    unseen = build_suite({**many["task"]["suite"], **many["task"]["variants"]["out_of_domain"]}).scenes
    assert set(one.scenes.values()) <= set(unseen) and len(both.outcomes) == len(both.scenes) == 8
    page = str(column.chart({"mine": both}))
    assert "out of domain, by task and scene" in page and "<figcaption>mine</figcaption>" in page
    assert f"push, {one.scenes['push', 0]}: 1 of 2" in page
    alone = Success("success").read(cfg, [outcome(tmp_path / "three", [True, False])])
    assert Success("success").chart({"mine": alone}) == ""  # a suite without scenes


def test_rows_are_ranked_on_seeds_that_they_share() -> None:
    columns = {"speed": Speed("speed")}

    def row(title: str, seed: int, frames: float | None) -> dict[str, Any]:
        cell = None if frames is None else {"frames": frames}
        return {
            "row": title,
            "place": "",
            "title": title,
            "seed": seed,
            "cells": {"speed": {"batch 32": cell}},
        }

    rows = [row("a", 0, 60.0), row("a", 1, 40.0), row("b", 0, 55.0), row("b", 1, None)]
    pooled = {"row": "a", "place": "", "title": "a", "seeds": {"speed": [0, 1]}}
    table = {"rows": rows, "pooled": [pooled | {"cells": {"speed": {"batch 32": {"frames": 50.0}}}}]}
    assert best_of(table, columns) == ["Best, of what was run: speed: a (seed 0)."]
    cells = [line[1] for line in headlines(table, columns)[1:]]
    assert cells == ["50 frames/s (seeds 0, 1)", "55 frames/s (seed 0)"]


def test_tables_are_markdown_whatever_their_headings_are_and_tell_gains_by_seed() -> None:
    gain = {"gain": 2.0, "episodes": 8, "gained": 3, "lost": 1, "p": 0.6, "by_seed": [1.0, 3.0]}
    gain["over_seeds"] = {"mean": 2.0, "low": -10.7, "high": 14.7, "p": 0.3}
    table = {
        "name": "any",
        "columns": {"values": {"title": "values", "labels": ["mean |dSR|"]}},
        "rows": [],
        "pooled": [{"row": "ppo", "title": "PPO", "seeds": {"values": [0, 1]}, "cells": {"values": {}}}],
        "comparisons": [
            {"row": "ppo", "title": "PPO", "other": "imitation", "column": "values", "seeds": [0, 1]}
            | {"cells": {"mean |dSR|": gain}}
        ],
    }
    said = markdown(table, {"values": Success("values")})
    assert "mean \\|dSR\\|" in said and OVER_SEEDS in said
    lines = said.splitlines()
    for head, line in pairwise(lines):
        if line.startswith("| ---"):
            assert head.replace("\\|", "").count("|") == line.count("|")
    assert "+2.0, p 0.6 (3 won, 1 lost); by seed +1.0, +3.0 [-10.7, +14.7], p 0.3" in said
