"""The controls beside the gain: the same physics episodes without a simulator, and as many spent on RL in
physics.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from actors.factory import ConfigError, build_physics, build_policy
from actors.fleets.launch import build_fleet
from actors.rollouts.evaluate import evaluate
from actors.rollouts.recipe import Recipe
from learners.rl.factory import build_algorithm
from learners.rl.loop import train_rl
from learners.stages.imitation import train_imitation
from pipeline.artefact import save_weights, write_text
from pipeline.evaluation.statistics import mcnemar, rate_entry, rate_line
from pipeline.graph import Graph, Stage
from pipeline.loop import build_loop
from pipeline.stages.given import EVALUATE, fit_options, rl_options, seeds_of

CONTROL = 6_000_000  # episode seeds of RL in physics


def run_controls(cfg: Mapping[str, Any], root: Path) -> None:
    """Run both controls of a finished experiment and write runs/<name>/controls.json.

    Filtered BC clones every successful episode that the loop collected with its policies, beside the
    demonstrations.
    RL in physics starts from the imitation policy and gets as many episodes as the loop deployed.

    Raises:
        ConfigError: if the experiment has not been run.
    """
    loop = build_loop(dict(cfg), root)
    result_path = root / "result.json"
    if not result_path.exists():
        raise ConfigError(
            f"{result_path} is missing: the controls stand beside a finished run; first `worldloop run` with the same options"
        )
    result = json.loads(result_path.read_text())
    rounds = cfg["rounds"]["count"]
    data = [loop.folder("collect"), *(loop.folder(f"deploy-{n}") for n in range(1, rounds + 1))]
    budget = sum(
        json.loads((folder / "manifest.json").read_text())["result"]["episodes"] for folder in data[1:]
    )
    graph = Graph(root / "controls")
    base = {
        "cfg": {
            key: cfg[key]
            for key in (
                "task",
                "policy",
                "imitation",
                "rl",
                "algorithm",
                "evaluate",
                "judge",
                "seed",
                "microbatches",
            )
        },
        "key": loop.key(f"rl-{rounds}"),
    }

    def cloning(folder: Path, found: Mapping[str, Path]) -> dict[str, Any]:
        from actors.factory import open_clips

        store = open_clips(cfg, [path / "dataset" for path in data])
        demos = store.select(["expert"], succeeded=True)[: cfg["imitation"]["demos"]]
        mine = store.select(["policy-*"], succeeded=True)
        policy = build_policy(cfg)
        train_imitation(
            policy,
            store,
            torch.cat([demos, mine]),
            fit_options(cfg, cfg["imitation"]["fit"], "imitation.fit"),
            folder,
            watched=torch.arange(len(store)),
        )
        save_weights(policy, folder)
        return {"demos": len(demos), "own_successes": len(mine), **_judge(cfg, policy, folder)}

    def physics(folder: Path, found: Mapping[str, Path]) -> dict[str, Any]:
        policy = build_policy(cfg, loop.folder("imitation") / "weights.safetensors")
        envs = min(cfg["rl"]["envs"], 64)
        iterations = max(1, round(budget / envs))
        settings = rl_options(cfg, envs=envs, iterations=iterations, seed=cfg["seed"])
        if settings.freeze_perception:
            policy.freeze_perception()
        algorithm = build_algorithm(cfg, policy)
        start = str((loop.folder("imitation") / "weights.safetensors").resolve())
        fleet = build_fleet(
            Recipe(
                cfg,
                envs // settings.shards,
                start,
                freeze_perception=settings.freeze_perception,
                bootstrap=algorithm.bootstraps,
            )
        )
        try:
            stats = train_rl(
                fleet,
                policy,
                algorithm,
                settings,
                folder,
                name="rl-physics",
                seed_pool=seeds_of(cfg, CONTROL, 4 * budget),
            )
        finally:
            fleet.close()
        save_weights(policy, folder)
        return {"episodes_used": stats["episodes"], **_judge(cfg, policy, folder)}

    graph.add(Stage("filtered-bc", (), base, cloning))
    graph.add(Stage("rl-in-physics", (), base, physics))
    manifests = graph.run()
    before = torch.load(loop.folder("evaluate-before") / "outcomes.pt", weights_only=True)["success"]
    rows: dict[str, Any] = {
        "loop": {**result["physics_after"], "paired": result["paired"], "deployed_episodes": budget}
    }
    for name, manifest in manifests.items():
        outcome = torch.load(graph.folder(name) / "outcomes.pt", weights_only=True)["success"]
        rows[name] = {
            **rate_entry(outcome),
            "paired": mcnemar(before, outcome),
            **{
                k: v
                for k, v in manifest["result"].items()
                if k in ("episodes_used", "own_successes", "demos")
            },
        }
    write_text(
        root / "controls.json",
        json.dumps({"before": result["physics_before"], **rows}, indent=1, default=float),
    )
    print(f"before               {rate_line(result['physics_before'])}")
    for name, row in rows.items():
        print(
            f"{name:<20} {rate_line(row)}, gained {row['paired']['gained']} lost {row['paired']['lost']} p {row['paired']['p']:.2g}"
        )


def _judge(cfg: Mapping[str, Any], policy: Any, folder: Path) -> dict[str, Any]:
    env = build_physics(cfg, cfg["evaluate"]["envs"])
    try:
        outcome = evaluate(env, policy, seeds_of(cfg, EVALUATE, cfg["evaluate"]["episodes"]), label="physics")
    finally:
        env.close()
    torch.save({"success": outcome.success}, folder / "outcomes.pt")
    return rate_entry(outcome.success)
