"""Deterministic evaluation: the same episode seeds for every policy, in either world."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp
from tqdm import tqdm

from actors.policies.safe import SafePolicyWrapper
from envs.rng import seed_process
from envs.specs import JUDGE_STATUS, LOST, PROGRESS, SUCCESS, Status


@dataclass
class Outcome:
    """Results per episode, in the order of the seeds.

    success bool [N], progress float [N], counted bool [N]: whether that can be told: a judge gave a
    judgement, physics did not crash.
    """

    seeds: list[int]
    success: Tensor
    progress: Tensor
    counted: Tensor

    @property
    def rate(self) -> float:
        """Share of successes among the episodes that count."""
        return float(self.success[self.counted].float().mean()) if self.counted.any() else float("nan")


@torch.no_grad()
def evaluate(
    env: EnvBase,
    policy: TensorDictModuleBase,
    seeds: list[int],
    stochastic: bool = False,
    label: str = "evaluate",
    sampling_seed: int = 0,
) -> Outcome:
    """Run one episode per seed.

    Args:
        env: any world; its batch size sets how many run side by side.
        policy: any policy (policies/contract.py); acts by its mode, or samples if `stochastic`.
        seeds: of the episodes; padding at the end is not counted.
        sampling_seed: of a stochastic policy's draws.

    Returns:
        Outcome, in the order of `seeds`.
    """
    base = getattr(env, "base_env", env)
    width = env.batch_size[0]
    steps = base.horizon // base.chunk
    actor = SafePolicyWrapper(policy, base.spec, base.mode)
    success, progress, counted = [], [], []
    seed_process(sampling_seed)
    mode = ExplorationType.RANDOM if stochastic else ExplorationType.DETERMINISTIC
    with set_exploration_type(mode):
        for begin in tqdm(
            range(0, len(seeds), width), desc=label, unit="batch", dynamic_ncols=True, leave=False
        ):
            part = seeds[begin : begin + width]
            base.schedule([*part, *[part[-1]] * (width - len(part))])
            now = env.reset()
            over = torch.zeros(width, dtype=torch.bool)
            won = torch.zeros(width, dtype=torch.bool)
            fine = torch.ones(width, dtype=torch.bool)
            reached = torch.zeros(width)
            for _ in range(steps):
                after = env.step(actor(now))
                result = after["next"]
                live = ~over
                won |= live & result[SUCCESS].squeeze(-1).cpu()
                reached = torch.where(live, result[PROGRESS].squeeze(-1).cpu(), reached)
                if JUDGE_STATUS in result.keys(True, True):
                    fine &= ~(live & (result[JUDGE_STATUS].squeeze(-1).cpu() != Status.OK.value))
                if LOST in result.keys(True, True):
                    fine &= ~(live & result[LOST].squeeze(-1).cpu())
                over |= result["done"].squeeze(-1).cpu()
                if over.all():
                    break
                now = step_mdp(after, exclude_reward=True, exclude_done=True)
            success.append(won[: len(part)])
            progress.append(reached[: len(part)])
            counted.append(fine[: len(part)])
    return Outcome(list(seeds), torch.cat(success), torch.cat(progress), torch.cat(counted))
