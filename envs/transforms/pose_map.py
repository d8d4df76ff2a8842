"""The inverse path: a policy's chunk becomes absolute commands, cameras to come, and their pose map."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite, TensorSpec
from torchrl.envs import Transform

from envs.conditioning import PoseMapStyle, render_pose_map
from envs.geometry.cameras import follow_hands, hands_of
from envs.geometry.kinematics import Kinematics, KinematicsError
from envs.layouts import CommandLayout, JointLayout, Joints
from envs.specs import C2W, CHUNK, CHUNK_C2W, COMMAND, COMMANDS, INTRINSIC, POSE_MAP, check_chunk, to_absolute


class PoseMapTransform(Transform):
    """Draws the commanded grippers into every camera of WorldEnv; wrist cameras move with the commands.

    Args:
        views: names of the cameras, in order.
        style: how pose maps are drawn; must be that of training.
        kinematics: of the robot, for worlds that take joint commands.
    """

    def __init__(
        self, views: tuple[str, ...], style: PoseMapStyle | None = None, kinematics: Kinematics | None = None
    ):
        super().__init__(in_keys_inv=[COMMANDS, POSE_MAP, CHUNK_C2W], out_keys_inv=[CHUNK])
        self.hands, self.style, self.kinematics = hands_of(views), style, kinematics

    def _flanges(self, commands: Tensor, layout: CommandLayout) -> Tensor:
        """End-effector poses [..., 14] of commands of any layout."""
        if layout is CommandLayout.EEF:
            return commands
        if self.kinematics is None:
            raise KinematicsError(
                "simulator.layout=joints needs simulator.kinematics, which says where joints put the hands"
            )
        return self.kinematics.flanges(Joints(commands, JointLayout.PER_ARM))

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        chunk = tensordict[CHUNK]
        world = self.parent.base_env
        layout = world.simulator.shape.layout
        check_chunk(chunk, layout)
        command, device = tensordict[COMMAND], chunk.device
        commands = to_absolute(chunk, command, world.mode)
        flanges = self._flanges(commands, layout)
        c2w = follow_hands(tensordict[C2W], self._flanges(command, layout), flanges, self.hands)
        maps = render_pose_map(
            flanges.cpu(),
            c2w.transpose(1, 2).cpu(),
            tensordict[INTRINSIC].cpu(),
            world.simulator.shape.size,
            style=self.style,
        )
        tensordict[COMMANDS] = commands
        tensordict[CHUNK_C2W] = c2w
        tensordict[POSE_MAP] = maps.transpose(1, 2).contiguous().to(device)
        return tensordict

    def transform_input_spec(self, input_spec: TensorSpec) -> TensorSpec:
        """The policy's action replaces the conditioning in the specs."""
        action: Composite = input_spec["full_action_spec"]
        lead = action.shape
        device, (chunk, width) = action.device, action[COMMANDS].shape[-2:]
        for key in (COMMANDS, POSE_MAP, CHUNK_C2W):
            del action[key]
        action["vla_action"] = Composite(
            chunk=Bounded(-1.0, 1.0, (*lead, chunk, width), device=device, dtype=torch.float32),
            shape=lead,
            device=device,
        )
        return input_spec
