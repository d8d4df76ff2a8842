"""Stage: teach a policy's perception on every recorded frame, good or bad, before it clones the few good
ones.

Two questions whose answers hang on where things are, and which every recording answers: what did whoever
acted do next, given whether the episode went on to succeed; and how soon is success, as its discounted time.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from tensordict import TensorDict
from torch import Tensor, nn

from actors.policies.contract import with_text
from envs.episodes.clips import ClipStore
from envs.rng import seed_process
from envs.specs import ActionMode
from learners.stages.imitation import Cloning
from learners.stages.judge import frame_targets
from learners.stages.observed import observe
from learners.training.fit import FitConfig, fit

_SPREAD = 1e-3  # of a number of the chunk below which it is a constant that nobody need predict


class PerceptionTasks(nn.Module):
    """Heads on a policy's features [B, width] that answer the two questions; they are dropped afterwards.

    Args:
        policy: with `policy_features(observed) -> [B, width]` and `width`.
        chunk: (K, A) of its chunks.
    """

    centre: Tensor
    spread: Tensor

    def __init__(self, policy: nn.Module, chunk: tuple[int, int]):
        super().__init__()
        self.policy = policy
        width = int(policy.width)  # type: ignore[arg-type]
        self.outcome = nn.Linear(1, width)
        self.acted = nn.Linear(width, chunk[0] * chunk[1])
        self.soon = nn.Linear(width, 1)
        self.register_buffer("centre", torch.zeros(chunk))
        self.register_buffer("spread", torch.ones(chunk))

    def normalise(self, chunks: Tensor) -> None:
        """Take units from chunks [N, K, A]; what hardly varies counts nothing."""
        self.centre.copy_(chunks.mean(0))
        self.spread.copy_(chunks.std(0))

    def loss(
        self, observed: TensorDict, chunks: Tensor, progress: Tensor
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Absolute error of the chunk, in its spread, plus cross-entropy of the discounted time to success.

        Args:
            observed: [B], what the policy sees, its pictures float in -1..1.
            chunks: [B, K, A] that followed.
            progress: [B] discounted time to success, 0 in episodes that failed, NaN where nobody labelled.
        """
        hidden = self.policy.policy_features(observed)  # type: ignore[operator]
        known = torch.isfinite(progress)
        won = (torch.nan_to_num(progress) > 0).float() - 0.5
        told = hidden + self.outcome(torch.where(known, won, 0.0)[:, None])
        said = self.acted(F.silu(told)).unflatten(-1, tuple(self.centre.shape))
        active = self.spread > _SPREAD
        wanted = (chunks - self.centre) / self.spread.clamp(min=_SPREAD)
        acted = ((said - wanted).abs() * active).sum() / (active.sum().clamp(min=1) * len(chunks))
        logits = self.soon(hidden)[:, 0].float()
        soon = F.binary_cross_entropy_with_logits(logits, torch.nan_to_num(progress), reduction="none")
        soon = (soon * known).sum() / known.sum().clamp(min=1)
        return acted + soon, {"action_error": acted.detach(), "time_to_success": soon.detach()}


def train_perception(
    policy: nn.Module,
    store: ClipStore,
    episodes: Tensor,
    mode: ActionMode,
    options: FitConfig,
    folder: Path,
    discount: float,
    fresh: bool = True,
) -> dict[str, float]:
    """Train the perception of `policy` in place; does nothing for a policy without `policy_features`.

    Args:
        episodes: all that may be learned from, whoever acted, int64 [N].
        discount: of the time to success, per frame.
        fresh: whether the policy has no units yet; it then takes them from these chunks first.
    """
    if not hasattr(policy, "policy_features") or not options.steps:
        return {}
    frames = Cloning(policy, store, episodes, mode)  # type: ignore[arg-type]
    progress = frame_targets(store, 1, discount)[1][frames.rows]
    if fresh and hasattr(policy, "normalise"):
        policy.normalise(frames.targets, frames.states)  # type: ignore[operator]
    with torch.random.fork_rng(devices=[]):
        seed_process(options.seed)
        tasks = PerceptionTasks(policy, (store.spec.chunk, store.spec.action_dim))
    tasks.to(next(policy.parameters()).device)
    tasks.normalise(frames.targets)

    def batch(step: int, generator: torch.Generator) -> TensorDict:
        pick = torch.randint(len(frames.rows), (options.part,), generator=generator)
        data = {"target": frames.targets[pick], "progress": progress[pick]}
        return TensorDict({"observed": observe(store, frames.rows[pick]), **data}, [])

    def loss(data: TensorDict, generator: torch.Generator) -> tuple[Tensor, dict[str, Any]]:
        observed = frames.disturbed(data["observed"], generator)
        # type: ignore[arg-type]
        return tasks.loss(with_text(observed, policy), data["target"], data["progress"])

    return fit("perception", tasks, batch, loss, options, folder, watch="action_error")
