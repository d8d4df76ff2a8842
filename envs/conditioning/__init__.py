"""Action conditioning: pose maps, ray maps, action vectors; whatever the embodiment allows."""

from envs.conditioning.action_text import ActionText
from envs.conditioning.action_vector import ActionVector
from envs.conditioning.pace import Pace
from envs.conditioning.pose_map import (
    CANVAS,
    PoseMapStyle,
    pose_map_cells,
    pose_map_channels,
    render_pose_map,
)
from envs.conditioning.poses import end_effector_poses
from envs.conditioning.ray_map import render_ray_map

__all__ = [
    "CANVAS",
    "ActionText",
    "ActionVector",
    "Pace",
    "PoseMapStyle",
    "end_effector_poses",
    "pose_map_cells",
    "pose_map_channels",
    "render_pose_map",
    "render_ray_map",
]
