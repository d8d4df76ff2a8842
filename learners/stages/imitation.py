"""Stage: behaviour cloning of successful episodes, chunk by chunk, of any policy."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from actors.policies.contract import (
    VISUAL_FEATURES,
    feature_part,
    imitation_loss,
    inputs_for,
    with_text,
)
from envs.episodes.clips import ClipStore
from envs.specs import (
    IMAGE,
    INSTRUCTION_UTF8,
    STATE,
    ActionMode,
    at_rest,
    to_chunk,
)
from envs.targets import ConfigError
from learners.stages.observed import observe
from learners.stages.pictures import augmented
from learners.stages.simulator import last_rows
from learners.stages.words import reworded
from learners.training.fit import FitConfig, fit
from learners.training.parallel import Trainee

_STATE_NOISE = 0.05  # of each number's spread
_AT_ONCE = 256  # frames per pass of `encode`


class Cloning:
    """Chunks to imitate: every frame of the given episodes, with the next K commands.

    Args:
        policy: any policy (actors/policies/contract.py).
        store: whose spec says how many commands a chunk has, K.
        episodes: whose behaviour is imitated, int64 [N].
        mode: how the numbers of the policy's chunks are meant.
    """

    def __init__(self, policy: TensorDictModuleBase, store: ClipStore, episodes: Tensor, mode: ActionMode):
        self.policy, self.store = policy, store
        rows = store.rows(episodes)
        self.rows = rows[store.arrays["present"][rows]]
        self.targets = chunks_ahead(store, self.rows, mode)
        self.states = store.arrays["states"][self.rows]
        self.commands = store.arrays["commands"][self.rows]
        self.state_noise = _STATE_NOISE * self.states.std(0)
        self._features: Tensor | None = None

    def encode(self) -> None:
        """Compute the policy's visual features of every frame once, for a policy whose perception is frozen.

        Raises:
            ConfigError: if the policy writes no ("policy", "visual_features").
        """
        if VISUAL_FEATURES not in self.policy.out_keys:
            raise ConfigError(
                f"{type(self.policy).__name__} writes no {VISUAL_FEATURES}; set rl.freeze_perception=false"
            )
        encoder = feature_part(self.policy)
        with torch.no_grad():
            parts = [
                encoder(inputs_for(observe(self.store, some), self.policy))[VISUAL_FEATURES].cpu()
                for some in self.rows.split(_AT_ONCE)
            ]
        self._features = torch.cat(parts)

    def sample(self, count: int, generator: torch.Generator) -> TensorDict:
        """Random observations and the chunks that followed: TensorDict [] with observed [count] and target
        [count, K, A].
        """
        pick = torch.randint(len(self.rows), (count,), generator=generator)
        observed = observe(self.store, self.rows[pick], pictures=self._features is None)
        if self._features is not None:
            observed[VISUAL_FEATURES] = self._features[pick]
        return TensorDict({"observed": observed, "target": self.targets[pick]}, [])

    def disturbed(self, observed: TensorDict, generator: torch.Generator) -> tuple[TensorDict, Tensor]:
        """Observations [N] whose pictures, states and words are disturbed a little, for robustness; and by
        how much things in pictures have moved, float32 [N, 2], (u, v) as shares of width and height.
        """
        out, moved = observed.copy(), torch.zeros(len(observed), 2)
        perceived = IMAGE in out.keys(True, True)  # else features are there, and nobody reads the words again
        if perceived:
            out[IMAGE], moved = augmented(out[IMAGE], generator)
        state = out[STATE]
        noise = torch.randn(state.shape, generator=generator) * self.state_noise
        out[STATE] = state + noise.to(state.device)
        if perceived:
            out[INSTRUCTION_UTF8] = reworded(out[INSTRUCTION_UTF8], generator)
        return out, moved

    def loss(self, data: TensorDict, generator: torch.Generator) -> Tensor:
        """Imitation loss of a batch of `sample`; pictures, states and words are disturbed a little."""
        observed, _ = self.disturbed(data["observed"], generator)
        return imitation_loss(self.policy, with_text(observed, self.policy), data["target"])


def chunks_ahead(store: ClipStore, rows: Tensor, mode: ActionMode) -> Tensor:
    """The chunks [N, K, A] that followed frames `rows` [N].

    Past an episode's end its last command is held: absolute ones repeat, changes are 0.
    """
    commands, robot = store.arrays["commands"], store.spec.embodiment
    ahead, last = rows[:, None] + torch.arange(1, store.spec.chunk + 1), last_rows(store, rows)[:, None]
    chunks = commands[torch.minimum(ahead, last)]
    chunks = torch.where((ahead > last)[..., None], at_rest(chunks, robot), chunks)
    return to_chunk(chunks, commands[rows], mode)


def train_imitation(
    cloning: Cloning, options: FitConfig, folder: Path, fresh: bool = True
) -> dict[str, float]:
    """Train the policy of `cloning` in place.

    Args:
        fresh: whether it cannot act yet; it then takes its units from these chunks first, if it has any.
    """
    policy = cloning.policy
    if fresh and hasattr(policy, "normalise"):
        policy.normalise(cloning.targets, cloning.states, cloning.commands)

    def loss(data: TensorDict, generator: torch.Generator) -> tuple[Tensor, dict[str, Any]]:
        return cloning.loss(data, generator), {}

    def batch(step: int, generator: torch.Generator) -> TensorDict:
        return cloning.sample(options.part, generator)

    # A policy is a list of parts that are asked for more than their forward pass.
    return fit("imitation", Trainee(policy, apart=False), batch, loss, options, folder)
