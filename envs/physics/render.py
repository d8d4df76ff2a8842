"""Offscreen OpenGL: contexts by assets and picture size, shared by all benches of a process."""

from __future__ import annotations

import atexit
import importlib
import os

import cv2
import mujoco
import numpy as np
from numpy.typing import NDArray


class MissingGL(RuntimeError):
    """No usable OpenGL driver; the message says what to install."""


class Offscreen:
    """Renders any model that has the same assets as the one it was made with.

    MuJoCo's own Renderer is tied to one model and makes one GL context each; a batch of benches would exhaust
    the driver. A pixel is the mean of the light that falls into it, as a camera's is: pictures are rendered
    at twice the size, where the model's buffer holds that, and averaged. Small ones say by their edges where
    things are to a fraction of a pixel, at the same cost, which is that of the vertices.

    Raises:
        MissingGL: if no EGL or OSMesa driver answers.
    """

    def __init__(self, model: mujoco.MjModel, size: tuple[int, int]):
        buffer = model.vis.global_
        self._fine = 2 if 2 * size[0] <= buffer.offheight and 2 * size[1] <= buffer.offwidth else 1
        height, width = self._fine * size[0], self._fine * size[1]
        # or pictures larger than the model asks for would hold what nobody drew
        buffer.offheight, buffer.offwidth = max(buffer.offheight, height), max(buffer.offwidth, width)
        # Mesa's software driver hands pictures this small to threads of its own at a loss; every core has a
        # worker already.
        os.environ.setdefault("LP_NUM_THREADS", "0")
        try:
            # Asked for by name: mujoco.GLContext was chosen when somebody first imported mujoco, perhaps for
            # a window.
            backend = os.environ.get("MUJOCO_GL", "egl")
            gl_context = importlib.import_module(f"mujoco.{backend}").GLContext
            # its destructor reads the field, which a constructor that a signal interrupts has not set
            gl_context._context = None
            self._gl = gl_context(width, height)
            # Before EGL itself ends, which mujoco has asked for earlier; afterwards freeing it is an error.
            atexit.register(self._gl.free)
            self._gl.make_current()
            self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_50)
        except Exception as error:
            raise MissingGL(
                f"OpenGL does not start with MUJOCO_GL={os.environ.get('MUJOCO_GL')} ({error}). "
                "Install the software driver: apt-get install -y libegl1 libgl1-mesa-dri, "
                "or set MUJOCO_GL=osmesa and install libosmesa6."
            ) from error
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._scene = mujoco.MjvScene(model, maxgeom=model.ngeom + model.nsite + 100)
        self._option = mujoco.MjvOption()
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._rect = mujoco.MjrRect(0, 0, width, height)
        self._pixels = np.empty((height, width, 3), np.uint8)

    def free(self) -> None:
        """Give back its memory; it renders no more."""
        self._gl.make_current()
        self._context.free()
        self._gl.free()
        atexit.unregister(self._gl.free)

    def render(
        self, model: mujoco.MjModel, data: mujoco.MjData, views: tuple[str, ...], shadows: bool
    ) -> NDArray[np.uint8]:
        """Pictures uint8 [V, 3, H, W] of the named cameras; `shadows` brings reflections too."""
        self._gl.make_current()
        height, width = (side // self._fine for side in self._pixels.shape[:2])
        out = np.empty((len(views), 3, height, width), np.uint8)
        for k, view in enumerate(views):
            self._camera.fixedcamid = model.camera(view).id
            mujoco.mjv_updateScene(
                model, data, self._option, None, self._camera, mujoco.mjtCatBit.mjCAT_ALL.value, self._scene
            )
            # Shadows cost eight times all else, and updating the scene switches both on again.
            self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = shadows
            self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = shadows
            mujoco.mjr_render(self._rect, self._scene, self._context)
            mujoco.mjr_readPixels(self._pixels, None, self._rect, self._context)
            whole = cv2.resize(self._pixels, (width, height), interpolation=cv2.INTER_AREA)
            out[k] = whole[::-1].transpose(2, 0, 1)
        return out

    def segment(
        self, model: mujoco.MjModel, data: mujoco.MjData, views: tuple[str, ...]
    ) -> NDArray[np.uint8]:
        """What each pixel shows, uint8 [V, H, W] of PARTS, by the geom that is drawn there."""
        self._gl.make_current()
        kinds, fine = parts_of(model), self._fine
        out = []
        flags = (mujoco.mjtRndFlag.mjRND_SEGMENT, mujoco.mjtRndFlag.mjRND_IDCOLOR)
        for view in views:
            self._camera.fixedcamid = model.camera(view).id
            mujoco.mjv_updateScene(
                model, data, self._option, None, self._camera, mujoco.mjtCatBit.mjCAT_ALL.value, self._scene
            )
            for flag in flags:
                self._scene.flags[flag] = 1
            mujoco.mjr_render(self._rect, self._scene, self._context)
            mujoco.mjr_readPixels(self._pixels, None, self._rect, self._context)
            for flag in flags:
                self._scene.flags[flag] = 0
            colours = self._pixels.astype(np.int64) @ (
                1,
                256,
                65536,
            )  # number of what is drawn, 0 for nothing
            drawn = np.zeros(self._scene.ngeom + 1, np.uint8)
            for geom in self._scene.geoms[: self._scene.ngeom]:
                if geom.objtype == mujoco.mjtObj.mjOBJ_GEOM and 0 <= geom.segid < self._scene.ngeom:
                    drawn[geom.segid + 1] = kinds[geom.objid]
            colours[colours > self._scene.ngeom] = 0
            out.append(drawn[colours][::-1][::fine, ::fine])
        return np.stack(out)


PARTS = {"background": 0, "arm": 1, "object": 2}  # what a pixel may show


def parts_of(model: mujoco.MjModel) -> NDArray[np.uint8]:
    """What each geom belongs to, uint8 [G] of PARTS: a robot, which has motors; a thing that can move; or
    what stands still.
    """
    joints = model.actuator_trnid[model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT, 0]
    tendons = model.actuator_trnid[model.actuator_trntype == mujoco.mjtTrn.mjTRN_TENDON, 0]
    for tendon in tendons:
        begin, count = model.tendon_adr[tendon], model.tendon_num[tendon]
        wrapped = slice(begin, begin + count)
        joints = np.concatenate(
            (joints, model.wrap_objid[wrapped][model.wrap_type[wrapped] == mujoco.mjtWrap.mjWRAP_JOINT])
        )
    driven = {int(model.body_rootid[model.jnt_bodyid[joint]]) for joint in joints}
    moving = {int(model.body_rootid[body]) for body in model.jnt_bodyid}
    roots = model.body_rootid[model.geom_bodyid]
    kinds = [
        PARTS["arm" if root in driven else "object" if root in moving else "background"] for root in roots
    ]
    return np.array(kinds, np.uint8)


_CONTEXTS: dict[tuple[str, tuple[int, int]], Offscreen] = {}  # the one unused for longest first


def offscreen_for(assets: str, model: mujoco.MjModel, size: tuple[int, int], most: int) -> Offscreen:
    """The process's context, good until the next call; made where there is none.

    Args:
        assets: a name that models with equal meshes, textures and geoms share.
        model: one of them.
        size: (height, width) of the pictures.
        most: contexts that are kept; the software driver takes over 100 MB for one of Meta-World's tasks and
            .3 s to make it.
    """
    context = _CONTEXTS.pop((assets, size), None)
    while len(_CONTEXTS) >= most:
        _CONTEXTS.pop(next(iter(_CONTEXTS))).free()
    _CONTEXTS[assets, size] = context or Offscreen(model, size)
    return _CONTEXTS[assets, size]


def calibration(
    model: mujoco.MjModel, data: mujoco.MjData, views: tuple[str, ...], size: tuple[int, int]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Pinhole intrinsics [V, 3, 3] in pixels for pictures of `size` = (height, width), and camera poses [V,
    4, 4] (camera to world, OpenCV convention) of the named cameras.
    """
    height, width = size
    intrinsic = np.zeros((len(views), 3, 3))
    c2w = np.tile(np.eye(4), (len(views), 1, 1))
    for k, view in enumerate(views):
        camera = model.camera(view).id
        focal = 0.5 * height / np.tan(np.deg2rad(model.cam_fovy[camera]) / 2)
        intrinsic[k] = [[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]
        c2w[k, :3, :3] = data.cam_xmat[camera].reshape(3, 3) @ np.diag([1.0, -1.0, -1.0])
        c2w[k, :3, 3] = data.cam_xpos[camera]
    return intrinsic, c2w
