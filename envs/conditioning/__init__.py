"""Action conditioning as pictures: where the grippers will be (pose map) and where each pixel looks (ray
map).
"""

from envs.conditioning.pose_map import CANVAS, PoseMapStyle, render_pose_map
from envs.conditioning.ray_map import render_ray_map

__all__ = ["CANVAS", "PoseMapStyle", "render_pose_map", "render_ray_map"]
