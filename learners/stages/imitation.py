"""Stage: behaviour cloning of the expert's demonstrations, chunk by chunk."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from actors.policies.vla import VISUAL_FEATURES, ChunkPolicy
from envs.encoders import Gaze, to_signed
from envs.episodes.clips import ClipStore
from envs.specs import IMAGE, STATE, TOKENS, to_relative
from learners.rl.dataset_rollout import looked_at
from learners.stages.pictures import augment, sights, survey
from learners.training.fit import FitConfig, fit

# Spread below which a command dimension is a constant: a millimetre, a hundredth of a radian, a twentieth of
# a grip.
ACTIVE_FLOOR = (1e-3, 1e-3, 1e-3, 1e-2, 1e-2, 1e-2, 5e-2)
_AIM = 16.0  # on how far off objects are seen, beside the error of what is done


class Cloning:
    """Chunks to imitate: every frame of the given episodes, with the next K commands relative to the one in
    force.

    Past an episode's end its last command is held.

    Args:
        generated: frames of generated.py. On these the policy is asked to do what it does on the true ones:
            what it
            learns in imagination is of use only as far as it sees both alike.
        watched: episodes whose frames, without their actions, teach the policy's perception where objects are
            seen, as
            far as the data say so.
    """

    def __init__(
        self,
        policy: ChunkPolicy,
        store: ClipStore,
        episodes: Tensor,
        generated: TensorDict | None = None,
        watched: Tensor | None = None,
    ):
        self.policy, self.store = policy, store
        self.aims = policy.perception.main.aims
        # a bad simulator leaves none
        self.generated = generated if generated is not None and len(generated) else None
        self.watched = store.rows(watched) if watched is not None and self.aims else None
        chunk = policy.head.chunk
        self.rows = store.rows(episodes)
        owner = torch.searchsorted(store.start, self.rows, right=True) - 1
        last = store.start[owner] + store.length[owner] - 1
        ahead = torch.minimum(self.rows[:, None] + torch.arange(1, chunk + 1), last[:, None])
        commands = store.arrays["commands"]
        self.targets = to_relative(commands[ahead], commands[self.rows])  # [N, K, 14]
        self.tokens = store.tokens[owner]
        self.seen: Tensor | None = None

    def look(self) -> None:
        """Encode every frame once, for a policy whose perception stays as it is."""
        self.seen = looked_at(self.policy.perception, self.store, self.rows, self.tokens)

    def sample(self, count: int, generator: torch.Generator) -> TensorDict:
        """Random observations with the knots their chunks have under the policy's units."""
        pick = torch.randint(len(self.rows), (count,), generator=generator)
        out = TensorDict({STATE: self.store.arrays["states"][self.rows[pick]]}, [])
        if self.seen is None:
            out[IMAGE], out[TOKENS] = self.store.frames(self.rows[pick]), self.tokens[pick]
        else:
            out[VISUAL_FEATURES] = self.seen[pick]
        if self.generated is not None:
            # each brings its true one
            made = self.generated[
                torch.randint(len(self.generated), (max(1, count // 2),), generator=generator)
            ]
            out["pair"] = TensorDict(
                {
                    "made": made["frames"],
                    "true": self.store.frames(made["row"]),
                    STATE: self.store.arrays["states"][made["row"]],
                    TOKENS: made["tokens"],
                },
                made.shape,
            )
            out["pair", "where"] = sights(self.store, made["places"], made["row"], self.aims)
        if self.watched is not None:
            shown = self.watched[torch.randint(len(self.watched), (count,), generator=generator)]
            out["shown"] = TensorDict(
                {
                    "frames": self.store.frames(shown)[:, :1],
                    "where": sights(self.store, self.store.arrays["objects"][shown], shown, self.aims),
                },
                [count],
            )
        out["target"] = self.policy.head.target(self.targets[pick])
        return out

    def loss(self, data: TensorDict, generator: torch.Generator) -> Tensor:
        """The head's imitation loss.

        Pictures and states are disturbed a little, for robustness.
        """
        policy, state = self.policy, data[STATE]
        seen = (
            data[VISUAL_FEATURES]
            if self.seen is not None
            else policy.perception(augment(to_signed(data[IMAGE]), generator), data[TOKENS])
        )
        noise = (
            torch.randn(state.shape, generator=generator).to(state.device) * 0.05 * policy.fusion.state_std
        )
        total = policy.head.error(policy.fusion(seen, state + noise), data["target"])
        if "shown" in data.keys():
            shown = data["shown"]
            _, aimed = policy.perception.main(augment(to_signed(shown["frames"]), generator)[:, 0], generator)
            total = total + _AIM * Gaze.missed(aimed, shown["where"]).sum()
        if "pair" not in data.keys():
            return total
        pair = data["pair"]
        made, aimed = policy.perception.look(pair["made"], pair[TOKENS])
        true = policy.perception(pair["true"], pair[TOKENS])
        # Seen alike from both sides: neither picture is the right one to be wrong about.
        total = total + policy.head.apart(policy.fusion(made, pair[STATE]), policy.fusion(true, pair[STATE]))
        return total + _AIM * Gaze.missed(aimed, pair["where"]).sum()


def train_imitation(
    policy: ChunkPolicy,
    store: ClipStore,
    episodes: Tensor,
    options: FitConfig,
    folder: Path,
    fresh: bool = True,
    generated: TensorDict | None = None,
    watched: Tensor | None = None,
) -> dict[str, float]:
    """Clone the given episodes; a `fresh` policy gets its units from them first, one that can act already
    keeps its own. The rest: see Cloning.
    """
    cloning = Cloning(policy, store, episodes, generated, watched)
    if fresh:
        if cloning.watched is not None:
            survey(policy.perception.main, store, cloning.watched)
        policy.normalise(
            cloning.targets, store.arrays["states"][cloning.rows], torch.tensor(ACTIVE_FLOOR * 2)
        )
    for parameter in policy.head.exploration():
        parameter.requires_grad_(False)

    def loss(data: TensorDict, generator: torch.Generator) -> tuple[Tensor, dict[str, Any]]:
        return cloning.loss(data, generator), {}

    stats = fit(
        "imitation",
        policy,
        lambda step, generator: cloning.sample(options.part, generator),
        loss,
        options,
        folder,
    )
    for parameter in policy.head.exploration():
        parameter.requires_grad_(True)
    return stats
