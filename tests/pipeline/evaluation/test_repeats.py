"""What physics does again, or for longer, so that there is a truth to measure by: masks and long rollouts."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from actors.factory import open_clips
from envs.targets import ConfigError
from pipeline.config import load_config
from pipeline.evaluation.by_task import tasks_of_episodes
from pipeline.evaluation.fidelity.long import long_episodes
from pipeline.evaluation.fidelity.masks import part_labels
from tests.worlds import scripted_set

SMOKE = ["experiment=smoke", "track=disabled", "launch.workers=1"]


def without(folder: Path, column: str) -> None:
    """Take a column out of a data set's list of columns."""
    path = folder / "meta/info.json"
    info = json.loads(path.read_text())
    del info["features"][column]
    path.write_text(json.dumps(info))


@pytest.mark.parametrize("choice", ["metaworld", "aloha"])
@pytest.mark.long
def test_masks_are_those_of_the_same_episode(choice: str, tmp_path: Path) -> None:
    cfg = load_config([*SMOKE, f"task={choice}", "task.horizon=8"])
    try:
        data = scripted_set(cfg, tmp_path / "set", 3, 0.3)
    except ConfigError as error:
        if "needs more packages" not in str(error):
            raise
        pytest.skip(str(error))
    store, every = open_clips(cfg, [data]), torch.arange(3)
    seeds = [row["seed"] for row in store.episodes]

    def known(further: int) -> list[bool]:
        """Of which episodes there are masks, if their seeds were so much higher."""
        for row, seed in zip(store.episodes, seeds, strict=True):
            row["seed"] = seed + further
        return (part_labels(cfg, store, every) != 255).flatten(1).any(1).tolist()

    assert known(0) == [True] * 3 and known(1000) == [False] * 3
    without(data, "privileged.object_poses")  # nobody recorded where things were, and pictures decide
    assert known(0) == [True] * 3 and known(1000) == [False] * 3
    without(data, "seed")  # somebody else's recordings: their numbers laid out nothing
    assert not store.seeded(every).any() and (part_labels(cfg, store, every) == 255).all()
    assert tasks_of_episodes(cfg, store, every) == store.instructions


def test_long_rollouts_go_on_after_success(tmp_path: Path) -> None:
    words = [*SMOKE, "task.suite._target_=tests.envs.physics.sections.Solved", "cameras=main"]
    cfg = load_config([*words, "fidelity.long={frames: 22, episodes: 2, noise_level: 1.0}"])
    store = long_episodes(cfg, tmp_path / "long")
    assert store.length.tolist() == [25, 25]  # whole chunks
    rows = store.start + 5
    assert store.arrays["success"][rows].all()


@pytest.mark.long
def test_long_rollouts_that_are_recorded_stay_when_recording_is_interrupted(tmp_path: Path) -> None:
    laid_out, stop = tmp_path / "laid_out", tmp_path / "stop"
    laid_out.touch()
    stop.write_text("2")
    suite = "tests.envs.physics.sections.Stopped"
    words = [*SMOKE, f"task.suite._target_={suite}", f"+task.suite.laid_out={laid_out}", "cameras=main"]
    cfg = load_config([*words, "fidelity.long={frames: 5, episodes: 3, noise_level: 1.0}"])
    with pytest.raises(ConfigError, match="as asked"):
        long_episodes(cfg, tmp_path / "long")
    stop.unlink()
    store = long_episodes(cfg, tmp_path / "long")
    seeds = [row["seed"] for row in store.episodes]
    assert [int(seed) for seed in laid_out.read_text().split()] == seeds and len(set(seeds)) == 3
    begun = long_episodes(cfg, tmp_path / "at once")
    assert torch.equal(begun.frames(begun.start), store.frames(store.start))
    other = load_config([*words, "fidelity.long={frames: 5, episodes: 1, noise_level: 0.5}"])
    assert len(long_episodes(other, tmp_path / "long")) == 1
