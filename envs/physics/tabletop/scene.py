"""The bench's robot as a file, robot.xml, and the numbers of it that code needs.

World frame: x forward from the robot, y to its left, z up; the table top is z = 0; metres and radians.
The end-effector frame of an arm is its flange: z points along the gripper.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from envs.embodiment import Robot

ROBOT_FILE = Path(__file__).with_name("robot.xml")
ARMS = ("left", "right")
JOINTS = tuple(tuple(f"{arm}_joint{k}" for k in range(1, 8)) for arm in ARMS)
FLANGES = tuple(f"{arm}_flange" for arm in ARMS)
CAMERAS = {"head": None, "hand_left": "left", "hand_right": "right"}  # and the arm each is mounted on
TOOL_OFFSET = 0.15  # m from the flange to the fingertips, along the flange's z
FINGER_TRAVEL = 0.035  # m each finger moves from closed (gripper = 1) to open (gripper = 0)
HOME = np.array([0.0, -0.35, 0.0, 2.1, 0.0, np.pi - 1.75, 0.0])  # joint posture the IK null space prefers
BASE = {"left": (-0.28, 0.36), "right": (-0.28, -0.36)}
SHOULDER = 0.32  # m above the table at which an arm's second joint turns, over its base
WRIST = 0.08  # m from the sixth joint to the flange, along the flange's z
# m from shoulder to wrist that commands may ask for; at 0.80 the elbow is straight, and arms jerk or jam
REACH = 0.78
TIP_HEIGHT = 0.020  # m above the table at which fingertips travel


def kinematic_description() -> Robot:
    """The robot's file and names, for forward kinematics of joint commands."""
    return Robot(model=str(ROBOT_FILE), joints=JOINTS, flanges=FLANGES, held={})
