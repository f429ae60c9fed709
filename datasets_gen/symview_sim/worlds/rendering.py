"""Colour and metric depth images of a MuJoCo scene, for any pinhole camera, without a screen."""

from __future__ import annotations

import atexit
import os
import sys
from ctypes.util import find_library
from typing import Any
from weakref import WeakSet

import mujoco
import numpy as np

from lerobot_symview.geometry.camera import Array, Camera
from lerobot_symview.runtime.cli import CommandError
from symview_sim.camera_rig import CameraImages
from symview_sim.worlds.base import REMEDY

MAX_GEOMS = 10_000


class MujocoRenderer:
    """Renders the scenes of a model, with one context for cameras of all sizes.

    Args:
        model: `mujoco.MjModel`. Its buffers for images are set to the given size, without antialiasing, which would
            average depth over edges.
        height: rows of the largest image.
        width: columns of the largest image.

    Raises:
        CommandError: if there is no way to draw without a screen; the message names the remedy.
    """

    def __init__(self, model: Any, height: int, width: int):
        model.vis.global_.offheight, model.vis.global_.offwidth = height, width
        model.vis.quality.offsamples = 0
        self._model = model
        self._context = _gl_context(width, height)
        self._context.make_current()
        self._scene, self._options = mujoco.MjvScene(model, MAX_GEOMS), mujoco.MjvOption()
        self._target = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        self._target.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._target)
        if not _LIVE:
            atexit.register(_close_all)
        _LIVE.add(self)

    def render(self, data: Any, camera: Camera, model_from_world: Array) -> CameraImages:
        """Render colour and depth in one pass.

        Args:
            data: `mujoco.MjData`.
            camera: where to look from, in the world's frame.
            model_from_world: (4, 4) transform to the model's frame.
        """
        self._context.make_current()
        everything = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(self._model, data, self._options, None, mujoco.MjvCamera(), everything, self._scene)
        for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):  # most of the time
            self._scene.flags[flag] = 0
        for eye in self._scene.camera:
            _place(eye, camera, model_from_world @ camera.world_from_cam)
        frame = mujoco.MjrRect(0, 0, camera.width, camera.height)
        rgb = np.empty((camera.height, camera.width, 3), dtype=np.uint8)
        buffer = np.empty((camera.height, camera.width), dtype=np.float32)
        mujoco.mjr_render(frame, self._scene, self._target)
        mujoco.mjr_readPixels(rgb, buffer, frame, self._target)
        near, far = self._scene.camera[0].frustum_near, self._scene.camera[0].frustum_far
        depth = near * far / (near + buffer.astype(np.float64) * (far - near))  # 1 is near, 0 is far and nothing
        depth = np.where(buffer > 0, depth, 0.0).astype(np.float32)
        return CameraImages(np.ascontiguousarray(rgb[::-1]), np.ascontiguousarray(depth[::-1]))

    def close(self) -> None:
        """Free the context."""
        _LIVE.discard(self)
        self._context.make_current()  # what is freed is named in the current context, whose it may not be
        self._target.free()
        self._context.free()


_LIVE: WeakSet[MujocoRenderer] = WeakSet()


def _close_all() -> None:
    """Free contexts before MuJoCo's own exit function shuts EGL down, after which they cannot be freed."""
    for renderer in list(_LIVE):
        renderer.close()


def _place(eye: Any, camera: Camera, model_from_cam: Array) -> None:
    """Give one of the scene's OpenGL cameras the pose and the intrinsics of a pinhole camera."""
    eye.pos, eye.forward, eye.up = model_from_cam[:3, 3], model_from_cam[:3, 2], -model_from_cam[:3, 1]
    near = eye.frustum_near
    eye.frustum_top = near * (camera.cy + 0.5) / camera.fy
    eye.frustum_bottom = near * (camera.cy + 0.5 - camera.height) / camera.fy
    eye.frustum_center = near * (camera.width / 2 - 0.5 - camera.cx) / camera.fx
    eye.frustum_width = near * camera.width / 2 / camera.fx  # half of it


def _gl_context(width: int, height: int) -> Any:
    """Return MuJoCo's OpenGL context: by `MUJOCO_GL`, else on Linux by EGL or OSMesa, whichever is installed."""
    kind = os.environ.get("MUJOCO_GL", "").lower()
    if not kind and sys.platform == "linux":
        kind = "egl" if find_library("EGL") or not find_library("OSMesa") else "osmesa"
    try:
        if kind == "egl":
            from mujoco.egl import GLContext
        elif kind == "osmesa":
            from mujoco.osmesa import GLContext
        else:
            from mujoco.gl_context import GLContext
        return GLContext(width, height)
    except Exception as error:  # each of the three has its own
        raise CommandError(
            f"MuJoCo cannot draw without a screen by {kind or 'this system'}: {error}; {REMEDY}"
        ) from None
