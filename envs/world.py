"""WorldEnv: any Simulator behind the contract of PhysicsEnv. Frames are generated in `_step`.

The bare environment takes conditioning (commands, pose map, cameras) and knows neither joint states nor
rewards;
the transforms of envs/transforms add them: TransformedEnv(WorldEnv(...), world_transforms(...)).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite, Unbounded

from envs.chunked import ChunkedEnv
from envs.episodes.clips import ClipStore
from envs.precision import mixed_precision
from envs.simulators.base import Simulator
from envs.specs import (
    C2W,
    CHUNK_C2W,
    COMMAND,
    COMMANDS,
    FEATURES,
    FRAMES,
    IMAGE,
    INTRINSIC,
    POSE_MAP,
    PROGRESS,
    STATE,
    SUCCESS,
    ActionMode,
)


@dataclass
class InitialStates:
    """First frames of recorded episodes, from which imagined ones begin; N rows.

    image and pose_map uint8 [N, V, 3, H, W], state [N, 16], command [N, A], intrinsic [N, V, 3, 3], c2w [N,
    V, 4, 4].
    """

    image: Tensor
    pose_map: Tensor
    state: Tensor
    command: Tensor
    intrinsic: Tensor
    c2w: Tensor
    instructions: list[str]
    views: tuple[str, ...]

    @classmethod
    def of(cls, store: ClipStore, episodes: Tensor | None = None) -> InitialStates:
        """The first frames of the given episodes of a store, of all by default."""
        chosen = torch.arange(len(store)) if episodes is None else episodes
        rows = store.start[chosen]
        return cls(
            image=store.frames(rows),
            pose_map=store.pose_maps(rows),
            state=store.arrays["states"][rows],
            command=store.arrays["commands"][rows],
            intrinsic=store.intrinsic[chosen],
            c2w=store.arrays["c2w"][rows],
            instructions=[store.episodes[n]["instruction"] for n in chosen.tolist()],
            views=store.views,
        )

    def __len__(self) -> int:
        return len(self.instructions)


class WorldEnv(ChunkedEnv):
    """A batch of imagined episodes.

    An episode's seed says where it begins (seed modulo the number of starts) and, with the chunk's index, all
    its
    noise: it is the same in any slot, batch or process. Seeds that differ by a multiple of the number of
    starts
    begin alike and differ in noise, unless `shared_noise` makes them alike in that too.

    Args:
        simulator: the learned world, already on its device.
        starts: first frames.
        batch: episodes side by side.
        horizon: control steps per episode.
        mode: meaning of a chunk's numbers, used by the pose-map transform.
        shared_noise: let the episodes of a group meet the same noise.
        bf16: generate in bfloat16 where the device computes in it.
        seed: of the stream of episode seeds.

    Raises:
        ValueError: if starts and simulator do not show the same views.
    """

    def __init__(
        self,
        simulator: Simulator,
        starts: InitialStates,
        batch: int,
        horizon: int,
        mode: ActionMode = ActionMode.RELATIVE,
        shared_noise: bool = False,
        bf16: bool = True,
        seed: int = 0,
    ):
        shape = simulator.shape
        if tuple(starts.image.shape[1:]) != (shape.views, 3, *shape.size):
            raise ValueError(
                f"starts show {tuple(starts.image.shape[1:])}, the simulator {(shape.views, 3, *shape.size)}; train it on these views"
            )
        device = next(simulator.parameters()).device
        super().__init__(
            batch,
            shape.chunk,
            horizon,
            shape.views,
            shape.size,
            mode,
            device,
            seed,
            actions=shape.layout.size,
        )
        self.simulator, self.starts, self.shared_noise, self.bf16 = simulator, starts, shared_noise, bf16
        self.session: TensorDict | None = None
        pictures = (batch, shape.chunk, shape.views, 3, *shape.size)
        self.observation_spec["world"] = Composite(
            frames=Bounded(0, 255, pictures, dtype=torch.uint8),
            features=Unbounded((batch, *simulator.feature_shape)),
            shape=(batch,),
            device=device,
        )
        self.action_spec = Composite(
            {
                COMMANDS: Unbounded((batch, shape.chunk, shape.layout.size)),
                POSE_MAP: Bounded(0, 255, pictures, dtype=torch.uint8),
                CHUNK_C2W: Unbounded((batch, shape.chunk, shape.views, 4, 4)),
            },
            shape=(batch,),
            device=device,
        )

    def _reset(self, tensordict: TensorDictBase | None = None, **_: Any) -> TensorDictBase:
        mask = self._reset_mask(tensordict)
        seeds = self._next_seeds(mask)[mask]
        start = seeds % len(self.starts)
        names = {
            "frames": "image",
            "intrinsic": "intrinsic",
            "c2w": "c2w",
            "command": "command",
            "state": "state",
            "pose_map": "pose_map",
        }
        begin = {key: getattr(self.starts, name)[start].to(self.device) for key, name in names.items()}
        noise = start if self.shared_noise else seeds
        if self.session is not None:
            self.simulator.release(self.session, mask)
        fresh = self.simulator.reset(**begin, seed=noise.to(self.device), capacity=self.horizon + 1)
        if self.session is None or mask.all():
            self.session = fresh
        else:
            self.session = self.simulator.replace(self.session, mask.to(self.device), fresh)
        self._steps[mask] = 0
        self._over[mask] = False
        batch, shape = self.batch_size[0], self.simulator.shape
        out = self._observe()
        out[FRAMES] = torch.zeros(
            batch, shape.chunk, shape.views, 3, *shape.size, dtype=torch.uint8, device=self.device
        )
        out[FEATURES] = torch.zeros(batch, *self.simulator.feature_shape, device=self.device)
        for key in ("done", "terminated", "truncated"):
            out[key] = torch.zeros(batch, 1, dtype=torch.bool, device=self.device)
        return out

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        assert self.session is not None
        with mixed_precision(self.device, self.bf16):
            frames, features, self.session = self.simulator.step(
                self.session, tensordict[COMMANDS], tensordict[POSE_MAP], tensordict[CHUNK_C2W]
            )
        self._steps += self.chunk
        out = self._observe()
        out[FRAMES], out[FEATURES] = frames, features
        batch = self.batch_size[0]
        out["reward"] = torch.zeros(batch, 1, device=self.device)
        out["terminated"] = torch.zeros(batch, 1, dtype=torch.bool, device=self.device)
        out["truncated"] = (self._steps >= self.horizon).unsqueeze(-1).to(self.device)
        out["done"] = out["truncated"].clone()
        return out

    def _observe(self) -> TensorDict:
        assert self.session is not None
        batch = self.batch_size[0]
        rows = torch.arange(batch, device=self.device)
        now = self.session["history"][rows, self.session["length"] - 1]
        out = TensorDict({}, self.batch_size, device=self.device)
        out[IMAGE] = now["frames"]
        out[STATE] = now["states"].float()
        out[COMMAND] = now["commands"]
        out[INTRINSIC] = self.session["intrinsic"]
        out[C2W] = now["c2w"]
        out[SUCCESS] = torch.zeros(batch, 1, dtype=torch.bool, device=self.device)
        out[PROGRESS] = torch.zeros(batch, 1, device=self.device)
        return self._with_identity(
            out, [self.starts.instructions[int(s)] for s in self._seeds % len(self.starts)]
        )

    def video(self, slot: int) -> Tensor:
        """All frames of the episode in a slot so far, uint8 [T, V, 3, H, W], the first being real."""
        assert self.session is not None
        return self.session["history", "frames"][slot, : int(self.session["length"][slot])].cpu()
