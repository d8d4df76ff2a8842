"""The bench as MJCF: a table, two 7-DoF arms with parallel grippers, a head camera and two wrist cameras.

World frame: x forward from the robot, y to its left, z up; the table top is z = 0; metres and radians.
The end-effector frame of an arm is its flange: z points along the gripper, the fingertips lie at z =
TOOL_OFFSET.
"""

from __future__ import annotations

import numpy as np

TOOL_OFFSET = 0.15  # m from the flange to the fingertips, along the flange's z
ARMS = ("left", "right")
VIEWS = ("head", "hand_left", "hand_right")
FINGER_TRAVEL = 0.035  # m each finger moves from closed (gripper = 1) to open (gripper = 0)
HOME = np.array([0.0, -0.35, 0.0, 2.1, 0.0, np.pi - 1.75, 0.0])  # joint posture the IK null space prefers
BASE = {"left": (-0.28, 0.36), "right": (-0.28, -0.36)}
SHOULDER = 0.32  # m above the table at which an arm's second joint turns, over its base
WRIST = 0.08  # m from the sixth joint to the flange, along the flange's z
# m from shoulder to wrist that commands may ask for; at 0.80 the elbow is straight, and arms jerk or jam
REACH = 0.78

# (name, offset from the parent body, hinge axis, range, actuator gain)
_JOINTS = (
    ("1", "0 0 0.12", "0 0 1", "-2.9 2.9", 3000),
    ("2", "0 0 0.20", "0 1 0", "-2.0 2.0", 3000),
    ("3", "0 0 0.20", "0 0 1", "-2.9 2.9", 2000),
    ("4", "0 0 0.20", "0 1 0", "-0.1 2.6", 2000),
    ("5", "0 0 0.20", "0 0 1", "-2.9 2.9", 1000),
    ("6", "0 0 0.20", "0 1 0", "-2.2 2.2", 1000),
    ("7", "0 0 0.05", "0 0 1", "-2.9 2.9", 500),
)


def _arm(side: str, colour: str) -> str:
    x, y = BASE[side]
    closing = "".join("</body>" for _ in _JOINTS)
    links = []
    for index, (name, pos, axis, rng, _) in enumerate(_JOINTS):
        length = 0.05 if index == 5 else (0.03 if index == 6 else 0.20)
        radius = 0.036 - 0.003 * index
        rgba = colour if index % 2 else "0.88 0.89 0.91 1"
        links.append(
            f'<body name="{side}_link{name}" pos="{pos}" gravcomp="1">'
            f'<joint name="{side}_joint{name}" axis="{axis}" range="{rng}" damping="{30 if index < 4 else 12}" armature="0.1"/>'
            f'<geom type="capsule" fromto="0 0 0 0 0 {length}" size="{radius:.3f}" rgba="{rgba}" mass="{1.6 - 0.2 * index:.1f}" class="link"/>'
        )
    # Both fingers slide along the flange's y; closed they form one paddle five centimetres wide.
    fingers = "".join(
        f'<body name="{side}_finger_{tag}" pos="0 {sign * 0.0125} 0.105" gravcomp="1">'
        f'<joint name="{side}_slide_{tag}" type="slide" axis="0 {sign} 0" range="0 {FINGER_TRAVEL}" damping="8" armature="0.01"/>'
        f'<geom type="box" size="0.010 0.0125 0.045" rgba="0.16 0.17 0.19 1" mass="0.05" class="finger"/></body>'
        for tag, sign in (("a", 1), ("b", -1))
    )
    return (
        f'<body name="{side}_base" pos="{x} {y} 0"><geom type="cylinder" size="0.06 0.06" pos="0 0 0.06" rgba="0.35 0.36 0.40 1" class="link"/>'
        + "".join(links)
        + f'<body name="{side}_flange" pos="0 0 0.03" quat="0 0 0 1" gravcomp="1"><site name="{side}_flange" size="0.004" rgba="0 0 0 0"/>'
        f'<geom type="box" size="0.016 0.040 0.014" pos="0 0 0.045" rgba="{colour}" mass="0.3" class="link"/>'
        f'<camera name="hand_{side}" pos="0.09 0 -0.05" xyaxes="0 1 0 0.97 0 0.25" fovy="62"/>'
        + fingers
        + "</body>"
        + closing
        + "</body>"
    )


