"""Stages that prove: imagined against true success, policies in physics, the world on held-out episodes, and
the report.
"""

from __future__ import annotations

import json
import shutil
import time
from pathlib import Path
from typing import Any

import torch

from actors.factory import (
    bench_config,
    build_judge,
    build_physics,
    build_policy,
    build_simulator,
    build_state_decoder,
    open_clips,
    prepare_process,
)
from actors.rollouts.evaluate import evaluate
from envs.episodes import Episode, LeRobotWriter
from envs.simulators.replay import replay
from pipeline.artefact import write_text
from pipeline.evaluation import measurement
from pipeline.evaluation.statistics import rate_entry
from pipeline.stages.gathering import run_recorded
from pipeline.stages.given import EVALUATE, Cfg, Found, load_world, open_store, seeds_of, split


def gap(
    cfg: Cfg,
    folder: Path,
    found: Found,
    data: tuple[str, ...],
    vision: str,
    state: str,
    judge: str,
    policy: str,
    number: int,
) -> dict[str, Any]:
    """How far imagination and truth lie apart for the policy just deployed: same starts, same stochastic
    policy.
    """
    store = open_store(cfg, found, data)
    mine = store.select([f"policy-{number}"])[: cfg["measure"]["starts"]]
    prepare_process(cfg["seed"])
    actor = build_policy(cfg, found[policy] / "weights.safetensors")
    truth = torch.tensor([store.episodes[n]["success"] for n in mine.tolist()])
    world = load_world(cfg, found, store, vision, state, judge, min(64, len(mine)), mine)
    outcome = evaluate(
        world, actor, list(range(len(mine))), stochastic=True, label="gap", sampling_seed=cfg["seed"]
    )
    said = outcome.success[outcome.judged]
    result = {
        "round": number,
        "true": rate_entry(truth),
        "imagined": rate_entry(said),
        "gap": float(said.float().mean() - truth.float().mean()),
    }
    _, held = split(store)
    if len(held):
        simulator = world.base_env.simulator
        made = replay(simulator, store, held, bf16=cfg["simulator"]["bf16"])
        referee = build_judge(cfg, found[judge] / "weights.safetensors")
        result["replayed"] = measurement.judge_table(referee, made.frames, made.valid, store, held)
    return result


def evaluate_physics(cfg: Cfg, folder: Path, found: Found, policy: str) -> dict[str, Any]:
    """Deterministic success in physics on the held-out seeds."""
    actor = build_policy(cfg, found[policy] / "weights.safetensors")
    env = build_physics(cfg, cfg["evaluate"]["envs"])
    began = time.perf_counter()
    try:
        outcome = evaluate(env, actor, seeds_of(cfg, EVALUATE, cfg["evaluate"]["episodes"]), label="physics")
    finally:
        env.close()
    torch.save({"success": outcome.success, "progress": outcome.progress}, folder / "outcomes.pt")
    return {
        "rate": outcome.rate,
        **rate_entry(outcome.success),
        "progress": float(outcome.progress.mean()),
        "evaluation_seconds": time.perf_counter() - began,
    }


def evaluate_imagined(
    cfg: Cfg,
    folder: Path,
    found: Found,
    data: tuple[str, ...],
    vision: str,
    state: str,
    judge: str,
    before: str,
    after: str,
) -> dict[str, Any]:
    """Deterministic success in imagination, from the starts of the data, for both policies in the last world."""
    store = open_store(cfg, found, data)
    count = min(cfg["evaluate"]["imagined"], len(store))
    world = load_world(cfg, found, store, vision, state, judge, min(64, count))
    out: dict[str, Any] = {}
    for label, name in (("before", before), ("after", after)):
        outcome = evaluate(
            world,
            build_policy(cfg, found[name] / "weights.safetensors"),
            list(range(count)),
            label=f"imagined {label}",
        )
        out[label] = {**rate_entry(outcome.success[outcome.judged]), "dropped": int((~outcome.judged).sum())}
    return out


