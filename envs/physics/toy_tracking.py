"""TorchRL's ToyVLAEnv in its tracking mode as one of our worlds: chunks, seeded episodes, groups that share a
start.

It needs neither pictures nor physics to be learned, which makes it the place to compare learners; see
`worldloop bench learning`.
"""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import ToyVLAEnv

from envs.chunked import ChunkedEnv
from envs.embodiment import ActionKind, Camera, Embodiment
from envs.rng import constant_generator
from envs.specs import CHUNK, COMMAND, IMAGE, PROGRESS, STATE, SUCCESS, ActionMode, WorldSpec

_SIZE = 16  # pixels a side


def toy_embodiment(actions: int) -> Embodiment:
    """A robot of `actions` nameless numbers whose one camera shows noise."""
    names = tuple(f"action_{k}" for k in range(actions))
    return Embodiment(
        robot="toy_tracking",
        action_names=names,
        action_kind=ActionKind.OTHER,
        delta=False,
        arms=(),
        state_names=(*names, *(f"target_{k}" for k in range(actions))),
        cameras=(Camera("noise", (_SIZE, _SIZE)),),
        fps=10.0,
    )


class ToyTrackingEnv(ChunkedEnv):
    """A batch of episodes with a target, part of the state, that actions must stay near; reward 1 at success,
    else 0.

    Args:
        batch: episodes side by side.
        chunk: actions per step.
        decisions: chunks per episode at most.
        actions: numbers of an action; the state holds the last action, then the target.
        success_steps: consecutive actions near the target that make a success.
        tolerance: how near, in every number.
        starts: different targets; an episode's is that of its seed modulo this.
        targets: seed of all targets; another gives targets never seen.
        seed: of the stream of episode seeds.
    """

    def __init__(
        self,
        batch: int,
        chunk: int = 4,
        decisions: int = 6,
        actions: int = 2,
        success_steps: int = 2,
        tolerance: float = 0.35,
        starts: int = 4096,
        targets: int = 0,
        seed: int = 0,
    ):
        spec = WorldSpec(toy_embodiment(actions), (_SIZE, _SIZE), chunk)
        super().__init__(spec, batch, chunk * decisions, ActionMode.ABSOLUTE, seed=seed)
        self.toy = ToyVLAEnv(
            actions,
            2 * actions,
            (3, _SIZE, _SIZE),
            success_steps=success_steps,
            success_tol=tolerance,
            batch_size=torch.Size([batch]),
            seed=seed,
        )
        self._state = torch.zeros(batch, 2 * actions)
        self.targets = torch.rand(starts, actions, generator=constant_generator(targets)) - 0.5

    def _reset(self, tensordict: TensorDictBase | None = None, **_: Any) -> TensorDictBase:
        mask = self._reset_mask(tensordict)
        seeds = self._next_seeds(mask)
        self.toy.reset(TensorDict({"_reset": mask[:, None]}, self.batch_size))
        target = self.toy.get_buffer("_target")
        target[mask] = self.targets[seeds[mask] % len(self.targets)]
        self._steps[mask] = 0
        self._state = torch.where(
            mask[:, None], torch.cat((torch.zeros_like(target), target), -1), self._state
        )
        return self._observed(torch.zeros(*self.batch_size, 1, dtype=torch.bool))

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        chunk = tensordict[CHUNK].clamp(-1, 1)
        won = torch.zeros(*self.batch_size, 1, dtype=torch.bool)
        for action in chunk.unbind(1):  # an episode that is won stands still for the rest of its chunk
            step = TensorDict({"action": action, "_step": ~won.squeeze(-1)}, self.batch_size)
            after = self.toy.step(step)["next"]
            won = won | after["success"]
            if won.all():  # TorchRL cannot step nobody
                break
        self._state, self._steps = after["observation", "state"].clone(), self._steps + self.chunk
        out = self._observed(won)
        late = (self._steps >= self.horizon).unsqueeze(-1)
        out.update({"reward": won.float(), "terminated": won, "truncated": late & ~won, "done": won | late})
        return out

    def _observed(self, won: torch.Tensor) -> TensorDict:
        out = TensorDict({}, self.batch_size)
        # Noise of this environment's own, which `schedule` seeds: a job is the same whatever ran before.
        image = torch.randint(
            0, 256, self.observation_spec[IMAGE].shape, dtype=torch.uint8, generator=self._stream
        )
        out[IMAGE], out[STATE], out[SUCCESS], out[PROGRESS] = image, self._state.clone(), won, won.float()
        out[COMMAND] = self._state[:, : self.targets.shape[1]].clone()
        return self._with_identity(out, [self.toy.instruction] * self.batch_size[0])
