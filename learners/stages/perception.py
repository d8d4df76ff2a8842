"""Stage: teach a policy's perception on every recorded frame, good or bad, before it clones the few good
ones.

Questions whose answers hang on where things are, and which every recording answers: what did whoever acted
do next, given whether the episode went on to succeed; how soon is success, as its discounted time; and, where
cameras are calibrated and key-points are told what to look for, where hands will be seen (traces.py).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from tensordict import TensorDict
from torch import Tensor, nn

from actors.policies.contract import with_text
from envs.conditioning.units import RESOLUTION
from envs.episodes.clips import ClipStore
from envs.rng import seed_process
from envs.specs import ActionMode
from learners.stages.imitation import Cloning
from learners.stages.judge import frame_targets
from learners.stages.observed import observe
from learners.stages.traces import Hands, trace_loss
from learners.training.fit import FitConfig, fit
from learners.training.parallel import Trainee

_TRACES = 0.1  # weight of where hands will be, beside the others


class PerceptionTasks(nn.Module):
    """Heads on a policy's features [B, width] that answer the questions; they are dropped afterwards.

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
        self, observed: TensorDict, chunks: Tensor, progress: Tensor, hands: Tensor | None = None
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Absolute error of the chunk, in its spread, plus cross-entropies of the discounted time to success
        and of where hands will be.

        Args:
            observed: [B], what the policy sees, its pictures float in -1..1.
            chunks: [B, K, A] that followed.
            progress: [B] discounted time to success, 0 in episodes that failed, NaN where nobody labelled.
            hands: of Hands.ahead, of a policy that can `gaze`.
        """
        figures: dict[str, Tensor] = {}
        if hands is None:
            hidden = self.policy.policy_features(observed)  # type: ignore[operator]
        else:
            hidden, found = self.policy.gaze(observed)  # type: ignore[operator]
            figures["traces"] = trace_loss(found[:, :, -self.policy.instruction_keypoints :], hands)  # type: ignore[operator]
        known = torch.isfinite(progress)
        won = (torch.nan_to_num(progress) > 0).float() - 0.5
        conditioned = hidden + self.outcome(torch.where(known, won, 0.0)[:, None])
        guess = self.acted(F.silu(conditioned)).unflatten(-1, tuple(self.centre.shape))
        active = self.spread > RESOLUTION
        wanted = (chunks - self.centre) / self.spread.clamp(min=RESOLUTION)
        acted = ((guess - wanted).abs() * active).sum() / (active.sum().clamp(min=1) * len(chunks))
        logits = self.soon(hidden)[:, 0].float()
        soon = F.binary_cross_entropy_with_logits(logits, torch.nan_to_num(progress), reduction="none")
        soon = (soon * known).sum() / known.sum().clamp(min=1)
        total = acted + soon + _TRACES * figures.get("traces", 0.0)
        figures |= {"action_error": acted, "time_to_success": soon}
        return total, {name: value.detach() for name, value in figures.items()}


def train_perception(
    policy: nn.Module,
    store: ClipStore,
    episodes: Tensor,
    mode: ActionMode,
    options: FitConfig,
    folder: Path,
    discount: float,
    hands: Hands,
    fresh: bool = True,
) -> dict[str, float]:
    """Train the perception of `policy` in place; does nothing for a policy without `policy_features`.

    Args:
        episodes: all that may be learned from, whoever acted, int64 [N].
        discount: of the time to success, per frame.
        hands: from which instruction key-points learn where hands will be.
        fresh: whether the policy has no units yet; it then takes them from these chunks first.
    """
    if not hasattr(policy, "policy_features") or not options.steps:
        return {}
    frames = Cloning(policy, store, episodes, mode)  # type: ignore[arg-type]
    progress = frame_targets(store, 1, discount)[1][frames.rows]
    if fresh and hasattr(policy, "normalise"):
        policy.normalise(frames.targets, frames.states, frames.commands)  # type: ignore[operator]
    with torch.random.fork_rng(devices=[]):
        seed_process(options.seed)
        tasks = PerceptionTasks(policy, (store.spec.chunk, store.spec.action_dim))
    tasks.to(next(policy.parameters()).device)
    tasks.normalise(frames.targets)

    keypoints: int = getattr(policy, "instruction_keypoints", 0)  # type: ignore[assignment]
    traces = hands.ahead(store, frames.rows, policy.views) if keypoints else None  # type: ignore[arg-type]

    def batch(step: int, generator: torch.Generator) -> TensorDict:
        pick = torch.randint(len(frames.rows), (options.part,), generator=generator)
        data = {"target": frames.targets[pick], "progress": progress[pick]}
        if traces is not None:
            data["hands"] = traces[pick]
        return TensorDict({"observed": observe(store, frames.rows[pick]), **data}, [])

    def loss(data: TensorDict, generator: torch.Generator) -> tuple[Tensor, dict[str, Any]]:
        observed, moved = frames.disturbed(data["observed"], generator)
        seen, hands = with_text(observed, policy), data.get("hands", None)  # type: ignore[arg-type]
        if hands is not None:  # in a shifted picture they are seen elsewhere
            hands = hands + moved.to(hands.device)[:, None, None]
        return tasks.loss(seen, data["target"], data["progress"], hands)

    # A policy is a list of parts that are asked for more than their forward pass.
    trainee = Trainee(tasks, apart=False)
    return fit("perception", trainee, batch, loss, options, folder, watch="action_error")
