"""What both worlds share: one step is one chunk, the specs of VLA observations, and seeded queues of
episodes.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from envs.language import VOCABULARY, WORDS, tokenize
from envs.specs import ACTION_DIM, EPISODE, STATE_DIM, TOKENS, ActionMode


class ChunkedEnv(EnvBase):
    """Base of PhysicsEnv and WorldEnv: a batched environment with the same specs in truth and in imagination.

    Every episode has a seed. Seeds come from the queue filled by `schedule`, and when it is empty from a
    stream
    of their own; what happens in an episode depends on its seed and on the actions only.

    Args:
        batch: episodes side by side, B.
        chunk: actions per step, K.
        horizon: control steps per episode, a multiple of `chunk`.
        views: number of cameras, V.
        size: (height, width) of every view.
        mode: meaning of the chunk's numbers.
        device: where observations live.
        seed: of the stream of episode seeds.
        states, actions: numbers of a state and of an action; worlds of another robot say so.

    Raises:
        ValueError: if the horizon is not a multiple of the chunk.
    """

    def __init__(
        self,
        batch: int,
        chunk: int,
        horizon: int,
        views: int,
        size: tuple[int, int],
        mode: ActionMode,
        device: torch.device | str = "cpu",
        seed: int = 0,
        states: int = STATE_DIM,
        actions: int = ACTION_DIM,
    ):
        if horizon % chunk:
            raise ValueError(f"task.horizon={horizon} must be a multiple of task.chunk={chunk}")
        super().__init__(device=torch.device(device), batch_size=torch.Size([batch]))
        self.chunk, self.horizon, self.mode = chunk, horizon, ActionMode(mode)
        self._stream = torch.Generator().manual_seed(seed)
        self._queue: deque[int] = deque()
        self._seeds = torch.zeros(batch, dtype=torch.int64)
        self._steps = torch.zeros(batch, dtype=torch.int64)
        self._over = torch.ones(batch, 1, dtype=torch.bool)
        self._values: dict[int, dict[str, Any]] = {}
        # Words stay outside the rollout, which carries their tokens: stacks of strings break TorchRL's
        # stacking by device.
        self.instructions: list[str] = [""] * batch
        shape = (batch,)
        height, width = size
        self.observation_spec = Composite(
            observation=Composite(
                image=Bounded(0, 255, (*shape, views, 3, height, width), dtype=torch.uint8),
                state=Unbounded((*shape, states)),
                command=Unbounded((*shape, actions)),
                tokens=Bounded(0, VOCABULARY - 1, (*shape, WORDS), dtype=torch.int64),
                shape=shape,
            ),
            camera=Composite(
                intrinsic=Unbounded((*shape, views, 3, 3)),
                c2w=Unbounded((*shape, views, 4, 4)),
                shape=shape,
            ),
            success=Binary(1, (*shape, 1), dtype=torch.bool),
            progress=Bounded(0.0, 1.0, (*shape, 1)),
            episode_seed=Unbounded((*shape, 1), dtype=torch.int64),
            shape=shape,
            device=device,
        )
        self._observation_keys = list(self.observation_spec.keys(True, True))
        # A spec must be bounded to be sampled from; a metre or a radian per chunk is beyond what any arm
        # does.
        self.action_spec = Composite(
            vla_action=Composite(chunk=Bounded(-1.0, 1.0, (*shape, chunk, actions)), shape=shape),
            shape=shape,
            device=device,
        )
        self.reward_spec = Unbounded((*shape, 1), device=device)
        flag = Categorical(2, (*shape, 1), dtype=torch.bool, device=device)
        self.done_spec = Composite(
            done=flag, terminated=flag.clone(), truncated=flag.clone(), shape=shape, device=device
        )

    def schedule(self, seeds: Iterable[int]) -> None:
        """Queue episode seeds; resets take them in order, lowest slot first. Replaces what was queued.

        Once they are used up, further ones are drawn, and they too depend on nothing but `seeds`.
        """
        self._queue = deque(int(seed) for seed in seeds)
        if self._queue:
            self._stream.manual_seed(hash(tuple(self._queue)) & 0x7FFF_FFFF)

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            self._stream.manual_seed(seed)

    def _reset_mask(self, tensordict: TensorDictBase | None) -> torch.Tensor:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is None:
            return torch.ones(self.batch_size[0], dtype=torch.bool)
        return mask.reshape(self.batch_size[0], -1).any(-1).cpu()

    def _next_seeds(self, mask: torch.Tensor) -> torch.Tensor:
        for slot in mask.nonzero().flatten().tolist():
            if self._queue:
                self._seeds[slot] = self._queue.popleft()
            else:
                self._seeds[slot] = int(torch.randint(2**40, (1,), generator=self._stream))
        return self._seeds

    def _with_identity(self, out: TensorDict, instructions: Sequence[str]) -> TensorDict:
        # a rollout keeps it while resets go on
        out[EPISODE] = self._seeds.to(self.device, copy=True).unsqueeze(-1)
        out[TOKENS] = torch.stack([tokenize(text) for text in instructions]).to(self.device)
        self.instructions = list(instructions)
        return out
