"""Where a robot's hands go, as pixels: of every recording whose cameras are calibrated and whose commands say
poses, nobody needs to label it.

Hands go to the things that the instruction speaks of; so whoever can say where they will be seen has found
them (after the trajectory sketches of Gu et al. 2023, RT-Trajectory, which are drawn for a policy there).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from envs.conditioning import end_effector_poses
from envs.encoders.images import bells
from envs.episodes.clips import ClipStore
from envs.geometry.cameras import project
from envs.geometry.kinematics import Kinematics
from envs.geometry.rotations import fingertips
from learners.stages.simulator import last_rows, owners

CHUNKS = (1, 2, 4, 8)  # ahead; past an episode's end its last command counts
_SPREAD = 0.7  # of the target around a pixel, in cells of the encoder's finest resolution


@dataclass(frozen=True)
class Hands:
    """How commands say where fingertips are.

    Args:
        tool_offset: metres from flange to fingertip along the flange's z.
        kinematics: of a robot that is commanded by joints.
    """

    tool_offset: float
    kinematics: Kinematics | None

    def ahead(self, store: ClipStore, rows: Tensor, views: list[int]) -> Tensor | None:
        """Where fingertips will be CHUNKS chunks after frames `rows` [N], seen by the cameras of now.

        Args:
            views: numbers of the cameras.

        Returns:
            float32 [N, views, chunks * arms, 2], (u, v) as shares of width and height; NaN behind a camera.
            None if cameras are not calibrated, or commands do not say poses.
        """
        robot = store.spec.embodiment
        if not robot.calibrated or not (robot.commands_poses or self.kinematics is not None):
            return None
        last, owner = last_rows(store, rows), owners(store, rows)
        ahead = torch.stack([torch.minimum(rows + count * store.spec.chunk, last) for count in CHUNKS], 1)
        needed, place = ahead.unique(return_inverse=True)
        poses = end_effector_poses(robot, store.arrays["commands"][needed], self.kinematics)
        tips = fingertips(poses, self.tool_offset)[place].flatten(1, 2)  # [N, chunks * arms, 3]
        height, width = store.spec.size
        seen = []
        for view in views:
            pixels, depth = project(tips, store.intrinsic[owner, view], store.arrays["c2w"][rows, view])
            pixels = pixels / pixels.new_tensor((width, height))
            seen.append(torch.where(depth[..., None] > 0, pixels, torch.nan))
        return torch.stack(seen, 1)


def trace_loss(found: Tensor, hands: Tensor) -> Tensor:
    """Cross-entropy, in nats, of key-points against where hands will be; those outside a picture count
    nothing.

    Args:
        found: logits float32 [B, views, points, h, w].
        hands: [B, views, more or fewer points, 2] of `Hands.ahead`; the first of both are compared.
    """
    points = min(found.shape[2], hands.shape[2])
    found, hands = found[:, :, :points], hands[:, :, :points]
    inside = ((hands >= 0) & (hands < 1)).all(-1)  # NaN is outside
    hands = torch.where(inside[..., None], hands, 0.0)
    wanted = bells((found.shape[-2], found.shape[-1]), hands, _SPREAD).flatten(-2)
    nats = -(wanted * found.flatten(-2).log_softmax(-1)).sum(-1)
    return (nats * inside).sum() / inside.sum().clamp(min=1)
