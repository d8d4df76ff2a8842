"""PhysicsEnv: the true world as a TorchRL environment in which one step is one chunk of actions."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary

from envs.chunked import ChunkedEnv
from envs.physics.pool import PoolError, TaskPool, Track
from envs.specs import (
    C2W,
    CHUNK,
    COMMAND,
    IMAGE,
    INTRINSIC,
    LOST,
    PROGRESS,
    STATE,
    SUCCESS,
    ActionMode,
    Rewards,
    WorldSpec,
    check_chunk,
    to_commands,
)


class PhysicsEnv(ChunkedEnv):
    """A batch of true episodes; rewards and success come from the suite.

    An episode that the pool gives up is LOST, and ends with the observation before.

    Args:
        pool: a slot per episode side by side, B of them, which this world then owns; the suite's cameras must
            have the spec's size, and the pool's horizon be a multiple of K.
        spec: robot, size of the views, actions per step K.
        mode: meaning of the chunk's numbers.
        rewards: weights of true progress and success.
        record: keep every frame of every episode, for `pop_tracks`.
        seed: of the stream of episode seeds.

    Examples:
        >>> pool = TaskPool(cfg.task.suite, "push", slots=2, horizon=40, workers=1)
        >>> env = PhysicsEnv(pool, spec, ActionMode.RELATIVE, Rewards(progress=1.0, success=1.0))
        >>> env.rollout(2)[IMAGE].shape  # [B, T, V, 3, H, W]
        torch.Size([2, 2, 3, 3, 64, 64])
    """

    def __init__(
        self,
        pool: TaskPool,
        spec: WorldSpec,
        mode: ActionMode,
        rewards: Rewards,
        record: bool = False,
        seed: int = 0,
    ):
        try:
            super().__init__(spec, pool.slots, pool.horizon, mode, seed=seed)
        except BaseException:
            pool.close()
            raise
        self.pool, self.rewards, self.record = pool, rewards, record
        self.tracks: deque[tuple[int, Track]] = deque()  # and the slots that they were played in
        self._rows: dict[int, dict[str, Any]] = {}
        self._lost = torch.zeros(pool.slots, 1, dtype=torch.bool)

    def _set_specs(self) -> None:
        super()._set_specs()
        self.observation_spec[LOST] = Binary(1, (*self.batch_size, 1), dtype=torch.bool)
        self._observation_keys.append(LOST)

    def _reset(self, tensordict: TensorDictBase | None = None, **_: Any) -> TensorDictBase:
        mask = self._reset_mask(tensordict)
        seeds = self._next_seeds(mask)
        slots = mask.nonzero().flatten().tolist()
        self._lost[mask] = False
        self._take(self.pool.reset({slot: int(seeds[slot]) for slot in slots}, self.record), slots)
        if not self._rows:
            raise PoolError(f"physics crashes at the start of the episodes of seeds {seeds[slots].tolist()}")
        for slot in slots:  # another's picture stands for an episode that has none
            self._rows.setdefault(slot, next(iter(self._rows.values())))
        self._check(self._rows[slots[0]])
        self._steps[mask] = 0
        self._over[mask] = False
        self._last = self._observation()
        out = self._last.clone()
        for key in ("done", "terminated", "truncated"):
            out[key] = torch.zeros(self.batch_size[0], 1, dtype=torch.bool)
        return out

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        chunk = tensordict[CHUNK]
        check_chunk(chunk, self.spec.embodiment)
        commands = to_commands(chunk.detach().cpu(), self._last[COMMAND], self.mode).double().numpy()
        before, was_over = self._last[PROGRESS], self._over
        slots = (~self._lost).flatten().nonzero().flatten().tolist()
        self._take(self.pool.step({slot: commands[slot] for slot in slots}), slots)
        self._steps += self.spec.chunk
        self._last = self._observation()
        out = self._last.clone()
        success = out[SUCCESS]
        out["reward"] = self.rewards(before, out[PROGRESS], success & ~was_over)
        out["terminated"] = success.clone()
        out["truncated"] = ((self._steps >= self.horizon).unsqueeze(-1) | self._lost) & ~success
        out["done"] = out["terminated"] | out["truncated"]
        self._over = out["done"].clone()
        return out

    def _check(self, row: Mapping[str, Any]) -> None:
        spec = self.spec
        due = {
            "image": (spec.views, 3, *spec.size),
            "state": (spec.state_dim,),
            "command": (spec.action_dim,),
        }
        for name, shape in due.items():
            if row[name].shape != shape:
                raise ValueError(
                    f"the task suite gives {name} {row[name].shape}, the world's spec says {shape}; build the"
                    " spec from this suite's embodiment, with task.size equal to task.suite.size"
                )

    def _take(self, observed: dict[int, dict[str, Any]], slots: Sequence[int]) -> None:
        """Keep what the pool says of these slots."""
        for slot in slots:
            self._lost[slot] = slot not in observed
        for slot, values in observed.items():
            track = values.pop("track", None)
            if track is not None:
                self.tracks.append((slot, track))
            self._rows[slot] = values

    def _observation(self) -> TensorDict:
        rows = [self._rows[slot] for slot in range(self.batch_size[0])]

        def stack(name: str) -> torch.Tensor:
            return torch.from_numpy(np.stack([row[name] for row in rows]))

        out = TensorDict({}, self.batch_size)
        out[IMAGE] = stack("image")
        out[STATE] = stack("state").float()
        out[COMMAND] = stack("command").float()
        if self.spec.embodiment.calibrated:
            out[INTRINSIC] = stack("intrinsic").float().nan_to_num()
            out[C2W] = stack("c2w").float().nan_to_num()
        out[LOST] = self._lost.clone()
        out[SUCCESS] = stack("success").unsqueeze(-1) & ~self._lost
        out[PROGRESS] = stack("progress").float().unsqueeze(-1)
        return self._with_identity(out, [row["instruction"] for row in rows])

    def pop_tracks(self) -> list[Track]:
        """Finished recorded episodes since the last call, sorted by seed; of those of one seed, by slot."""
        played = sorted(self.tracks, key=lambda one: (one[1].seed, one[0]))
        self.tracks.clear()
        return [track for _, track in played]

    def close(self, *, raise_if_closed: bool = True) -> None:
        """End the worker processes."""
        self.pool.close()
        if not self.is_closed:
            super().close(raise_if_closed=raise_if_closed)
