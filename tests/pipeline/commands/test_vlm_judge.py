"""judge=vlm in the pipeline: its stage, its cost, its study on recordings, and what makes it out of date."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from envs.embodiment import Embodiment
from envs.episodes.splits import write_splits
from envs.judges import JudgeError
from envs.judges.vlm.ledger import _ledger
from envs.targets import ConfigError
from pipeline.cli.words import prepared
from pipeline.commands.worlds.judge import Selection, judge_study
from pipeline.commands.worlds.policy_value import policy_value
from pipeline.config import load_config
from pipeline.graph.stage import Inputs
from pipeline.loop import build_loop
from pipeline.stages.given import DATASETS
from pipeline.stages.judging import stage as judging
from tests.embodiments import ARM_DELTAS
from tests.envs.judges.chat_server import MODEL, ChatServer, seeing, serving
from tests.worlds import untrained_world, written


@pytest.fixture
def server() -> Iterator[ChatServer]:
    """A server whose model sees whether the square is in the corner."""
    with serving() as chat:
        yield chat


@pytest.fixture
def words(server: ChatServer, tmp_path: Path, tiny_data: Callable[[Embodiment], Path]) -> list[str]:
    """The command line of a run on recorded squares, of which half succeed in every split."""
    shutil.copytree(tiny_data(ARM_DELTAS), tmp_path / "squares")
    write_splits(tmp_path / "squares", {"train": 6, "held_out": 6, "calibration": 8})
    return [
        *("task=lerobot", f"task.data=[{tmp_path}/squares]", "task.size=[32,32]", f"runs={tmp_path}"),
        *("judge=vlm", f"judge.chat.url={server.url}", f"judge.chat.model={MODEL}", "judge.pictures.side=0"),
        *(f"judge.asking.cache={tmp_path}/cache", "judge.budget.input_price=10", "judge.asking.in_flight=2"),
    ]


def run_stage(cfg: dict[str, Any], folder: Path) -> dict[str, Any]:
    """What the judge's stage returns, in its folder."""
    folder.mkdir(exist_ok=True)
    (folder / DATASETS).write_text(json.dumps(list(cfg["task"]["data"])))
    settings = {"phase": "first"}
    view = judging.judge.view("judge-1", cfg, settings)
    return dict(judging.judge.run(view, folder, Inputs({"data": folder}, settings)))


def test_its_stage_asks_nobody_unless_the_threshold_is_to_be_set(
    words: list[str], server: ChatServer, tmp_path: Path
) -> None:
    assert run_stage(load_config(words), tmp_path / "plain")["threshold"] == 0.5
    assert not server.seen and (tmp_path / "plain" / "weights.safetensors").exists()
    server.answer = lambda asked: seeing(asked) if asked.seed else "Answer: Yes"  # one vote is always yes
    _ledger.cache_clear()
    cfg = load_config([*words, "judge.votes.calibrate=true", "judge.votes.count=3", "judge.budget.calls=5"])
    with pytest.raises(JudgeError, match=r"judge\.budget\.calls=5"):
        run_stage(cfg, tmp_path / "set")
    asked = len(server.seen)
    _ledger.cache_clear()
    cfg["judge"]["budget"]["calls"] = 0
    result = run_stage(cfg, tmp_path / "set")
    assert 0.4 < result["threshold"] < 0.9 and result["threshold"] != 0.5
    cost = result["judge_cost"]  # that of the time before it was stopped, too
    assert cost["calls"] == len(server.seen) > asked == 5 and cost["remembered"] >= 5
    assert cost["cost"] > 0 and cost["cost"] == pytest.approx(cost["prompt_tokens"] * 10e-6)


def test_a_judge_that_can_judge_nothing_is_told_before_rl_drops_every_episode(
    words: list[str], server: ChatServer, tmp_path: Path
) -> None:
    server.answer = lambda asked: "I cannot say."
    cfg = load_config([*words, "judge.votes.calibrate=true", "judge.asking.stop_after=100000"])
    with pytest.raises(ConfigError, match=r"no judgement on 8 of 8 .*judge\.prompt=done asks.*judge_cost"):
        run_stage(cfg, tmp_path / "set")


