"""One tiny run through everything, and that no learned weight knows what only physics knows."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from actors.process import prepare_process
from envs.manifest import write_manifest
from pipeline.config import load_config
from pipeline.loop import build_loop
from tests.commands import worldloop

FEWER = (
    *("collect.episodes={train: 16, held_out: 8, calibration: 6}", "imitation.demos=4"),
    *("explore.episodes=4", "rounds.deploy=[8]", "rounds.trial=4"),
    *("evaluate.episodes=10", "evaluate.envs=10", "evaluate.imagined=8", "measure.starts=8"),
)
LEARNED = ("imitation", "simulator-1", "state-1", "judge-1", "clone-1", "rl-1")


def finished(folder: Path) -> tuple[tuple[str, ...], Path]:
    """The words and the folder of a run that has come to its end."""
    words = ("experiment=smoke", f"runs={folder}", "track=offline", *FEWER)
    out = worldloop(folder, "run", *words)
    assert out.status == 0, out.output[-3000:]
    return words, folder / "smoke"


@pytest.mark.slow
def test_the_whole_loop_at_its_smallest(tmp_path: Path) -> None:
    words, run = finished(tmp_path)
    result = json.loads((run / "result.json").read_text())
    assert result["physics_before"]["episodes"] == 10 and len(result["rounds"]) == 2
    assert "on-policy" in result["rollout"]
    tracked = json.loads((run / "wandb.json").read_text())
    assert {*LEARNED, "imitation-perception", "clone-1-perception"} <= tracked["rows"].keys()
    shown = {f"videos/{path.name}" for path in run.glob("stages/videos-*/media/*.mp4")}
    during = {f"gap-{number}/{name}.mp4" for number in (1, 2) for name in ("imagined", "held-out")}
    last = {f"evaluate-imagined/{label}.mp4" for label in ("before", "after")}
    assert shown and shown | during | last <= set(tracked["videos"])
    assert "data:video/mp4" in (run / "report.html").read_text()
    table = worldloop(tmp_path, "compare", str(run), str(run)).output
    assert "| algorithm; seed | PPO; 0 | PPO; 0 |" in table
    again = worldloop(tmp_path, "run", *words)
    assert again.output.count("is finished, reused") == 29


@pytest.mark.long
@pytest.mark.slow
def test_controls_stand_beside_a_run(tmp_path: Path) -> None:
    words, run = finished(tmp_path)
    tracked = json.loads((run / "wandb.json").read_text())["rows"]
    one = worldloop(tmp_path, "controls", *words, "controls.only=[filtered_bc]")
    assert one.status == 0, one.output[-3000:]
    assert set(json.loads((run / "controls.json").read_text())) == {"before", "loop", "filtered BC"}
    assert "filtered BC" in (run / "report.html").read_text()
    controls = worldloop(tmp_path, "controls", *words)
    assert controls.status == 0, controls.output[-3000:]
    rows = json.loads((run / "controls.json").read_text())
    assert set(rows) > {"before", "loop", "loop without imagined decisions", "filtered BC"}
    note = "rewarded by the suite's true progress and success, which are privileged, not by a judge"
    noted = {title for title, row in rows.items() if note in row.get("note", "")}
    explored = json.loads(next(run.glob("stages/explore-*/manifest.json")).read_text())["result"]["episodes"]
    spent = {title: row["physics_episodes"] - explored for title, row in rows.items()}
    # deployments of 8, trials of 4; without RL nothing learns from the second, nor is there more to try
    assert spent["loop"] == 2 * 8 + 3 * 4 and spent["loop without RL iterations"] == 8 + 2 * 4
    assert spent["filtered BC"] >= 2 * 8
    assert noted == {"RL in physics, equal episodes", "RL in physics, equal steps"}
    assert "equal steps" in (run / "report.html").read_text() and controls.output.count(note) == 2
    later = json.loads((run / "wandb.json").read_text())["rows"]
    assert {"rl-in-physics-equal-episodes", "filtered-bc"} <= later.keys() - tracked.keys()


@pytest.mark.slow
def test_no_learned_weight_knows_privileged_columns(tmp_path: Path) -> None:
    """Collect, deploy, overwrite every privileged column with noise, and learn everything again."""
    cfg = load_config(["experiment=soak", "track=disabled"])
    prepare_process(cfg["seed"], cfg["threads"])  # as the command line does, before any thread is started
    true = build_loop(cfg, tmp_path / "true")
    true.run("rl-1")
    noisy = build_loop(cfg, tmp_path / "noisy")
    for name in ("collect", "explore", "deploy-1"):
        shutil.copytree(true.folder(name), noisy.folder(name))
        assert overwrite_privileged(noisy.folder(name) / "dataset") > 0
        # or the graph would see that the data have changed
        write_manifest(noisy.folder(name), json.loads((noisy.folder(name) / "manifest.json").read_text()))
    # The policy that was deployed is learned again, too; its recorded episodes stay.
    noisy.run("rl-1")
    for name in LEARNED:
        weights = [(graph.folder(name) / "weights.safetensors").read_bytes() for graph in (true, noisy)]
        assert weights[0] == weights[1], f"{name} knows what only physics knows"


def overwrite_privileged(dataset: Path) -> int:
    """Noise in place of every privileged number of a LeRobot data set; returns how many columns it met."""
    met, rng = 0, np.random.default_rng(0)
    for path in sorted((dataset / "data").rglob("*.parquet")):
        table = pq.read_table(path)
        for index, name in enumerate(table.column_names):
            if not name.startswith("privileged."):
                continue
            old = table.column(name).combine_chunks()
            table = table.set_column(index, table.schema.field(index), _noise(old, rng))
            met += 1
        pq.write_table(table, path)
    for cache in dataset.parent.glob(f".cache-{dataset.name}*"):
        shutil.rmtree(cache)
    return met


def _noise(column: Any, rng: np.random.Generator) -> Any:
    """An Arrow array of the same type and shape, of random numbers."""
    flat = column.flatten() if pa.types.is_list(column.type) or _fixed(column.type) else column
    values = pa.array(rng.normal(size=len(flat)), type=pa.float64()).cast(flat.type, safe=False)
    if _fixed(column.type):
        return pa.FixedSizeListArray.from_arrays(values, type=column.type)
    if pa.types.is_list(column.type):
        return pa.ListArray.from_arrays(column.offsets, values, type=column.type)
    return values


def _fixed(kind: Any) -> bool:
    return bool(pa.types.is_fixed_size_list(kind))
