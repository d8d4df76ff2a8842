"""PhysicsEnv: the true world as a TorchRL environment in which one step is one chunk of actions."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase

from envs.chunked import ChunkedEnv
from envs.physics.pool import BenchPool, Track
from envs.physics.tabletop.bench import BenchConfig
from envs.specs import (
    C2W,
    CHUNK,
    COMMAND,
    IMAGE,
    INTRINSIC,
    PROGRESS,
    STATE,
    SUCCESS,
    ActionMode,
    Rewards,
    check_chunk,
    to_absolute,
)


class PhysicsEnv(ChunkedEnv):
    """A batch of MuJoCo benches; rewards and success come from the true positions.

    Args:
        config: the bench's options.
        batch: episodes side by side.
        chunk: actions per step, K.
        horizon: control steps per episode, a multiple of `chunk`.
        mode: meaning of the chunk's numbers.
        rewards: weights of progress and success.
        workers: processes; 0 means one per core.
        record: keep every frame of every episode, for `pop_tracks`.
        seed: of the stream of episode seeds.

    Examples:
        >>> env = PhysicsEnv(BenchConfig(), batch=2, chunk=8, horizon=40)
        >>> env.rollout(2)[("observation", "image")].shape
        torch.Size([2, 2, 3, 3, 64, 64])
    """

    def __init__(
        self,
        config: BenchConfig,
        batch: int,
        chunk: int,
        horizon: int,
        mode: ActionMode = ActionMode.RELATIVE,
        rewards: Rewards | None = None,
        workers: int = 0,
        record: bool = False,
        seed: int = 0,
    ):
        super().__init__(batch, chunk, horizon, len(config.views), config.size, mode, seed=seed)
        self.rewards = rewards or Rewards()
        self.record = record
        self.pool = BenchPool(config, batch, horizon, workers)
        self.tracks: deque[Track] = deque()

    def _reset(self, tensordict: TensorDictBase | None = None, **_: Any) -> TensorDictBase:
        mask = self._reset_mask(tensordict)
        slots = mask.nonzero().flatten().tolist()
        seeds = self._next_seeds(mask)
        observed = self.pool.reset({slot: int(seeds[slot]) for slot in slots}, self.record)
        self._take(observed)
        self._steps[mask] = 0
        self._last = self._observation()
        out = self._last.clone()
        for key in ("done", "terminated", "truncated"):
            out[key] = torch.zeros(self.batch_size[0], 1, dtype=torch.bool)
        return out

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        chunk = tensordict[CHUNK]
        check_chunk(chunk)
        commands = to_absolute(chunk, self._last[COMMAND], self.mode).double().numpy()
        before = self._last[PROGRESS].clone()
        was_over = self._over.clone()
        observed = self.pool.step({slot: commands[slot] for slot in range(self.batch_size[0])})
        self._take(observed)
        self._steps += self.chunk
        self._last = out = self._observation()
        success = out[SUCCESS]
        out["reward"] = self.rewards(before, out[PROGRESS], success & ~was_over)
        out["terminated"] = success.clone()
        out["truncated"] = (self._steps >= self.horizon).unsqueeze(-1) & ~success
        out["done"] = out["terminated"] | out["truncated"]
        self._over = out["done"].clone()
        self._last = out.select(*self._observation_keys)
        return out.clone()

    def _take(self, observed: dict[int, dict[str, Any]]) -> None:
        for slot, values in observed.items():
            track = values.pop("track", None)
            if track is not None:
                self.tracks.append(track)
            self._values[slot] = values
            if not values["over"]:
                self._over[slot] = False

    def _observation(self) -> TensorDict:
        rows = [self._values[slot] for slot in range(self.batch_size[0])]

        def stack(name: str) -> torch.Tensor:
            return torch.from_numpy(np.stack([row[name] for row in rows]))

        out = TensorDict({}, self.batch_size)
        out[IMAGE] = stack("image")
        out[STATE] = stack("state").float()
        out[COMMAND] = stack("command").float()
        out[INTRINSIC] = stack("intrinsic").float()
        out[C2W] = stack("c2w").float()
        out[SUCCESS] = stack("success").unsqueeze(-1)
        out[PROGRESS] = stack("progress").float().unsqueeze(-1)
        return self._with_identity(out, [row["instruction"] for row in rows])

    def pop_tracks(self) -> list[Track]:
        """Finished recorded episodes since the last call, sorted by seed."""
        tracks = sorted(self.tracks, key=lambda track: track.seed)
        self.tracks.clear()
        return tracks

    def close(self, *, raise_if_closed: bool = True) -> None:
        """End the worker processes."""
        self.pool.close()
        if not self.is_closed:
            super().close(raise_if_closed=raise_if_closed)
