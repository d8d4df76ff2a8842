"""A small imagined world made in seconds: a few scripted episodes and networks that have learned nothing.

What it shows is poor, but every part is the real one; benchmarks and chaos runs need its load, not its
pictures.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import nn

from actors.factory import build_judge, build_policy, build_pool, build_simulator, build_state_decoder
from actors.rollouts.recipe import Recipe
from actors.world_config import world_spec
from envs.episodes import Episode, LeRobotWriter
from envs.rng import seed_process
from pipeline.graph.artefact import save_weights
from pipeline.graph.stage import WEIGHTS


def demo_recipe(cfg: Mapping[str, Any], folder: Path, episodes: int, starts: int = 16) -> Recipe:
    """Weights and data in `folder`, made if they are not there, and the recipe of hosts with `episodes` side
    by side.
    """
    parts = ("policy", "simulator", "decoder", "judge")
    data = folder / "dataset"
    if not (folder / "done").exists():
        seed_process(0)
        pool, robot = build_pool(cfg), world_spec(cfg).embodiment
        try:
            tracks = pool.script([(seed, (seed % 4) / 3) for seed in range(starts)], cfg["task"]["chunk"])
        finally:
            pool.close()
        made = [Episode.from_track(track, "noisy" if track.seed % 4 else "expert", robot) for track in tracks]
        LeRobotWriter(data, robot).write(made)
        simulator = build_simulator(cfg)
        modules: list[nn.Module] = [
            build_policy(cfg),
            simulator,
            build_state_decoder(cfg, simulator),
            build_judge(cfg),
        ]
        for name, module in zip(parts, modules, strict=True):
            (folder / name).mkdir(parents=True, exist_ok=True)
            save_weights(module, folder / name)
        (folder / "done").touch()
    paths = [str((folder / name / WEIGHTS).resolve()) for name in parts]
    return Recipe(
        cfg,
        episodes,
        paths[0],
        paths[1],
        paths[2],
        paths[3],
        (str(data.resolve()),),
        freeze_perception=cfg["rl"]["freeze_perception"],
    )
