"""What both worlds share: one step is one chunk, the specs of VLA observations, and seeded queues of
episodes.
"""

from __future__ import annotations

import hashlib
import math
from collections import deque
from collections.abc import Iterable, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from envs.embodiment import Embodiment
from envs.rng import episode_stream
from envs.specs import (
    EPISODE,
    INSTRUCTION_UTF8,
    TEXT_BYTES,
    ActionMode,
    WorldSpec,
    text_to_bytes,
    warn_of_cut,
)


def check_mode(robot: Embodiment, mode: ActionMode | str) -> None:
    """See that a robot's chunks can be meant so.

    Raises:
        ValueError: if deltas are to be relative.
    """
    if robot.delta and ActionMode(mode) is ActionMode.RELATIVE:
        raise ValueError(
            f"task.mode=relative needs absolute actions, and those of {robot.robot} are deltas;"
            " set task.mode=absolute"
        )


class ChunkedEnv(EnvBase):
    """Base of PhysicsEnv and WorldEnv: a batched environment with the same specs in truth and in imagination.

    Every episode has a seed. Seeds come by turns from the queue filled by `schedule`, and before that from a
    stream of their own; what happens in an episode depends on its seed and on the actions only.

    Args:
        spec: robot, size of the views, actions per step K.
        batch: episodes side by side, B.
        horizon: actions per episode, a multiple of K.
        mode: meaning of the chunk's numbers.
        device: where observations live.
        seed: of the stream of episode seeds.

    Attributes:
        instructions: texts of the B episodes, of which rollouts carry bytes (specs.INSTRUCTION_UTF8).

    Raises:
        ValueError: if the horizon is not a multiple of the chunk, or deltas are to be relative.
    """

    def __init__(
        self,
        spec: WorldSpec,
        batch: int,
        horizon: int,
        mode: ActionMode,
        device: torch.device | str = "cpu",
        seed: int = 0,
    ):
        mode = ActionMode(mode)
        if horizon % spec.chunk:
            raise ValueError(f"task.horizon={horizon} must be a multiple of task.chunk={spec.chunk}")
        check_mode(spec.embodiment, mode)
        super().__init__(device=torch.device(device), batch_size=torch.Size([batch]))
        self.spec, self.horizon, self.mode = spec, horizon, mode
        self._stream = episode_stream(seed)
        self._queue: deque[int] = deque()
        self._seeds = torch.zeros(batch, dtype=torch.int64)
        self._steps = torch.zeros(batch, dtype=torch.int64)
        self._over = torch.ones(batch, 1, dtype=torch.bool)
        # Texts stay outside the rollout: stacks of strings break TorchRL's stacking by device.
        self.instructions: list[str] = [""] * batch
        self._set_specs()

    @property
    def chunk(self) -> int:
        """Actions per step, K."""
        return self.spec.chunk

    @property
    def elapsed(self) -> torch.Tensor:
        """Actions that each episode has seen, int64 [B]."""
        return self._steps

    def _set_specs(self) -> None:
        spec, shape = self.spec, tuple(self.batch_size)
        views = spec.views
        seen = {
            "observation": Composite(
                image=Bounded(0, 255, (*shape, views, 3, *spec.size), dtype=torch.uint8),
                state=Unbounded((*shape, spec.state_dim)),
                command=Unbounded((*shape, spec.action_dim)),
                instruction_utf8=Bounded(0, 255, (*shape, TEXT_BYTES), dtype=torch.uint8),
                shape=shape,
            ),
            "success": Binary(1, (*shape, 1), dtype=torch.bool),
            "progress": Bounded(0.0, 1.0, (*shape, 1)),
            "episode_seed": Unbounded((*shape, 1), dtype=torch.int64),
        }
        if spec.embodiment.calibrated:
            seen["camera"] = Composite(
                intrinsic=Unbounded((*shape, views, 3, 3)),
                c2w=Unbounded((*shape, views, 4, 4)),
                shape=shape,
            )
        self.observation_spec = Composite(seen, shape=shape).to(self.device)
        self._observation_keys = list(self.observation_spec.keys(True, True))
        # A spec must be bounded to be sampled from: offsets of a metre or a radian and deltas of one are more
        # than arms do at once, joints turn by half a circle.
        absolute = self.mode is ActionMode.ABSOLUTE and not spec.embodiment.delta
        bound = math.pi if absolute else 1.0
        chunk = Bounded(-bound, bound, (*shape, spec.chunk, spec.action_dim))
        self.action_spec = Composite(vla_action=Composite(chunk=chunk, shape=shape), shape=shape).to(
            self.device
        )
        self.reward_spec = Unbounded((*shape, 1), device=self.device)
        flag = Categorical(2, (*shape, 1), dtype=torch.bool, device=self.device)
        self.done_spec = Composite(
            done=flag, terminated=flag.clone(), truncated=flag.clone(), shape=shape, device=self.device
        )

    def schedule(self, seeds: Iterable[int]) -> None:
        """Queue episode seeds; resets take them in order, lowest slot first. Replaces what was queued.

        Once they are used up, they come again from the first; where none were given, others are drawn. What a
        subclass draws from the stream of its own hangs on nothing but `seeds`, too.
        """
        self._queue = deque(int(seed) for seed in seeds)
        if self._queue:
            digest = hashlib.sha256(repr(tuple(self._queue)).encode()).digest()
            self._stream = episode_stream(int.from_bytes(digest[:6], "big"))

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            self._stream = episode_stream(seed)

    def _reset_mask(self, tensordict: TensorDictBase | None) -> torch.Tensor:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is None:
            return torch.ones(self.batch_size[0], dtype=torch.bool)
        return mask.reshape(self.batch_size[0], -1).any(-1).cpu()

    def _next_seeds(self, mask: torch.Tensor) -> torch.Tensor:
        for slot in mask.nonzero().flatten().tolist():
            if self._queue:
                self._seeds[slot] = self._queue[0]
                self._queue.rotate(-1)
            else:
                self._seeds[slot] = int(torch.randint(2**40, (1,), generator=self._stream))
        return self._seeds

    def _with_identity(self, out: TensorDict, instructions: Sequence[str]) -> TensorDict:
        # a rollout keeps it while resets go on
        out[EPISODE] = self._seeds.to(self.device, copy=True).unsqueeze(-1)
        if list(instructions) != self.instructions or self._text is None:
            self.instructions = list(instructions)
            warn_of_cut(self.instructions)
            self._text = text_to_bytes(self.instructions).to(self.device)
        out[INSTRUCTION_UTF8] = self._text.clone()
        return out

    _text: torch.Tensor | None = None
    _observation_keys: list[Any]
