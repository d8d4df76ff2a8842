"""What writes data, caches, checkpoints and weights, on a small disk that is really full.

`unshare -rm python -m tests.pipeline.chaos.full_disk FOLDER` mounts a tmpfs of many sizes there, one after
the other. At each, the work must end with the system's own error, and after room has been made the same work
must go on to the end: nothing half-written stands in its way. Python's audit hooks (pipeline/chaos/faults.py)
do not see what libraries write by themselves, nor pages of a memory map; a real disk does.
"""

from __future__ import annotations

import errno
import subprocess
import sys
from pathlib import Path

import torch
from torch import nn

from actors.weights import load
from envs.episodes import LeRobotDataset, LeRobotWriter
from envs.episodes.clips import ClipStore
from learners.training.checkpoint import Checkpoints
from pipeline.graph.artefact import save_weights
from tests.embodiments import ARM_DELTAS, world_spec
from tests.moving_square import SIZE, moving_square

SIZES = 16
EPISODES = [moving_square(ARM_DELTAS, seed, length=6) for seed in range(6)]


def work(place: Path) -> None:
    """Everything that a stage leaves on a disk, or nothing more if it is there already."""
    writer = LeRobotWriter(place / "set", ARM_DELTAS.at(SIZE))
    while writer.episodes < len(EPISODES):
        writer.write(EPISODES[writer.episodes : writer.episodes + 2])
    store = ClipStore([place / "set"], world_spec(ARM_DELTAS), cache=place / "cache")
    assert len(store) == len(EPISODES)
    module = nn.Linear(100, 100)
    for step in (1, 2):
        Checkpoints(place / "run").save(step, {"module": dict(module.state_dict())}, {"step": step})
    load(nn.Linear(100, 100), save_weights(module, place / "run"))


def check(place: Path) -> None:
    """All of it is there, and nothing else."""
    assert [episode.seed for episode in LeRobotDataset(place / "set")] == list(range(len(EPISODES)))
    held = {"module": dict(nn.Linear(100, 100).state_dict())}
    assert Checkpoints(place / "run").load(held) == {"step": 2}
    assert torch.isfinite(held["module"]["weight"]).all()
    assert not [path for path in place.rglob(".*.part")]


def bytes_of(place: Path) -> int:
    """Room that a folder takes, in whole pages as on a tmpfs."""
    return sum(-(-path.stat().st_size // 4096) * 4096 for path in place.rglob("*"))


def main(folder: Path) -> None:
    """Try all sizes; says how many of them were too small."""
    work(folder / "whole")
    check(folder / "whole")
    whole, full = bytes_of(folder / "whole"), 0
    for number in range(1, SIZES + 1):
        place = folder / f"disk-{number}"
        place.mkdir()
        size = max(4096, whole * number // SIZES // 4096 * 4096)
        subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(place)], check=True)
        try:
            work(place)
        except OSError as error:
            full += 1
            told = str(error)
            assert error.errno == errno.ENOSPC or "No space left" in told, told
            assert str(place) in told, told
        subprocess.run(["mount", "-o", "remount,size=64m", str(place)], check=True)
        work(place)
        check(place)
        subprocess.run(["umount", str(place)], check=True)
    print(f"{full} of {SIZES} disks were full")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
