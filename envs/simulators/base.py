"""The contract of a learned world.

A simulator is a function of explicit state: `reset` makes the state of a batch of sessions, `step` turns it
and a chunk of commands into frames, features and the next state. The state is a TensorDict with one row per
session (memory.py), so resetting some sessions is a masked write, and all randomness comes from (session
seed, chunk index).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from envs.episodes.clip_spec import ClipSpec
from envs.rng import noise_generator
from envs.simulators import memory
from envs.simulators.compiling import Repeated
from envs.specs import WorldSpec

__all__ = ["WORLD_OPTIONS", "Simulator", "noise_generator", "to_bytes"]

# Keys of a simulator's config section that belong to the world around an engine, not to the engine.
WORLD_OPTIONS = (
    "pose_map",
    "ray_map",
    "pose_map_style",
    "kinematics",
    "shared_noise",
    "bf16",
    "state_expert",
)


class Simulator(Repeated):
    """Base of all learned worlds; an engine implements `predict` and `loss`.

    Args:
        spec: what it shows of which robot.
        memory_frames: memory frames, M.
        newest_frames: of them, those that are the newest; the others are evenly spread over the past, the
            first frame included.

    Attributes:
        feature_shape: of the features that state experts read, without the batch.
        says_done: whether it learns to say in which frames a task is done; `done_head` is then there.
        hidden: names of the layers that optimisers may take for hidden ones (training/optimisers.py);
            none for all.
        per_frame_moves: whether absolute commands are told as moves since the frame before, instead of since
            the chunk began.
    """

    feature_shape: tuple[int, ...]
    says_done: bool = False
    hidden: tuple[str, ...] = ()
    per_frame_moves: bool = False

    def __init__(self, spec: WorldSpec, memory_frames: int, newest_frames: int = 1):
        super().__init__()
        self.spec, self.memory_frames, self.newest_frames = spec, memory_frames, newest_frames

    @property
    def device(self) -> torch.device:
        """Where its tensors are; the CPU, if it has none."""
        tensor = next(iter((*self.parameters(), *self.buffers())), None)
        return torch.device("cpu") if tensor is None else tensor.device

    @property
    def free_places(self) -> int | None:
        """How many more sessions it can hold now; None where nothing limits them, as here."""
        return None

    # -- what an engine gives
    def predict(self, inputs: TensorDict) -> tuple[Tensor, Tensor]:
        """Generate the frames of one chunk.

        Args:
            inputs: TensorDict [B], as memory.py and inputs.py build it, with
                memory: frames uint8 [M, V, 3, H, W], commands [M, A], and pose_map uint8 [M, V, 3, H, W],
                c2w [M, V, 4, 4] where the spec asks for them;
                future: commands [K, A], and pose_map, c2w likewise;
                now: command [A], state [S];
                intrinsic [V, 3, 3] in pixels, if cameras are calibrated;
                seed int64 [], chunk_index int64 [];
                stride int64 [], the robot's frames from one frame to the next, here and in memory.

        Returns:
            frames uint8 [B, K, V, 3, H, W] and features float32 [B, *feature_shape] for the state expert.
        """
        raise NotImplementedError

    def loss(self, clip: TensorDict, generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
        """Training loss of a clip (see episodes/clips.py) and figures to log.

        A clip of several chunks has depth float32 [], too, 0 to below 1 and the same for all: where among
        them an engine learns that learns from one of them.
        """
        raise NotImplementedError

    @classmethod
    def stepped_section(cls, section: Mapping[str, Any], steps: int) -> dict[str, Any]:
        """A config section with so many undistilled steps a chunk.

        Raises:
            ValueError: of an engine that does not denoise in steps, or not in so many.
        """
        raise ValueError(f"{cls.__name__} does not denoise in steps; choose simulator=dit, forcing or gesim")

    @classmethod
    def student_section(cls, section: Mapping[str, Any], steps: int) -> dict[str, Any]:
        """The config section of a student that takes so many steps, where `section` is the teacher's.

        Raises:
            ValueError: naming what cannot be, as of an engine that does not denoise in steps.
        """
        raise ValueError(
            f"distill.steps={steps}, but {cls.__name__} does not denoise in steps, so there is nothing to"
            " distil; set distill.steps=0, or choose simulator=dit, forcing or gesim"
        )

    @property
    def lost_in_training(self) -> str:
        """What its own loss takes from the weights, in a sentence; "" for nothing."""
        return ""

    def features(self, inputs: TensorDict) -> Tensor:
        """Only the features of `predict`, for training the state expert."""
        return self.predict(inputs)[1]

    def done_head(self) -> nn.Module:
        """A copy of what says whether the task is done: pooled features [N, D] of chunks to probabilities
        [N, K], one a frame.

        Raises:
            ValueError: of an engine that does not say it.
        """
        raise ValueError(
            f"{type(self).__name__} does not say whether a task is done; choose simulator=tokens, or"
            " judge=golden_goal"
        )

    def coded(self, frames: Tensor) -> Tensor | None:
        """Frames uint8 [B, T, V, 3, H, W] as its autoencoder keeps each of them: how sharp it can be where it
        knows everything. None of engines that have none.
        """
        return None

    def normalise(self, commands: Tensor, moves: Tensor, states: Tensor) -> None:
        """Take units from data before the first training; here there are none to take.

        Args:
            commands: [N, A].
            moves: [N, A], changes of absolute commands within a chunk, or from frame to frame where the
                engine is per_frame_moves; zeros of delta actions.
            states: [N, S].
        """

    def fit_camera_statistics(self, frames: Tensor) -> None:
        """Learn how cameras usually see, before the first training; here nothing is learned.

        Args:
            frames: uint8 [N, V, 3, H, W] of different episodes.
        """

    def recall(self, state: TensorDict, future: TensorDict) -> TensorDict:
        """Memory for the next chunk, [B, M, ...]."""
        return memory.recall(state, self.memory_frames, self.newest_frames)

    def clip_spec(self, chunks: int = 1, stride: int = 1, history: int = 0) -> ClipSpec:
        """Training clips of so many chunks, in which it remembers what sessions do; see ClipSpec."""
        return ClipSpec(self.memory_frames, self.spec.chunk, chunks, stride, history, self.newest_frames)

    def release(self, state: TensorDict, mask: Tensor) -> None:
        """The sessions of `mask` [B] end; what is held for them elsewhere can go. Here nothing is."""

    # -- the contract
    def reset(self, first: TensorDict, seed: Tensor, capacity: int = 1, stride: int = 1) -> TensorDict:
        """Begin sessions from first frames.

        Args:
            first: TensorDict [B] with frames uint8 [V, 3, H, W], command [A], state [S]; of calibrated robots
                also intrinsic [V, 3, 3] and c2w [V, 4, 4]; pose_map uint8 [V, 3, H, W] if the spec asks for
                it.
            seed: int64 [B].
            capacity: frames to keep room for, where it is known how long sessions last; longer ones make
                more.
            stride: the robot's frames from one generated frame to the next: a chunk covers so many times
                more time. Commands are then those of the frames that are shown, of changes their sums.

        Returns:
            The sessions' state, a TensorDict [B].
        """
        return self.resume(
            first.unsqueeze(1), torch.ones(len(first), dtype=torch.int64), seed, capacity, stride
        )

    def resume(
        self, past: TensorDict, length: Tensor, seed: Tensor, capacity: int = 1, stride: int = 1
    ) -> TensorDict:
        """Begin sessions that go on from recorded frames.

        Args:
            past: TensorDict [B, P] with what `reset` takes of a first frame, of every frame so far.
            length: int64 [B], how many of them there are, in 1..P.
            seed, capacity, stride: see reset; `past` has one frame in `stride`.

        Returns:
            The sessions' state, a TensorDict [B].
        """
        return memory.new_sessions(past, length, seed, capacity, stride)

    @torch.no_grad()
    def step(self, state: TensorDict, future: TensorDict) -> tuple[Tensor, Tensor, TensorDict]:
        """Advance every session by one chunk; `state` is used up, its buffers go into the one returned.

        Args:
            future: TensorDict [B] with commands [K, A], and pose_map uint8 [K, V, 3, H, W], c2w [K, V, 4, 4]
                where the spec asks for them.

        Returns:
            frames uint8 [B, K, V, 3, H, W], features [B, *feature_shape], next state. The robot's states in
            the new frames are unknown here and repeat the last; the state expert fills them in
            (`memory.write_states`).
        """
        inputs = memory.build_inputs(state, self.recall(state, future), future)
        frames, features = self.predict(inputs)
        return frames, features.float(), memory.append(state, frames, future)


def to_bytes(frames: Tensor) -> Tensor:
    """Float frames in 0..1, or somewhat beyond, as uint8."""
    # in place: these are a rollout's largest tensors
    return frames.clamp(0, 1).mul_(255).round_().to(torch.uint8)