def build_mjcf(timestep: float = 0.005) -> str:
    """Return the bench as an MJCF string; colours and object sizes are set on the compiled model at reset.

    Args:
        timestep: physics step in seconds.
    """
    actuators = []
    for side in ARMS:
        for name, _, _, rng, gain in _JOINTS:
            actuators.append(
                f'<position name="{side}_act{name}" joint="{side}_joint{name}" kp="{gain}" kv="{gain * 0.06:.0f}" ctrlrange="{rng}"/>'
            )
        for tag in "ab":
            actuators.append(
                f'<position name="{side}_grip_{tag}" joint="{side}_slide_{tag}" kp="300" kv="10" ctrlrange="0 {FINGER_TRAVEL}"/>'
            )
    return f"""
<mujoco model="worldloop_bench">
  <compiler angle="radian" autolimits="true"/>
  <option timestep="{timestep}" integrator="implicitfast" cone="elliptic" impratio="3"/>
  <visual>
    <headlight ambient="0.45 0.45 0.45" diffuse="0.35 0.35 0.35" specular="0.05 0.05 0.05"/>
    <quality shadowsize="1024" offsamples="0" numslices="12" numstacks="6" numquads="1"/>
    <global offwidth="1280" offheight="960"/>
    <map znear="0.005" zfar="20"/>
  </visual>
  <default>
    <default class="link"><geom contype="0" conaffinity="0"/></default>
    <default class="finger"><geom friction="1.5 0.02 0.001" contype="2" conaffinity="1"/></default>
  </default>
  <asset>
    <texture name="floor" type="2d" builtin="checker" rgb1="0.30 0.32 0.36" rgb2="0.26 0.28 0.31" width="128" height="128"/>
    <material name="floor" texture="floor" texrepeat="8 8" reflectance="0"/>
    <texture name="sky" type="skybox" builtin="gradient" rgb1="0.72 0.78 0.86" rgb2="0.93 0.94 0.96" width="64" height="64"/>
  </asset>
  <worldbody>
    <light pos="0.2 0.6 1.8" dir="0 -0.3 -1" diffuse="0.5 0.5 0.5" specular="0.1 0.1 0.1" castshadow="true"/>
    <geom name="floor" type="plane" size="4 4 0.1" pos="0 0 -0.75" material="floor"/>
    <geom name="table" type="box" size="0.55 0.62 0.02" pos="0.15 0 -0.02" rgba="0.72 0.60 0.46 1" friction="0.45 0.01 0.001" contype="1" conaffinity="3"/>
    <geom type="box" size="0.04 0.04 0.355" pos="0.60 0.52 -0.395" rgba="0.4 0.4 0.42 1" class="link"/>
    <geom type="box" size="0.04 0.04 0.355" pos="0.60 -0.52 -0.395" rgba="0.4 0.4 0.42 1" class="link"/>
    <camera name="head" pos="0.50 0 0.88" xyaxes="0 -1 0 0.956 0 -0.292" fovy="43"/>
    <camera name="beauty" pos="1.05 -0.75 0.70" xyaxes="0.62 0.785 0 -0.33 0.26 0.907" fovy="45"/>
    <site name="target" type="cylinder" size="0.05 0.0008" pos="0.3 0 0.0008" rgba="0.2 0.7 0.3 1"/>
    {_arm("left", "0.25 0.38 0.78 1")}
    {_arm("right", "0.85 0.47 0.20 1")}
    <body name="block" pos="0.2 0.1 0.03">
      <freejoint name="block"/>
      <geom name="block" type="box" size="0.03 0.03 0.03" rgba="0.8 0.15 0.15 1" mass="0.15" friction="0.45 0.01 0.001" contype="1" conaffinity="3"/>
    </body>
  </worldbody>
  <actuator>
    {"".join(actuators)}
  </actuator>
</mujoco>
"""
