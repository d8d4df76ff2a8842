"""Whose values are estimated: policies, the same under noise, and scripted experts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from actors.factory import build_policy
from actors.policies.noisy import GaussianNoise
from envs.episodes.clips import ClipStore
from envs.initial_states import decision_points
from envs.specs import ActionMode, to_chunk
from envs.targets import ConfigError


@dataclass(frozen=True)
class Candidate:
    """Somebody whose value is estimated.

    Args:
        name: unique among candidates.
        section: its policy's config section; None of a scripted expert.
        weights: of the policy; None where it needs none.
        noise: on its actions, in units of each number's spread; 0 for none.
        expert: noise level of the scripted expert; None of policies.
    """

    name: str
    section: Mapping[str, Any] | None = None
    weights: Path | None = None
    noise: float = 0.0
    expert: float | None = None

    @property
    def inside(self) -> bool:
        """Whether it acts as those did from whom the world learned: without noise that nobody recorded."""
        return self.noise == 0.0

    def build(self, cfg: Mapping[str, Any], spread: Tensor) -> TensorDictModuleBase:
        """The policy.

        Args:
            spread: float32 [A], the units of noise; see action_spread.
        """
        policy = build_policy({**cfg, "policy": self.section}, self.weights)
        return GaussianNoise(policy, spread, self.noise) if self.noise else policy


def candidates(
    policies: Mapping[str, tuple[Mapping[str, Any], Path | None]],
    noise: Sequence[float],
    experts: Sequence[float],
) -> list[Candidate]:
    """Every policy (section and weights, by name) as it is and under each noise, and every expert.

    Raises:
        ConfigError: if there are fewer than two, of which no ranking can be kept or lost.
    """
    out = []
    for name, (section, weights) in policies.items():
        out.append(Candidate(name, section, weights))
        out += [Candidate(f"{name} + noise {level:g}", section, weights, level) for level in noise]
    out += [Candidate(f"expert {level:g}", expert=level) for level in experts]
    if len(out) < 2:
        raise ConfigError(
            f"policy_value compares at least two candidates, and there are {[one.name for one in out]}: name"
            " policy_value.policies=[<stage or folder>, ...], or policy_value.noise"
        )
    return out


def action_spread(store: ClipStore, mode: ActionMode) -> Tensor:
    """Standard deviation float32 [A] of each number of recorded chunks, as a policy says them."""
    episode, frame = decision_points(store, torch.arange(len(store)))
    start, last = store.start[episode], store.length[episode] - 1
    ahead = frame[:, None] + torch.arange(1, store.spec.chunk + 1)
    commands = store.arrays["commands"]
    chunks = to_chunk(
        commands[start[:, None] + torch.minimum(ahead, last[:, None])], commands[start + frame], mode
    )
    return chunks.flatten(0, 1).std(0)
