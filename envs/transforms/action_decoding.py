"""The inverse path: a policy's chunk becomes commands and what the world is told beside them: cameras, pose
maps.
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torchrl.data import Bounded, Composite, TensorSpec
from torchrl.envs import Transform

from envs.conditioning import PoseMapStyle, end_effector_poses, render_pose_map
from envs.embodiment import EmbodimentError
from envs.geometry.cameras import follow_wrists
from envs.geometry.kinematics import Kinematics
from envs.specs import (
    C2W,
    CHUNK,
    CHUNK_C2W,
    COMMAND,
    COMMANDS,
    INTRINSIC,
    POSE_MAP,
    WorldSpec,
    check_chunk,
    to_commands,
)


class ActionDecoding(Transform):
    """Decodes chunks for WorldEnv: wrist cameras move with commanded flanges, which pose maps show.

    Where commands do not say where flanges will be, cameras stay where they are.

    Args:
        spec: what the world shows.
        style: how pose maps are drawn; must be that of training.
        kinematics: of the robot, for joint commands.
    """

    def __init__(
        self, spec: WorldSpec, style: PoseMapStyle | None = None, kinematics: Kinematics | None = None
    ):
        keys = [
            COMMANDS,
            *([POSE_MAP] if spec.pose_map else []),
            *([CHUNK_C2W] if spec.embodiment.calibrated else []),
        ]
        super().__init__(in_keys_inv=keys, out_keys_inv=[CHUNK])
        if spec.pose_map and not spec.embodiment.commands_poses:
            raise EmbodimentError(
                f"commands of {spec.embodiment.robot} do not say where its flanges will be, so an imagined"
                " world cannot draw pose maps; name the robot's model by simulator.kinematics"
            )
        self.spec, self.style, self.kinematics = spec, style, kinematics

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        chunk, command, spec = tensordict[CHUNK], tensordict[COMMAND], self.spec
        check_chunk(chunk, spec.embodiment)
        commands = to_commands(chunk, command, self.parent.base_env.mode)
        tensordict[COMMANDS] = commands
        if not spec.embodiment.calibrated:
            return tensordict
        c2w = tensordict[C2W]
        if not spec.embodiment.commands_poses:
            tensordict[CHUNK_C2W] = c2w.unsqueeze(1).expand(-1, commands.shape[1], -1, -1, -1).contiguous()
            return tensordict
        both = torch.cat((command.unsqueeze(1), commands), 1)
        poses = end_effector_poses(spec.embodiment, both, self.kinematics)
        ahead = follow_wrists(c2w, poses[:, 0], poses[:, 1:], spec.embodiment.wrists)
        tensordict[CHUNK_C2W] = ahead
        if spec.pose_map:
            seen = (poses[:, 1:].cpu(), ahead.transpose(1, 2).cpu(), tensordict[INTRINSIC].cpu())
            maps = render_pose_map(*seen, spec.size, self.style)
            tensordict[POSE_MAP] = maps.transpose(1, 2).contiguous().to(chunk.device)
        return tensordict

    def transform_input_spec(self, input_spec: TensorSpec) -> TensorSpec:
        """The policy's action replaces the conditioned commands in the specs."""
        action: Composite = input_spec["full_action_spec"]
        lead, device = action.shape, action.device
        chunk, width = action[COMMANDS].shape[-2:]
        for key in self.in_keys_inv:
            del action[key]
        # A spec must be bounded to be sampled from; a metre or a radian per chunk is beyond what any arm
        # does.
        bounded = Bounded(-1.0, 1.0, (*lead, chunk, width), device=device, dtype=torch.float32)
        action["vla_action"] = Composite(chunk=bounded, shape=lead, device=device)
        return input_spec
