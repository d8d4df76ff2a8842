"""The true world: a MuJoCo bench with two arms. Only env.py imports torch, so worker processes start fast."""

import os

os.environ.setdefault("MUJOCO_GL", "egl")  # headless; mujoco reads it when it is first imported
