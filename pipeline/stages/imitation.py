"""Stages that clone: the first policy from demonstrations, and deployed policies from what worked."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from torch import Tensor
from tqdm import tqdm

from actors.factory import build_policy
from actors.process import prepare_process
from actors.world_config import build_kinematics, pose_style
from envs.episodes.clips import ClipStore
from learners.stages.imitation import Cloning, train_imitation
from learners.stages.perception import train_perception
from learners.stages.traces import Hands
from learners.training.parallel import leads
from pipeline.graph.artefact import save_weights
from pipeline.graph.stage import Inputs, Place, stage
from pipeline.stages.given import (
    POLICY,
    Cfg,
    demonstrations,
    deployed_in,
    fit_options,
    learning_episodes,
    mode_of,
    open_store,
    successful_episodes,
)


@stage(reads=(*POLICY, "imitation", "microbatches"), place=Place.LEARNERS)
def imitation(cfg: Cfg, folder: Path, inputs: Inputs) -> dict[str, Any]:
    """Behaviour cloning of demonstrations (imitation.sources, imitation.demos)."""
    store = open_store(cfg, inputs)
    demos = demonstrations(cfg, store)
    return {**cloned(cfg, folder, store, demos), "demos": len(demos)}


def cloned(cfg: Cfg, folder: Path, store: ClipStore, episodes: Tensor) -> dict[str, Any]:
    """Leave a policy from nothing in a stage's folder: its perception learns on all that may be learned from,
    then it clones `episodes`, int64 [N]. Returns what training says of itself.
    """
    prepare_process(cfg["seed"], cfg["threads"])
    policy = build_policy(cfg)
    section, mode = cfg["imitation"], mode_of(cfg)
    eyes = fit_options(cfg, section["perception"], "imitation.perception")
    everything = learning_episodes(store)
    discount = section["discount"]
    seen = train_perception(
        policy, store, everything, mode, eyes, folder / "perception", discount, _hands(cfg)
    )
    fit = fit_options(cfg, section["fit"], "imitation.fit")
    # Perception has taken its units from all frames; demonstrations must not change them again.
    stats = train_imitation(Cloning(policy, store, episodes, mode), fit, folder, fresh=not seen)
    save_weights(policy, folder)
    constant = list(getattr(policy, "constants", ()))
    if constant and leads():
        tqdm.write(f"imitation: the policy holds constant, as demonstrations do: {', '.join(constant)}")
    return {**_both(stats, seen), "constant": constant}


@stage(reads=(*POLICY, "imitation", "clone", "microbatches"), place=Place.LEARNERS)
def clone(cfg: Cfg, folder: Path, inputs: Inputs) -> dict[str, Any]:
    """The deployed policy, perception and all, learns from what worked in physics; the role `known` says in
    which round it was deployed.
    """
    store, section = open_store(cfg, inputs), cfg["clone"]
    prepare_process(cfg["seed"], cfg["threads"])
    policy = build_policy(cfg, inputs.weights("policy"))
    episodes = successful_episodes(cfg, store, deployed_in(inputs, "known"))
    mode, discount = mode_of(cfg), cfg["imitation"]["discount"]
    eyes = fit_options(cfg, section["perception"], "clone.perception")
    everything = learning_episodes(store)
    seen = train_perception(
        policy, store, everything, mode, eyes, folder / "perception", discount, _hands(cfg), fresh=False
    )
    fit = fit_options(cfg, section["fit"], "clone.fit")
    stats = train_imitation(Cloning(policy, store, episodes, mode), fit, folder, fresh=False)
    save_weights(policy, folder)
    return {**_both(stats, seen), "episodes": len(episodes)}


def _hands(cfg: Cfg) -> Hands:
    """How commands say where fingertips are."""
    return Hands(pose_style(cfg).tool_offset, build_kinematics(cfg))


def _both(stats: dict[str, float], seen: dict[str, float]) -> dict[str, float]:
    """What imitation says of itself, and what perception before it said, if it was trained."""
    return {**stats, **{f"perception_{key}": value for key, value in seen.items()}}