def measure(
    cfg: Cfg,
    folder: Path,
    found: Found,
    data: tuple[str, ...],
    vision: str,
    state: str,
    judge: str,
    held_out: str,
) -> dict[str, Any]:
    """Rollout error, state error, speed and the judge's tables on held-out episodes of every kind."""
    prepare_process(cfg["seed"])
    simulator = build_simulator(cfg, found[vision] / "weights.safetensors")
    decoder = build_state_decoder(cfg, simulator, found[state] / "weights.safetensors")
    referee = build_judge(cfg, found[judge] / "weights.safetensors")
    scripted = open_store(cfg, found, [held_out])
    store = open_store(cfg, found, data)
    groups = {name: (scripted, scripted.select([name])) for name in ("expert", "noisy", "random")}
    groups["on-policy"] = (store, split(store)[1])
    result: dict[str, Any] = {"rollout": {}, "judge": {}}
    for name, (source, episodes) in groups.items():
        if not len(episodes):
            continue
        made = replay(simulator, source, episodes, decoder, bf16=cfg["simulator"]["bf16"])
        result["rollout"][name] = measurement.rollout_error(source, episodes, made)
        real = source.frames(made.rows)
        result["judge"][name] = {
            "physics video": measurement.judge_table(referee, real, made.valid, source, episodes),
            "simulator rollouts": measurement.judge_table(referee, made.frames, made.valid, source, episodes),
        }
    result["frames_per_second"] = {
        f"batch {n}": measurement.speed(simulator, scripted, n, cfg["measure"]["speed_chunks"])
        for n in (1, 32)
    }
    return result


def videos(
    cfg: Cfg,
    folder: Path,
    found: Found,
    data: tuple[str, ...],
    vision: str,
    state: str,
    judge: str,
    held_out: str,
    before: str,
    after: str,
) -> dict[str, Any]:
    """Paired videos: the policy in physics, and the same actions in the simulator."""
    from pipeline.evaluation.media import paired_frames, paired_video, write_gif

    prepare_process(cfg["seed"])
    simulator = build_simulator(cfg, found[vision] / "weights.safetensors")
    seeds = seeds_of(cfg, EVALUATE, cfg["measure"]["videos"])
    names = []
    for label, name in (("before", before), ("after", after)):
        tracks = [
            track
            for some in run_recorded(
                cfg, build_policy(cfg, found[name] / "weights.safetensors"), seeds, stochastic=False
            )
            for track in some
        ]
        bench = bench_config(cfg)
        data_folder = folder / f"dataset-{label}"
        shutil.rmtree(data_folder, ignore_errors=True)
        LeRobotWriter(data_folder, bench.views, bench.size, cfg["task"]["control_hz"]).write(
            [Episode.from_track(t, f"policy-{label}", bench.views, cfg["task"]["control_hz"]) for t in tracks]
        )
        store = open_clips(cfg, [data_folder])
        made = replay(simulator, store, torch.arange(len(store)), bf16=cfg["simulator"]["bf16"])
        for number, row in enumerate(store.episodes):
            path = folder / "media" / f"{label}-{row['seed']}.mp4"
            paired_video(path, store, number, made, f"{label}: {'success' if row['success'] else 'failure'}")
            names.append(path.name)
            if label == "after" and number == 0:
                frames = paired_frames(store, number, made, "the policy's own actions")
                write_gif(
                    folder / "media" / "rollout.gif", [*frames, *[frames[-1]] * 8], cfg["task"]["control_hz"]
                )
    return {"videos": names}


def report(cfg: Cfg, folder: Path, found: Found, rounds: int, root: Path) -> dict[str, Any]:
    """result.json and report.html of the whole run."""
    from pipeline.evaluation.report import build_report, build_result

    result = build_result(cfg, found, rounds)
    write_text(root / "result.json", json.dumps(result, indent=1, default=float))
    build_report(cfg, found, result, rounds, root / "report.html")
    shutil.copy(root / "report.html", folder / "report.html")
    return {"verdict": result["verdict"]}
