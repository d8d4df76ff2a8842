"""Stages that learn: the first policy, the simulator and its state decoder, the judge, and the policy in
imagination.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import torch

from actors.factory import (
    ConfigError,
    build_judge,
    build_policy,
    build_simulator,
    build_state_decoder,
    options,
    prepare_process,
)
from actors.fleets.launch import build_fleet
from actors.rollouts.recipe import Recipe
from envs.specs import Rewards
from learners.rl.dataset_rollout import dataset_rollout
from learners.rl.factory import build_algorithm
from learners.rl.loop import train_rl
from learners.rl.ppo import PPO
from learners.stages.generated import generated_frames
from learners.stages.imitation import Cloning, train_imitation
from learners.stages.judge import calibrate, train_judge, unseen_by_judge
from learners.stages.state import train_state
from learners.stages.vision import VisionConfig, train_contact, train_sight, train_vision
from learners.training.parallel import leads
from pipeline.artefact import save_weights
from pipeline.evaluation import measurement
from pipeline.stages.given import Cfg, Found, fit_options, open_store, rl_options, split, successful_episodes


def imitation(cfg: Cfg, folder: Path, found: Found) -> dict[str, Any]:
    """Behaviour cloning of the first few expert episodes."""
    store = open_store(cfg, found, found)
    experts = store.select(["expert"], succeeded=True)[: cfg["imitation"]["demos"]]
    if len(experts) < cfg["imitation"]["demos"]:
        raise ConfigError(
            f"imitation.demos={cfg['imitation']['demos']}, but the data hold {len(experts)} successful expert episodes; raise collect.episodes or collect.mix.expert"
        )
    prepare_process(cfg["seed"])
    policy = build_policy(cfg)
    stats = train_imitation(
        policy,
        store,
        experts,
        fit_options(cfg, cfg["imitation"]["fit"], "imitation.fit"),
        folder,
        watched=split(store)[0],
    )
    save_weights(policy, folder)
    return {**stats, "demos": len(experts)}


def clone(
    cfg: Cfg, folder: Path, found: Found, data: tuple[str, ...], policy: str, vision: str, number: int
) -> dict[str, Any]:
    """The deployed policy, perception and all, learns from what worked in physics, and to see generated
    pictures as it sees true ones; RL then leaves its perception as it is.
    """
    store = open_store(cfg, found, data)
    prepare_process(cfg["seed"])
    actor = build_policy(cfg, found[policy] / "weights.safetensors")
    episodes, (train, _) = successful_episodes(cfg, store, number), split(store)
    section = dict(cfg["clone"])
    own = store.select(["policy-*"])
    own = own[torch.isin(own, train)].flip(0)[: section.pop("imagined")]  # the newest first
    simulator = build_simulator(cfg, found[vision] / "weights.safetensors")
    made = generated_frames(simulator, store, own, cfg["simulator"]["bf16"])
    stats = train_imitation(
        actor,
        store,
        episodes,
        fit_options(cfg, section, "clone"),
        folder,
        fresh=False,
        generated=made,
        watched=train,
    )
    save_weights(actor, folder)
    return {**stats, "episodes": len(episodes), "generated_frames": len(made)}


def tokenizer(cfg: Cfg, folder: Path, found: Found, data: tuple[str, ...]) -> dict[str, Any]:
    """The DiT's video autoencoder."""
    from learners.stages.tokenizer import train_tokenizer

    store = open_store(cfg, found, data)
    train, _ = split(store)
    prepare_process(cfg["seed"])
    simulator = build_simulator(cfg)
    # type: ignore[arg-type]
    stats = train_tokenizer(simulator, store, train, fit_options(cfg, cfg["tokenizer"], "tokenizer"), folder)
    save_weights(simulator, folder)
    return stats


def vision(
    cfg: Cfg, folder: Path, found: Found, data: tuple[str, ...], warm: tuple[str, ...], steps: str
) -> dict[str, Any]:
    """The simulator, from nothing in the first round and from its predecessor after that."""
    section = dict(cfg["vision"][steps])
    fit_section, sight_section, contact_section = (section.pop(name) for name in ("fit", "sight", "contact"))
    store = open_store(cfg, found, data)
    train, kept = split(store)
    newest = train[train >= len(store) - len(open_store(cfg, found, data[-1:]))]
    prepare_process(cfg["seed"])
    simulator = build_simulator(cfg, found[warm[0]] / "weights.safetensors" if warm else None)
    train_sight(
        simulator, store, train, fit_options(cfg, sight_section, f"vision.{steps}.sight"), folder / "sight"
    )
    train_contact(
        simulator,
        store,
        train,
        kept,
        fit_options(cfg, contact_section, f"vision.{steps}.contact"),
        folder / "contact",
    )
    stats = train_vision(
        simulator,
        store,
        train,
        options(VisionConfig, section, f"vision.{steps}"),
        fit_options(cfg, fit_section, f"vision.{steps}.fit"),
        folder,
        newest,
    )
    save_weights(simulator, folder)
    return {**stats, "parameters": sum(p.numel() for p in simulator.parameters())}


