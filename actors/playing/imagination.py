"""The imagined side of a game: a learned world that begins as an episode does and takes the same actions."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import step_mdp

from envs.conditioning import PoseMapStyle, end_effector_poses, render_pose_map
from envs.geometry.kinematics import Kinematics
from envs.initial_states import InitialStates
from envs.physics.suite import Observation
from envs.specs import CHUNK, COMMAND, PROGRESS, SUCCESS, WorldSpec, to_chunk
from envs.transforms import JudgeReward


class Imagined(NamedTuple):
    """What imagination shows of some actions.

    frames uint8 [L, V, 3, H, W]; success and progress, the judge's, after the last.
    """

    frames: NDArray[np.uint8]
    success: bool
    progress: float


class ImaginedSide:
    """An episode in a learned world.

    Args:
        env: the world with its transforms, of one episode; see actors.factory.build_world.
    """

    def __init__(self, env: TransformedEnv):
        self.env, self.world = env, env.base_env
        self._judging = next(t for t in env.transform if isinstance(t, JudgeReward))
        self._now = TensorDict({}, [1])
        self.success = False

    @property
    def chunk(self) -> int:
        """Most actions of one step, K."""
        return int(self.world.chunk)

    def reset(self, starts: InitialStates | None, seed: int) -> Imagined:
        """Begin an episode; its seed is that of all noise, and says which of several starts is meant.

        Args:
            starts: None keeps those that the world has.
        """
        if starts is not None:
            self.world.starts = starts
        self.env.base_env.schedule([seed])
        self._now, self.success = self.env.reset(), False
        return Imagined(self.world.video(0)[-1:].numpy(), False, float(self._now[PROGRESS]))

    def step(self, actions: NDArray[Any]) -> Imagined:
        """Carry out commands [L, A], L at most a chunk.

        The world makes whole chunks: of fewer commands the last is repeated, and what came of the repetition
        did not happen, nor is it judged.
        """
        count, chunk = len(actions), self.chunk
        commands = torch.from_numpy(actions).float()
        whole = torch.cat([commands, commands[-1:].expand(chunk - count, -1)])[None].to(self.env.device)
        self._now[CHUNK] = to_chunk(whole, self._now[COMMAND], self.world.mode)
        self._judging.counted = count
        after = self.env.step(self._now)
        frames = self.world.video(0)[-chunk:][:count].numpy()
        self.world.session["length"] -= chunk - count
        self.success = self.success or bool(after["next", SUCCESS])
        self._now = step_mdp(after, exclude_reward=True, exclude_done=True)
        return Imagined(frames, self.success, float(self._now[PROGRESS]))

    @property
    def instruction(self) -> str:
        """What the robot is told."""
        return str(self.world.instructions[0])

    @property
    def command(self) -> NDArray[np.float64]:
        """The command [A] in force."""
        return self._now[COMMAND][0].cpu().double().numpy()


def start_of(
    spec: WorldSpec,
    observed: Observation,
    pictures: NDArray[np.uint8],
    style: PoseMapStyle,
    kinematics: Kinematics | None,
) -> InitialStates:
    """The start of an episode in physics as imagination takes it.

    Args:
        spec: what the world shows.
        observed: the suite's first observation.
        pictures: uint8 [V, 3, H, W], its first pictures.
        style, kinematics: of pose maps, as in training.
    """
    command = torch.from_numpy(observed.command).float()
    first: dict[str, Any] = {
        "frames": torch.from_numpy(pictures),
        "command": command,
        "state": torch.from_numpy(observed.state).float(),
    }
    if spec.embodiment.calibrated:
        assert observed.intrinsic is not None and observed.c2w is not None
        first["intrinsic"] = torch.from_numpy(observed.intrinsic).float().nan_to_num()
        first["c2w"] = torch.from_numpy(observed.c2w).float().nan_to_num()
    if spec.pose_map:
        poses = end_effector_poses(spec.embodiment, command[None], kinematics)
        maps = render_pose_map(poses, first["c2w"].unsqueeze(1), first["intrinsic"], spec.size, style)
        first["pose_map"] = maps[:, 0]
    rows = TensorDict({name: value[None] for name, value in first.items()}, [1])
    return InitialStates(rows, [observed.instruction])
