"""Your own robot's data: episodes written as a LeRobot v3.0 data set.

    python -m examples.recordings my_data
    worldloop run experiment=smoke task=lerobot 'task.data=[my_data]' imitation.demos=8

The robot is the dot of task_suite.py; in its place stands whatever gives you pictures, states and commands.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from envs.episodes import Episode, LeRobotWriter
from envs.episodes.splits import write_splits
from examples.task_suite import DotToSquare

SPLITS = {"train": 24, "held_out": 8, "calibration": 8}
FRAMES = 16


def record(suite: DotToSquare, seed: int) -> Episode:
    """One episode: an expert half of the time, else somebody who is often wrong."""
    suite.reset("reach", seed)
    noise_level = 0.0 if seed % 2 else 0.8
    expert = suite.expert(noise_level, np.random.default_rng(seed))
    frames, commands, states, success = [suite.render()], [np.zeros(2)], [suite.observe().state], [False]
    for _ in range(FRAMES - 1):
        action = expert()
        suite.step(action)
        now = suite.observe()
        frames.append(suite.render())
        commands.append(action)  # row t is the action that led to frame t
        states.append(now.state)
        success.append(now.success)
    return Episode(
        frames=np.stack(frames),
        commands=np.stack(commands).astype(np.float32),
        states=np.stack(states).astype(np.float32),
        instruction=now.instruction,
        embodiment=suite.embodiment,
        source="noisy" if noise_level else "expert",
        seed=seed,
        success=np.array(success),  # leave it out where nobody said it
    )


def write(folder: Path) -> None:
    """The data set, in two shards, with its splits."""
    suite, count = DotToSquare(), sum(SPLITS.values())
    episodes = [record(suite, seed) for seed in range(count)]
    writer = LeRobotWriter(folder, suite.embodiment)
    writer.write(episodes[: count // 2])
    writer.write(episodes[count // 2 :])
    write_splits(folder, SPLITS)


if __name__ == "__main__":
    write(Path(sys.argv[1]))
