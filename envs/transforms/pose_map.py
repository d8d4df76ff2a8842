"""The inverse path: a policy's chunk becomes absolute commands, cameras to come, and their pose map."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torchrl.data import Bounded, Composite, TensorSpec
from torchrl.envs import Transform

from envs.conditioning import PoseMapStyle, render_pose_map
from envs.geometry import follow_hands, hands_of
from envs.schema import ACTION_DIM, C2W, CHUNK, CHUNK_C2W, COMMAND, COMMANDS, INTRINSIC, POSE_MAP, check_chunk, to_absolute


class PoseMapTransform(Transform):
    """Draws the commanded grippers into every camera of WorldEnv; wrist cameras move with the commands.

    Args:
        views: names of the cameras, in order.
        style: how pose maps are drawn; must be that of training.
    """

    def __init__(self, views: tuple[str, ...], style: PoseMapStyle | None = None):
        super().__init__(in_keys_inv=[COMMANDS, POSE_MAP, CHUNK_C2W], out_keys_inv=[CHUNK])
        self.hands, self.style = hands_of(views), style

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        chunk = tensordict[CHUNK]
        check_chunk(chunk)
        world = self.parent.base_env
        command, device = tensordict[COMMAND], chunk.device
        commands = to_absolute(chunk, command, world.mode)
        c2w = follow_hands(tensordict[C2W], command, commands, self.hands)
        maps = render_pose_map(commands.cpu(), c2w.transpose(1, 2).cpu(), tensordict[INTRINSIC].cpu(), world.simulator.shape.size, style=self.style)
        tensordict[COMMANDS] = commands
        tensordict[CHUNK_C2W] = c2w
        tensordict[POSE_MAP] = maps.transpose(1, 2).contiguous().to(device)
        return tensordict

    def transform_input_spec(self, input_spec: TensorSpec) -> TensorSpec:
        """The policy's action replaces the conditioning in the specs."""
        action: Composite = input_spec["full_action_spec"]
        lead = action.shape
        chunk = action[COMMANDS].shape[-2]
        device = action.device
        for key in (COMMANDS, POSE_MAP, CHUNK_C2W):
            del action[key]
        action["vla_action"] = Composite(chunk=Bounded(-1.0, 1.0, (*lead, chunk, ACTION_DIM), device=device, dtype=torch.float32), shape=lead, device=device)
        return input_spec
