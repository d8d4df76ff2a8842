"""The process that chaos.py kills: a learner with its fleet, and a thread that kills parts of the fleet."""

from __future__ import annotations

import contextlib
import json
import os
import random
import signal
import sys
import threading
import time
from pathlib import Path
from typing import Any

import ray

from actors.factory import build_algorithm, build_policy
from actors.fleets.launch import build_fleet
from actors.fleets.ray_fleet import RayFleet
from actors.policies.contract import freeze_perception
from actors.process import prepare_process
from learners.rl.loop import train_rl
from learners.rl.starts import Starts
from pipeline.commands.demo_world import demo_recipe
from pipeline.config import load_config
from pipeline.stages.given import rl_options


def plague(fleet: RayFleet, section: dict[str, Any], seed: int, events: Path) -> None:
    """Kill parts of the fleet until the process ends; every event is a row of `events`.

    The schedule is in finished jobs, so that a slow machine is not killed faster than it can rebuild; now and
    then two events come at once.
    """
    chance = random.Random(seed)
    began = time.monotonic()
    while True:
        if chance.random() > 0.2:
            enough = fleet.finished + chance.randint(1, 2 * section["every"] - 1)
            while fleet.finished < enough:
                time.sleep(0.05)
        time.sleep(chance.uniform(0.0, 1.0))  # not always right after a job
        kind = chance.choices(["ray.kill", "SIGKILL", "judge", "resize"], [4, 4, 1, 2])[0]
        with contextlib.suppress(Exception):  # what it wanted to kill may have died just now
            if kind == "ray.kill":
                fleet.kill(chance.randrange(fleet.size))
            elif kind == "SIGKILL":
                # raises, and is not written down, while no host is built
                os.kill(chance.choice(fleet.processes), signal.SIGKILL)
            elif kind == "judge":
                fleet.kill_attached()
            else:
                fleet.resize(chance.randint(1, section["actors"] + 1))
            with events.open("a") as rows:
                rows.write(json.dumps({"event": kind, "at": time.monotonic() - began}) + "\n")


def main() -> None:
    """`python -m pipeline.chaos.learner FOLDER LIFE [overrides]`."""
    folder, life, words = Path(sys.argv[1]), int(sys.argv[2]), sys.argv[3:]
    cfg = load_config(words)
    section = cfg["chaos"]
    prepare_process(cfg["seed"], 1)
    settings = rl_options(cfg, iterations=1_000_000, checkpoint_every=1, seed=cfg["seed"])
    recipe = demo_recipe(cfg, folder / "world", settings.envs // settings.shards)
    policy = build_policy(cfg, Path(recipe.policy))
    if settings.freeze_perception:
        freeze_perception(policy)
    fleet = build_fleet(recipe)
    assert isinstance(fleet, RayFleet)
    threading.Thread(
        target=plague, args=(fleet, section, 1000 * cfg["seed"] + life, folder / "events.jsonl"), daemon=True
    ).start()
    try:
        train_rl(fleet, policy, build_algorithm(cfg, policy), settings, folder, Starts(range(16)))
    finally:
        fleet.close()
        ray.shutdown()


if __name__ == "__main__":
    main()
