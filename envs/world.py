"""WorldEnv: any Simulator behind the contract of PhysicsEnv. Frames are generated in `_step`.

The bare environment takes commands with their conditioning (pose maps, cameras) and knows neither the robot's
states nor rewards; the transforms of envs/transforms add them: TransformedEnv(WorldEnv(...),
world_transforms(...)).
"""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Bounded, Composite, Unbounded

from envs.chunked import ChunkedEnv
from envs.initial_states import InitialStates
from envs.precision import mixed_precision
from envs.simulators import memory
from envs.simulators.base import Simulator
from envs.simulators.features import features_of_sessions
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


class WorldEnv(ChunkedEnv):
    """A batch of imagined episodes.

    An episode's seed says where it begins (seed modulo the number of initial states) and, with the chunk's
    index, all its noise: it is the same in any slot, batch or process. Seeds that differ by a multiple of the
    number of initial states begin alike and differ in noise, unless `shared_noise` makes them alike in that
    too.

    Args:
        simulator: the learned world, already on its device.
        starts: initial states.
        batch: episodes side by side.
        horizon: control steps per episode.
        mode: meaning of a chunk's numbers, used by the action-decoding transform.
        shared_noise: let the episodes of a group meet the same noise.
        bf16: generate in bfloat16 where the device computes in it.
        seed: of the stream of episode seeds.

    Raises:
        ValueError: if initial states and simulator do not show the same views.
    """

    def __init__(
        self,
        simulator: Simulator,
        starts: InitialStates,
        batch: int,
        horizon: int,
        mode: ActionMode,
        *,
        shared_noise: bool,
        bf16: bool,
        seed: int = 0,
    ):
        spec, device = simulator.spec, simulator.device
        shown, wanted = starts.shown, (spec.views, 3, *spec.size)
        if shown != wanted:
            raise ValueError(f"initial states show {shown}, the simulator {wanted}; train it on these views")
        super().__init__(spec, batch, horizon, mode, device, seed)
        self.simulator, self.starts, self.shared_noise, self.bf16 = simulator, starts, shared_noise, bf16
        self.session: TensorDict | None = None
        pictures = (batch, spec.chunk, spec.views, 3, *spec.size)
        features = Unbounded((batch, *simulator.feature_shape))
        self.observation_spec["world"] = Composite(
            frames=Bounded(0, 255, pictures, dtype=torch.uint8),
            features=features,
            shape=(batch,),
        ).to(device)
        action: dict[str, Any] = {COMMANDS: Unbounded((batch, spec.chunk, spec.action_dim))}
        if spec.pose_map:
            action[POSE_MAP] = Bounded(0, 255, pictures, dtype=torch.uint8)
        if spec.embodiment.calibrated:
            action[CHUNK_C2W] = Unbounded((batch, spec.chunk, spec.views, 4, 4))
        self.action_spec = Composite(action, shape=(batch,)).to(device)

    def _reset(self, tensordict: TensorDictBase | None = None, **_: Any) -> TensorDictBase:
        mask = self._reset_mask(tensordict)
        seeds = self._next_seeds(mask)[mask]
        start = seeds % len(self.starts)
        room = self.starts.longest + self.horizon
        past, length = self.starts.past(start, room)
        if self.session is not None:
            self.simulator.release(self.session, mask)
        noise = (start if self.shared_noise else seeds).to(self.device)
        begun = self.simulator.resume(past.to(self.device), length.to(self.device), noise, room)
        if self.session is None or mask.all():
            self.session = begun
        else:
            self.session = memory.replace(self.session, mask.to(self.device), begun)
        self._steps[mask] = 0
        batch, spec = self.batch_size[0], self.spec
        out = self._observe()
        frames = (batch, spec.chunk, spec.views, 3, *spec.size)
        out[FRAMES] = torch.zeros(frames, dtype=torch.uint8, device=self.device)
        out[FEATURES] = torch.zeros(batch, *self.simulator.feature_shape, device=self.device)
        for key in ("done", "terminated", "truncated"):
            out[key] = torch.zeros(batch, 1, dtype=torch.bool, device=self.device)
        return out

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        assert self.session is not None
        names = {"commands": COMMANDS, "pose_map": POSE_MAP, "c2w": CHUNK_C2W}
        given = {name: tensordict[key] for name, key in names.items() if key in tensordict.keys()}
        future = TensorDict(given, self.batch_size)
        with mixed_precision(self.device, self.bf16):
            frames, features, self.session = self.simulator.step(self.session, future)
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
        now = memory.newest(self.session)
        out = TensorDict({}, self.batch_size, device=self.device)
        out[IMAGE], out[STATE], out[COMMAND] = now["frames"], now["states"], now["commands"]
        if self.spec.embodiment.calibrated:
            out[INTRINSIC], out[C2W] = self.session["intrinsic"], now["c2w"]
        out[SUCCESS] = torch.zeros(batch, 1, dtype=torch.bool, device=self.device)
        out[PROGRESS] = torch.zeros(batch, 1, device=self.device)
        return self._with_identity(
            out, [self.starts.instructions[int(s)] for s in self._seeds % len(self.starts)]
        )

    @property
    def opening(self) -> torch.Tensor:
        """The frames with which episodes began, uint8 [B, V, 3, H, W], even where imagination took over
        later.
        """
        assert self.session is not None
        return self.session["history", "frames"][:, 0]

    def features_now(self) -> torch.Tensor:
        """Pooled features float32 [B, D] of where episodes are, for judges that read features: of a chunk
        that would change nothing.
        """
        assert self.session is not None
        with mixed_precision(self.device, self.bf16):
            return features_of_sessions(self.simulator, self.session)

    def video(self, slot: int) -> torch.Tensor:
        """All frames of the episode in a slot so far, uint8 [T, V, 3, H, W], the first ones real."""
        assert self.session is not None
        return self.session["history", "frames"][slot, : int(self.session["length"][slot])].cpu()
