"""Pictures are means over their pixels, and a context that is interrupted while it starts says only that."""

from __future__ import annotations

import gc
import sys

import mujoco
import mujoco.egl
import numpy as np
import pytest

from envs.physics.render import Offscreen, offscreen_for

MODEL = "<mujoco><worldbody><geom size='.1'/></worldbody></mujoco>"


SCENE = """<mujoco><visual><global offwidth="{0}" offheight="{0}"/></visual><worldbody>
<light pos="0 0 3"/><geom type="box" size=".3 .3 .1" euler="0 0 17" rgba="1 0 0 1"/>
<camera name="top" pos="0 0 2" fovy="40"/></worldbody></mujoco>"""


def test_pixels_are_means_where_the_buffer_holds_twice_the_size():
    pictures = []
    for buffer in (16, 32, 64):
        model = mujoco.MjModel.from_xml_string(SCENE.format(buffer))
        model.vis.quality.offsamples = 0
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        pictures.append(Offscreen(model, (16, 16)).render(model, data, ("top",), shadows=False)[0])
    hard, soft, again = pictures
    assert hard.shape == soft.shape == (3, 16, 16)
    assert len(np.unique(hard[0])) < len(np.unique(soft[0]))  # edges between red and black
    assert np.array_equal(soft, again)
    assert abs(hard[0].mean() - soft[0].mean()) < 8


def test_contexts_beyond_the_most_are_freed_the_one_unused_for_longest_first():
    model = mujoco.MjModel.from_xml_string(SCENE.format(32))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)

    def picture(assets: str) -> tuple[Offscreen, np.ndarray]:
        context = offscreen_for(assets, model, (16, 16), most=2)
        return context, context.render(model, data, ("top",), shadows=False)

    one, first = picture("one")
    two, _ = picture("two")
    assert picture("one")[0] is one
    picture("three")
    assert two._gl._context is None and picture("one")[0] is one
    anew, again = picture("two")
    assert anew is not two and np.array_equal(first, again)


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
