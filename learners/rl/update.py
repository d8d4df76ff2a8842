"""Where a policy is updated: the optimisation of one iteration, by the losses of ppo.py, grpo.py and
filtered_bc.py.
"""

from __future__ import annotations

import math

import torch
from tensordict import TensorDict
from torch import Tensor

from actors.policies.contract import device_of
from envs.rng import order_generator, step_generator
from envs.specs import SUCCESS
from learners.rl.algorithm import Algorithm, RLConfig, finite, first_episode, judged, whole
from learners.rl.recorded.decisions import TrueExperience
from learners.training.fit import TrainingDiverged
from learners.training.parallel import Trainee, averaged, clip_gradients, my_share


def update(
    batch: TensorDict | None,
    algorithm: Algorithm,
    trainee: Trainee,
    optimiser: torch.optim.Optimizer,
    config: RLConfig,
    seed: int,
    true: TrueExperience | None = None,
) -> dict[str, float]:
    """One iteration's optimisation on a rollout [B, T]; returns its figures.

    Args:
        batch: None: on recorded decisions alone, in as many updates as TrueExperience.alone says.
        trainee: algorithm.modules() in training.
        seed: of minibatches and of what is drawn of true experience.
    """
    figures: dict[str, float] = {}
    if batch is not None:
        batch = batch.to(device_of(algorithm.modules()))
        data, extra = trainee(algorithm.prepare, batch)
        figures = outcome(batch) | extra
    else:
        assert true is not None and true.decisions is not None, "there is nothing else to learn from"
        data = trainee(true.decisions.own_chunks, true.alone, seed)
    shuffle = order_generator(seed)
    known = None
    if true is not None and true.decisions is not None and config.recorded:
        known = trainee(true.decisions.sample, config.recorded, data, shuffle)
        figures["recorded"] = float(len(known))
    sums: dict[str, float] = {}
    count, planned, reached = 0, 0, 0.0
    for _ in range(config.epochs):
        order = torch.randperm(len(data), generator=shuffle)
        for pick in order.split(config.minibatch):
            if not len(pick) or len(pick) < 16 <= len(data):  # nothing, or a rest too small for a step
                continue
            planned += 1
            if reached > config.kl_stop:
                continue
            optimiser.zero_grad(set_to_none=True)
            rows, parts, mine = [], pick.tensor_split(config.microbatches), my_share(config.microbatches)
            for part in mine:
                generator = step_generator(seed, count, part)
                loss, row = trainee(_loss, algorithm, data[parts[part]], config, generator, true, known)
                (loss / len(mine)).backward()
                rows.append(row)
            means = averaged(rows)
            reached = means.get("kl", 0.0)
            if reached > config.kl_stop:
                continue
            # each group by itself: a critic's large gradients must not make the policy's small
            norm = max(clip_gradients(group["params"], config.clip) for group in optimiser.param_groups)
            if not math.isfinite(norm):
                raise TrainingDiverged(f"rl: gradient norm {norm}; lower rl.lr; the last checkpoint is kept")
            optimiser.step()
            for key, value in {**means, "grad_norm": norm}.items():
                sums[key] = sums.get(key, 0.0) + value
            count += 1
    figures |= {key: value / max(1, count) for key, value in sums.items()}
    done = {"updates": float(count), "planned_updates": float(planned), "kl_reached": reached}
    return figures | done | {"transitions": float(len(data))}


def _loss(
    algorithm: Algorithm,
    minibatch: TensorDict,
    config: RLConfig,
    generator: torch.Generator,
    true: TrueExperience | None,
    known: TensorDict | None,
) -> tuple[Tensor, dict[str, float]]:
    # what weighs nothing still tells how far the policy has come
    with torch.set_grad_enabled(config.imagined > 0 or known is None):
        loss, row = algorithm.loss(minibatch)
    loss = config.imagined * loss
    if known is not None and len(known):
        # by itself, for its likelihood ratios do not say how far the policy has come
        pick = torch.randint(len(known), (len(minibatch),), generator=generator)
        recorded_loss, recorded_figures = algorithm.loss(known[pick])
        loss = loss + recorded_loss
        row["recorded_clip_fraction"] = recorded_figures.get("clip_fraction", 0.0)
    if true is not None and true.anchor is not None and config.anchor:
        drawn = true.anchor.sample(config.anchor_batch // config.microbatches, generator)
        pull = true.anchor.loss(drawn.to(device_of(algorithm.modules())), generator)
        loss = loss + config.anchor * pull
        row["anchor"] = float(pull.detach())
    return loss, {**row, "loss": float(loss.detach())}


def outcome(batch: TensorDict) -> dict[str, float]:
    """Success and return of the first episodes of a rollout [B, T] that nothing has spoiled, and how many
    something has.
    """
    done, success = batch["next", "done"].squeeze(-1), batch["next", SUCCESS].squeeze(-1)
    mine, stood, finite_actions = first_episode(done), whole(batch)[:, 0], finite(batch)[:, 0]
    kept = stood & finite_actions & judged(batch)[:, 0]
    reward = (batch["next", "reward"].squeeze(-1) * mine).sum(1)[kept]
    there = bool(kept.any())
    return {
        "success": float((success & mine).any(1)[kept].float().mean()) if there else 0.0,
        "return": float(reward.mean()) if there else 0.0,
        "reward_std": float(reward.std(unbiased=False)) if there else 0.0,
        "dropped_by_physics": float((~stood).sum()),
        "dropped_nan": float((stood & ~finite_actions).sum()),
        "dropped_by_judge": float((stood & finite_actions & ~kept).sum()),
    }