def test_the_study_says_who_is_right_by_what_was_shown_and_what_it_cost(
    words: list[str], server: ChatServer, tmp_path: Path
) -> None:
    whole = ["judge.pictures.span=clip", "judge.pictures.every=1"]
    cfg = load_config([*words, *whole])
    selection = Selection.of({"frames": "all,5,ends"})
    head, names, *rows = judge_study(cfg, tmp_path / "run", selection).splitlines()
    assert head == "VLMJudge on 6 recorded episodes (held_out)" and names.split()[:6] == [
        "frames",
        "shown",
        "TP",
        "FP",
        "FN",
        "TN",
    ]
    cells = [row.split()[:9] for row in rows]
    assert cells[0] == ["all", "13.0", "3", "0", "0", "3", "100.0%", "0", "0"]
    assert [row[:2] for row in cells[1:]] == [["5", "4.0"], ["ends", "2.0"]]
    assert all(row[6] == "100.0%" for row in cells) and "prompt tokens 1800, " in rows[0]
    shown = {len(asked.pictures) for asked in server.seen}  # fewer than there are where the square rests
    assert max(shown) == 13 and {2, 4} <= shown
    picture = tmp_path / "goal.png"
    assert cv2.imwrite(str(picture), np.zeros((32, 32, 3), np.uint8))
    cfg = load_config([words[0], words[1], words[2], "judge=goal_image", f"judge.picture={picture}"])
    said = judge_study(cfg, tmp_path / "run", Selection.of({}))
    assert said.splitlines()[-1].startswith("Judged by metric: NLPD") and "free" in said
    server.answer = lambda asked: "I cannot say."
    assert "calls" not in judge_study(cfg, tmp_path / "run", selection)  # all is remembered
    other = load_config([*words, *whole, "judge.chat.max_tokens=7", "judge.asking.stop_after=100"])
    last = judge_study(other, tmp_path / "run", selection).splitlines()[-1]
    assert last.split()[2:9] == ["0", "0", "0", "0", "-", "6", "0"]


def test_the_study_says_what_is_missing(words: list[str], tmp_path: Path) -> None:
    for bad, said in (
        ({"split": "half"}, "split=half should be one of"),
        ({"frames": "all,0"}, "frames=0 should be all, ends"),
        ({"episodes": "some"}, "episodes=some should be"),
    ):
        with pytest.raises(ConfigError, match=said):
            Selection.of(bad)
    for frames in ("ends", "all,4"):  # of which its pictures would leave out some again
        with pytest.raises(ConfigError, match=r"say judge\.pictures\.span=clip judge\.pictures\.every=1"):
            judge_study(load_config(words), tmp_path / "run", Selection.of({"frames": frames}))
    learned = [word for word in words if not word.startswith("judge")]
    with pytest.raises(ConfigError, match="has learned nothing yet: first `worldloop stage judge-1`"):
        judge_study(load_config(learned), tmp_path / "run", Selection.of({"split": "all"}))
    with pytest.raises(ConfigError, match="has recorded nothing yet: first `worldloop stage collect`"):
        judge_study(load_config([f"runs={tmp_path}"]), tmp_path / "run", Selection.of({}))


@pytest.mark.long
def test_values_that_were_judged_stay_when_the_budget_or_patience_changes(
    words: list[str], server: ChatServer, tmp_path: Path
) -> None:
    words = ["experiment=smoke", "track=disabled", *words, "task.chunk=4", "task.horizon=4"]
    words += ["policy_value={repeats: 1, starts: 2, noise: [0.5]}"]
    words += untrained_world(load_config(words), tmp_path)
    words += [f"policy_value.policies=[{tmp_path / 'policy'}]"]
    _ledger.cache_clear()
    with pytest.raises(JudgeError, match=r"judge\.budget\.calls=8 is spent"):
        policy_value(load_config([*words, "judge.budget.calls=8"]), tmp_path / "run")
    _ledger.cache_clear()
    assert policy_value(load_config(words), tmp_path / "run").endswith("\n1 parts were reused")
    asked, patient = len(server.seen), ["judge.asking.retries=9", f"judge.asking.cache={tmp_path}/other"]
    assert policy_value(load_config([*words, *patient]), tmp_path / "run").endswith("\n2 parts were reused")
    assert len(server.seen) == asked
    page = written(tmp_path / "run", "policy-value.json")
    assert json.loads(page.read_text())["judge_cost"]["calls"] == asked
    changed = policy_value(load_config([*words, "judge.pictures.side=48"]), tmp_path / "run")
    assert changed.endswith("\n0 parts were reused") and len(server.seen) > asked
    assert json.loads(page.read_text())["judge_cost"]["calls"] == len(server.seen) - asked


def test_a_changed_prompt_makes_judgements_out_of_date(words: list[str], tmp_path: Path) -> None:
    prompt = tmp_path / "mine.txt"
    prompt.write_text("$instruction?")
    cfg = load_config([*words, f"judge.prompt={prompt}"])
    before = {name: build_loop(cfg, tmp_path).key(name) for name in ("simulator-1", "judge-1", "rl-1")}
    prompt.write_text("$instruction!")
    after = build_loop(cfg, tmp_path)
    assert after.key("simulator-1") == before["simulator-1"]
    assert after.key("judge-1") != before["judge-1"] and after.key("rl-1") != before["rl-1"]


def test_a_missing_key_is_told_before_any_work(words: list[str]) -> None:
    with pytest.raises(ConfigError, match=r"judge\.chat\.key=NO_SUCH_KEY"):
        prepared([*words, "judge.chat.key=NO_SUCH_KEY"])
