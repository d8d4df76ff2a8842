"""A rendering context that is interrupted while it starts says nothing but that."""

from __future__ import annotations

import gc
import sys

import mujoco
import mujoco.egl
import pytest

from envs.physics.render import Offscreen

MODEL = "<mujoco><worldbody><geom size='.1'/></worldbody></mujoco>"


def test_a_context_interrupted_while_it_starts_leaves_no_traceback(monkeypatch: pytest.MonkeyPatch):
    ignored: list[object] = []
    monkeypatch.setenv("MUJOCO_GL", "egl")
    monkeypatch.setattr(sys, "unraisablehook", ignored.append)

    def interrupted(self: object, width: int, height: int) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(mujoco.egl.GLContext, "__init__", interrupted)
    with pytest.raises(KeyboardInterrupt):
        Offscreen(mujoco.MjModel.from_xml_string(MODEL), (8, 8))
    gc.collect()
    assert not ignored