def state(
    cfg: Cfg, folder: Path, found: Found, data: tuple[str, ...], vision: str, warm: str, steps: str
) -> dict[str, Any]:
    """The state decoder on the frozen simulator."""
    store = open_store(cfg, found, data)
    train, _ = split(store)
    prepare_process(cfg["seed"])
    simulator = build_simulator(cfg, found[vision] / "weights.safetensors")
    decoder = build_state_decoder(cfg, simulator, found[warm] / "weights.safetensors" if warm else None)
    if not warm and not decoder.normalised:
        decoder.normalise(store.arrays["states"][store.rows(train)])
    stats = train_state(
        decoder, simulator, store, train, fit_options(cfg, cfg["state"][steps], f"state.{steps}"), folder
    )
    save_weights(decoder, folder)
    return stats


def judge(
    cfg: Cfg, folder: Path, found: Found, data: tuple[str, ...], vision: str, warm: str, steps: str
) -> dict[str, Any]:
    """The judge on real and on generated frames, its threshold calibrated on real video that no judge learns
    from.
    """
    section = dict(cfg["judge_fit"][steps])
    fit_section = section.pop("fit")
    store = open_store(cfg, found, data)
    train, _ = split(store)
    unseen = unseen_by_judge(store)
    train = train[~torch.isin(train, unseen)]
    prepare_process(cfg["seed"])
    simulator = build_simulator(cfg, found[vision] / "weights.safetensors")
    judge = build_judge(cfg, found[warm] / "weights.safetensors" if warm else None)
    pick = train[
        torch.randperm(len(train), generator=torch.Generator().manual_seed(cfg["seed"]))[
            : section["imagined"]
        ]
    ]
    imagined = (
        generated_frames(simulator, store, pick, cfg["simulator"]["bf16"], within=math.inf)
        if len(pick)
        else None
    )
    stats = train_judge(
        judge, store, train, fit_options(cfg, fit_section, f"judge_fit.{steps}.fit"), folder, imagined
    )
    if len(unseen):
        rows, valid = store.whole(unseen)
        success = measurement.judge_frames(judge, store.frames(rows), store, unseen)
        succeeded = torch.tensor([bool(store.episodes[n]["success"]) for n in unseen.tolist()])
        if not calibrate(judge, torch.where(valid, success, 0.0), succeeded):
            print(
                f"judge: {int(succeeded.sum())} of {len(succeeded)} unseen episodes succeeded, and its scores do not tell which; threshold left at {float(judge.threshold):.3f}",
                flush=True,
            )
    save_weights(judge, folder)
    return {
        **stats,
        "threshold": float(judge.threshold),
        "generated_frames": len(imagined) if imagined is not None else 0,
    }


def rl(
    cfg: Cfg,
    folder: Path,
    found: Found,
    data: tuple[str, ...],
    vision: str,
    state: str,
    judge: str,
    policy: str,
    iterations: int,
    number: int,
) -> dict[str, Any]:
    """Reinforcement learning inside the simulator."""
    prepare_process(cfg["seed"])
    store = open_store(cfg, found, data)
    actor = build_policy(cfg, found[policy] / "weights.safetensors")
    settings = rl_options(cfg, iterations=iterations, seed=cfg["seed"] * 100 + number)
    anchor = Cloning(actor, store, successful_episodes(cfg, store, number))
    if settings.freeze_perception:
        actor.freeze_perception()
        anchor.look()
    algorithm = build_algorithm(cfg, actor)
    knew: dict[str, float] = {}
    if isinstance(algorithm, PPO):
        # Of a deployed policy whose perception stays: of another the critic would know pictures that nobody
        # sees any more.
        past = store.select([f"policy-{number}"])
        past = past[torch.isin(past, split(store)[0])]
        if settings.freeze_perception and len(past):
            knew["critic_knew"] = algorithm.warm_up(
                dataset_rollout(
                    actor.perception,
                    store,
                    past,
                    options(Rewards, cfg["judge"]["rewards"], "judge.rewards"),
                    cfg["task"]["chunk"],
                ),
                settings.seed,
            )
    weights = [
        str((found[name] / "weights.safetensors").resolve()) for name in (policy, vision, state, judge)
    ]
    datasets = tuple(str((found[name] / "dataset").resolve()) for name in data)
    recipe = Recipe(
        cfg,
        settings.envs // settings.shards,
        weights[0],
        weights[1],
        weights[2],
        weights[3],
        datasets,
        settings.freeze_perception,
        algorithm.bootstraps,
        settings.rewards_later,
    )
    fleet = build_fleet(recipe) if leads() else None
    try:
        stats = train_rl(fleet, actor, algorithm, settings, folder, starts=len(store), anchor=anchor)
    finally:
        if fleet is not None:
            fleet.close()
    save_weights(actor, folder)
    return {
        **knew,
        **{k: v for k, v in stats.items() if k != "last"},
        **{f"last_{k}": v for k, v in stats["last"].items()},
    }
