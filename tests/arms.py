"""A robot description of two arms, for kinematics."""

from __future__ import annotations

from pathlib import Path

from envs.embodiment import Robot


def two_arms(folder: Path) -> Robot:
    """A robot description of two arms of seven hinges."""

    def arm(side: str) -> str:
        links = "".join(
            f'<body name="{side}{k}" pos="0 0 .1"><joint name="{side}_j{k}" axis="0 {k % 2} {1 - k % 2}"/>'
            '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'
            for k in range(7)
        )
        return f'{links}<site name="{side}_flange"/>' + "</body>" * 7

    path = folder / "arms.xml"
    path.write_text(f"<mujoco><worldbody>{arm('left')}{arm('right')}</worldbody></mujoco>")
    joints = tuple(tuple(f"{side}_j{k}" for k in range(7)) for side in ("left", "right"))
    return Robot(str(path), joints, ("left_flange", "right_flange"))
