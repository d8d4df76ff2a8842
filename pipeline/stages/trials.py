"""How RL's policy truly does while it learns: success in physics, for curves over training time."""

from __future__ import annotations

from pathlib import Path

import torch

from actors.factory import at_once, build_physics, build_policy
from actors.rollouts.evaluate import evaluate
from actors.rollouts.host import Weights
from envs.rng import Purpose, episode_seeds
from learners.rl.algorithm import RLConfig
from learners.rl.watch import Watch
from pipeline.stages.given import Cfg

_SIDE_BY_SIDE = 100  # episodes


def true_success(cfg: Cfg, settings: RLConfig, policy: Path | None) -> Watch | None:
    """Tries the policy in physics every rl.evaluate_every iterations, deterministically on the first
    evaluation seeds; None if it is not wanted. Nobody learns from it.

    Args:
        policy: weights that RL starts from; what it trains is put over them.

    Returns:
        A Watch with the figures true_success and true_episodes.
    """
    if not settings.evaluate_every:
        return None
    seeds = episode_seeds(cfg["seed"], Purpose.EVALUATE, settings.evaluate_episodes)

    def look(iteration: int, weights: Weights) -> tuple[dict[str, float], bool]:
        with torch.random.fork_rng(devices=[]):
            replica = build_policy(cfg, policy)
            known = dict(replica.named_parameters())
            with torch.no_grad():
                for name, value in weights.items():
                    known[name].copy_(torch.tensor(value))
            env = build_physics(cfg, at_once(cfg, min(_SIDE_BY_SIDE, len(seeds))))
            try:
                outcome = evaluate(env, replica, seeds, label=f"physics after {iteration + 1}")
            finally:
                env.close()
        return {"true_success": outcome.rate, "true_episodes": float(outcome.counted.sum())}, False

    return Watch(settings.evaluate_every, look)
