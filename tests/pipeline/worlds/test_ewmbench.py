"""EWMBench by one command: page, figures, what is kept, and what is said where nothing can be known."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from envs.embodiment import Embodiment
from envs.episodes import LeRobotWriter
from envs.episodes.splits import write_splits
from envs.targets import ConfigError
from pipeline.commands.worlds.ewmbench import Extractors, _identity, ewmbench
from pipeline.commands.worlds.subject import Subject
from pipeline.config import load_config
from pipeline.evaluation.ewmbench.measure import Instruments
from tests.embodiments import ARM_DELTAS
from tests.envs.judges.chat_server import MODEL, Asked, serving
from tests.moving_square import SIZE, moving_square
from tests.worlds import scripted_set, untrained_world, written

SMOKE = ["experiment=smoke", "track=disabled", "launch.workers=1", "cameras=main", "task.size=[32,32]"]
SMOKE += ["ewmbench.episodes=2", "ewmbench.videos=1", "ewmbench.detector.fit={steps: 4, batch: 8, lr: 1e-3}"]
FORCING = ["simulator=forcing_small", "task.suite.cameras=[head,hand_left]"]  # which draws noise


def told(asked: Asked) -> str:
    """A model that says of every video the same."""
    if "numbered list" in asked.text:
        return "1. The arm comes down.\n2. It pushes."
    return "Something is gone.\nErrors: vanishing object" if "Errors:" in asked.text else "push the block"


@pytest.mark.long
def test_two_arms_in_physics_with_a_model_that_reads(tmp_path: Path) -> None:
    cfg = load_config([*SMOKE, *FORCING])
    data = scripted_set(cfg, tmp_path / "set", 4)
    world = untrained_world(cfg, tmp_path)
    with serving(told) as server:
        words = [*SMOKE, *FORCING, *world, f"imagined.data=[{data}]", "judge=vlm"]
        words += [f"judge.chat.url={server.url}", f"judge.chat.model={MODEL}", "judge.pictures.side=0"]
        words += [f"judge.asking.cache={tmp_path}/cache"]
        said = ewmbench(load_config(words), tmp_path / "run")
        asked = server.tries
        assert asked == 3 * 2 * 3  # questions of each sample and recording of both episodes
        assert "4 samples were reused" in ewmbench(load_config(words), tmp_path / "run")
        more = load_config([*words, "ewmbench.samples=3", "ewmbench.strict_parity=false"])
        assert "4 samples were reused" in ewmbench(more, tmp_path / "run")
        assert server.tries == asked + 3 * 2
        first = written(tmp_path / "run", "ewmbench.json")
        paid = json.loads(first.read_text())["judge_cost"]
        assert paid["calls"] == server.tries  # of all three lives
        asked = server.tries
        other = untrained_world(load_config([*words, "seed=1"]), tmp_path / "other")
        ewmbench(load_config([*words, *other, "ewmbench.samples=1", "ewmbench.videos=0"]), tmp_path / "run")
        (page,) = set((tmp_path / "run").glob("simulators/*/ewmbench.json")) - {first}
        assert json.loads(page.read_text())["judge_cost"]["calls"] == server.tries - asked == 3 * 2
    result = json.loads(first.read_text())
    assert len(result["rows"]) == 2 and len(result["rows"][0]["samples"]) == 3
    assert result["set"]["of"] == 4 and "end effectors in space (commanded poses)" in result["set"]["by"]
    whole = result["overall"]
    assert None not in (whole["recorded"][name] for name in ("scene", "bleu", "steps", "logic"))
    assert whole["generated"]["logic"] == pytest.approx(0.6) and whole["generated"]["steps"] == pytest.approx(
        1
    )
    assert whole["generated"]["diversity"] > 0 and 0 <= whole["generated"]["missing"] <= 1
    for row in result["rows"]:  # the best is the least of those with a trajectory in the most cameras
        tracked = [sample for sample in row["samples"] if sample["lost"] is not None]
        fewest = min(sample["lost"] for sample in tracked)
        known = [s["hsd"] for s in tracked if s["lost"] == fewest and s["hsd"] is not None]
        assert row["generated"]["hsd"] == (min(known) if known else None)
    assert (
        set(result["detector"]["cameras"]) == {"head"} and result["detector"]["source"] == "commanded poses"
    )
    page = first.with_suffix(".html").read_text()
    assert f"Asking the model: calls {paid['calls']:g}, prompt tokens" in page
    assert "Best samples" in page and page.count("<video") == 1 and "best of 2" in said
    assert not re.findall(r'(?:src|href)=(?!"(?:#|data:))', page)
    with pytest.raises(ConfigError, match=r"ewmbench\.patches\._target_=.*should be a PatchExtractor"):
        words += ["ewmbench.patches._target_=pipeline.evaluation.fidelity.extractors.PyramidFrames"]
        ewmbench(load_config(words), tmp_path / "run")


def test_what_was_measured_belongs_to_recordings_and_to_the_shape_of_the_task(
    tmp_path: Path, tiny_data: Callable[[Embodiment], Path]
) -> None:
    data = tmp_path / "set"
    shutil.copytree(tiny_data(ARM_DELTAS), data)
    words = [*SMOKE, "task=lerobot", f"task.data=[{data}]", "task.chunk=4", "task.horizon=8"]

    def identities(*more: str) -> tuple[str, str]:
        cfg = load_config([*words, *more])
        subject = Subject.of(cfg, tmp_path / "run")
        kinds = Extractors.of(cfg["ewmbench"])
        looking = Instruments(kinds.patches, kinds.frames, (0,), None, (), None, False)
        found = (
            _identity(cfg["ewmbench"], subject, subject.store(), looking, None),
            subject.generated("pipeline.commands.worlds.ewmbench"),
        )
        return json.dumps(found[0]), json.dumps(found[1])

    recorded, made = identities()
    assert identities() == (recorded, made)
    for word in ("task.chunk=2", "task.horizon=12"):
        assert identities(word)[1] != made, word
    tables = next((data / "data").rglob("*.parquet"))
    pq.write_table(pq.read_table(tables), tables, compression="gzip")  # another file with as many frames
    assert identities()[0] != recorded


def test_of_many_instructions_the_set_is_no_larger(tmp_path: Path) -> None:
    made = [moving_square(ARM_DELTAS, seed, length=9) for seed in range(12)]
    made = [replace(one, instruction=f"do it in way {n}") for n, one in enumerate(made)]
    LeRobotWriter(tmp_path / "set", ARM_DELTAS.at(SIZE)).write(made)
    write_splits(tmp_path / "set", {"train": 0, "held_out": 12, "calibration": 0})
    words = [*SMOKE, "task=lerobot", f"task.data=[{tmp_path / 'set'}]", "task.chunk=4", "task.horizon=8"]
    words += [*untrained_world(load_config(words), tmp_path), "ewmbench.samples=1", "ewmbench.videos=0"]
    assert "0 samples were reused" in ewmbench(load_config(words), tmp_path / "run")
    result = json.loads(written(tmp_path / "run", "ewmbench.json").read_text())
    assert len(result["rows"]) == 2 and result["set"]["of"] == 12  # ewmbench.episodes, of all together
    assert {row["task"] for row in result["rows"]} == {"various instructions"}
    # films of samples that were measured without any
    assert "0 samples were reused" in ewmbench(load_config([*words, "ewmbench.videos=2"]), tmp_path / "run")
    assert written(tmp_path / "run", "ewmbench.html").read_text().count("<video") == 2


def test_one_arm_that_nobody_calibrated(tmp_path: Path, tiny_data: Callable[[Embodiment], Path]) -> None:
    words = [*SMOKE, "task=lerobot", f"task.data=[{tiny_data(ARM_DELTAS)}]", "task.chunk=4", "task.horizon=8"]
    words += untrained_world(load_config(words), tmp_path)
    said = ewmbench(load_config(words), tmp_path / "run")
    assert (
        "No trajectories (SA, TA, DYN): none of the cameras ['corner', 'behind'] of one_arm_deltas is" in said
    )
    assert "No semantics" in said and "All samples of each episode came out alike" in said
    assert "| first of 2 |" in said and "best of 2" not in said  # nothing tells which is the best
    result = json.loads(written(tmp_path / "run", "ewmbench.json").read_text())
    assert "positions in the state" in result["set"]["by"] and result["detector"] is None
    assert 0 <= result["set"]["overlap"] <= 1
    whole = result["overall"]
    for name in ("sa", "ta", "dyn", "bleu", "steps", "logic"):  # unknown is not nothing
        assert whole["generated"][name] is None and whole["recorded"].get(name) is None
    assert whole["generated"]["scene"] is not None and whole["generated"]["diversity"] == pytest.approx(0)
    assert "scene_by_frame" not in whole["mean"] and "over videos" not in said
    said = ewmbench(load_config([*words, "ewmbench.strict_parity=true"]), tmp_path / "run")
    whole = json.loads(written(tmp_path / "run", "ewmbench.json").read_text())["overall"]
    assert f"all frames of all samples, not over videos: {whole['mean']['scene_by_frame']:.3f}." in said
    with pytest.raises(ConfigError, match=r"ewmbench\.cameras=\['side'\] must be some of"):
        ewmbench(load_config([*words, "ewmbench.cameras=[side]"]), tmp_path / "run")
    with pytest.raises(ConfigError, match=r"ewmbench\.detector\.weights=.*nowhere is not there"):
        ewmbench(load_config([*words, f"ewmbench.detector.weights={tmp_path}/nowhere"]), tmp_path / "run")
