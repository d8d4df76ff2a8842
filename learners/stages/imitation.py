"""Stage: behaviour cloning of the expert's demonstrations, chunk by chunk."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from actors.policies.vla import HIDDEN, ChunkPolicy
from envs.encoders import to_signed
from envs.episodes.clips import ClipSpec, ClipStore
from envs.language import tokenize
from envs.schema import IMAGE, STATE, TOKENS, to_relative
from learners.fit import FitConfig, fit
from learners.stages.judge import augment

# Spread below which a command dimension is a constant: a millimetre, a hundredth of a radian, a twentieth of a grip.
ACTIVE_FLOOR = (1e-3, 1e-3, 1e-3, 1e-2, 1e-2, 1e-2, 5e-2)


def observations(store: ClipStore, rows: Tensor, tokens: Tensor) -> TensorDict:
    """What a policy would have seen at given rows [B] of a store, with tokens [B, WORDS]."""
    return TensorDict({IMAGE: store.frames(rows), STATE: store.arrays["states"][rows], TOKENS: tokens}, rows.shape)


def train_imitation(policy: ChunkPolicy, store: ClipStore, episodes: Tensor, chunk: int, options: FitConfig, folder: Path) -> dict[str, float]:
    """Clone the chunks of the given episodes; sets the policy's units from them first.

    The target at a frame is the next K commands relative to the one in force; past the end the last is held.
    """
    tokens = torch.stack([tokenize(row["instruction"]) for row in store.episodes])
    spec = ClipSpec(1, chunk)
    every = torch.cat([torch.stack([torch.full((int(store.length[n]),), n), torch.arange(int(store.length[n]))]) for n in episodes.tolist()], 1)
    commands = store.arrays["commands"]
    last = store.start[every[0]] + store.length[every[0]] - 1
    rows = store.start[every[0]] + every[1]
    ahead = torch.minimum(rows[:, None] + torch.arange(1, spec.chunk + 1), last[:, None])
    targets = to_relative(commands[ahead], commands[rows])
    policy.normalise(targets, store.arrays["states"][rows], torch.tensor(ACTIVE_FLOOR * 2))
    head = policy.head
    active = head.gain > 0
    knots = torch.linalg.pinv(head.basis) @ ((targets - head.offset) / torch.where(active, head.gain, 1.0))

    def batch(step: int, generator: torch.Generator) -> TensorDict:
        pick = torch.randint(len(rows), (options.batch,), generator=generator)
        out = observations(store, rows[pick], tokens[every[0][pick]])
        out["target"] = knots[pick]
        return out

    def loss(data: TensorDict, generator: torch.Generator) -> tuple[Tensor, dict[str, Any]]:
        loc = predict_knots(policy, data, generator)
        error = (loc - data["target"]).abs() * active
        return error.sum() / (active.sum() * loc.shape[0] * loc.shape[1]), {}

    head.log_std.requires_grad_(False)  # exploration is a choice, not something demonstrations tell
    stats = fit("imitation", policy, batch, loss, options, folder)
    head.log_std.requires_grad_(True)
    return stats


def predict_knots(policy: ChunkPolicy, data: TensorDict, generator: torch.Generator | None = None) -> Tensor:
    """Mean knots [B, n, 14] for observations; with a generator, pictures and states are disturbed a little for robustness."""
    trunk = policy.trunk
    if generator is None:
        return policy.head(policy[0](data)[HIDDEN])[0]
    image, state = data[IMAGE], data[STATE]
    pictures = augment(to_signed(image), generator)
    noise = torch.randn(state.shape, generator=generator).to(state.device) * 0.05 * trunk.state_std
    return policy.head(trunk(pictures, state + noise, data[TOKENS]))[0]
