"""What stages are given: episode seeds, options of a section, data and worlds of the stages before."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from actors.factory import build_judge, build_simulator, build_state_decoder, build_world, open_clips, options
from envs.episodes.clips import ClipStore
from envs.world import InitialStates
from learners.rl.algorithm import RLConfig
from learners.training.fit import FitConfig

Cfg = Mapping[str, Any]
Found = Mapping[str, Path]

# Episode seeds of different purposes never meet, whatever the experiment's own seed is.
_SPACE = 10_000_000
TRAIN, HELD_OUT, DEPLOY, EVALUATE = 0, 2_000_000, 4_000_000, 9_000_000


def seeds_of(cfg: Cfg, purpose: int, count: int, offset: int = 0) -> list[int]:
    """Episode seeds for a purpose. Evaluation seeds are the same for every experiment seed, so that runs can
    be compared.
    """
    base = purpose if purpose == EVALUATE else purpose + _SPACE * (1 + cfg["seed"])
    return list(range(base + offset, base + offset + count))


def fit_options(cfg: Cfg, section: Mapping[str, Any], key: str) -> FitConfig:
    """FitConfig of a section, seeded by the experiment."""
    return options(FitConfig, {**section, "seed": cfg["seed"], "microbatches": cfg["microbatches"]}, key)


def rl_options(cfg: Cfg, **more: Any) -> RLConfig:
    """RLConfig of the section rl, and what it leaves open."""
    return options(RLConfig, {**cfg["rl"], "microbatches": cfg["microbatches"], **more}, "rl")


def open_store(cfg: Cfg, found: Found, data: Iterable[str]) -> ClipStore:
    """The data sets of several stages as one store, with the commands that the simulator takes."""
    return open_clips(cfg, [found[name] / "dataset" for name in data])


def split(store: ClipStore) -> tuple[Tensor, Tensor]:
    """Training and held-out episodes: every eighth of a policy's episodes is kept from all training, for
    measuring.
    """
    numbers = torch.arange(len(store))
    kept = torch.tensor(
        [row["behaviour"].startswith("policy") and row["seed"] % 8 == 0 for row in store.episodes]
    )
    return numbers[~kept], numbers[kept]


def successful_episodes(cfg: Cfg, store: ClipStore, number: int) -> Tensor:
    """Episodes known to have worked in physics: successes of the policy deployed in round `number`, and the
    demonstrations where those are fewer.

    What older policies did pulls a better one back: cloned with theirs, one that succeeded in 44% was left
    with 38%,
    on its own 44%.
    """
    own, demos = (
        store.select([f"policy-{number}"], succeeded=True),
        store.select(["expert"], succeeded=True)[: cfg["imitation"]["demos"]],
    )
    own = own[torch.isin(own, split(store)[0])]
    return own if len(own) >= len(demos) else torch.cat([demos, own])


def load_world(
    cfg: Cfg,
    found: Found,
    store: ClipStore,
    vision: str,
    state: str,
    judge: str,
    batch: int,
    episodes: Tensor | None = None,
) -> Any:
    """The imagined world with the weights of three stages, starting where the store's episodes start."""
    simulator = build_simulator(cfg, found[vision] / "weights.safetensors")
    decoder = build_state_decoder(cfg, simulator, found[state] / "weights.safetensors")
    referee = build_judge(cfg, found[judge] / "weights.safetensors")
    return build_world(cfg, simulator, decoder, referee, InitialStates.of(store, episodes), batch)
