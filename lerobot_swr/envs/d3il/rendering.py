"""Offscreen pictures of a scene. Nothing here touches OpenGL before the first picture is wanted."""

import atexit
import importlib
import os
import platform
import weakref
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from functools import lru_cache

import numpy as np

from lerobot_swr.envs.d3il.dependencies import mujoco
from lerobot_swr.envs.d3il.scene import CAMERA, SQUARE_CAMERA

_HINT = (
    "On a machine without a screen install a software renderer and name it: Debian/Ubuntu `apt-get install "
    "libegl1 libgl1-mesa-dri` with MUJOCO_GL=egl, or `apt-get install libosmesa6` with MUJOCO_GL=osmesa."
)


class OffscreenCamera:
    """Renders a camera of the scene into arrays; owns one OpenGL context, which `close` frees.

    Args:
        model: A compiled scene.
        height: Of the pictures, in pixels.
        width: Of the pictures, in pixels.
        name: Of the camera.
        fast: Without shadows, reflections and smooth edges, which cost a software renderer most of its time.

    Raises:
        RuntimeError: If no OpenGL renderer works here; says what to install.
    """

    def __init__(
        self, model: "mujoco.MjModel", height: int, width: int, name: str = CAMERA, fast: bool = False
    ):
        self._model = model
        self._scene = mujoco.MjvScene(model, maxgeom=1000)
        self._options = mujoco.MjvOption()
        self._view = mujoco.MjvCamera()
        self._view.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._view.fixedcamid = model.camera(name).id
        self._viewport = mujoco.MjrRect(0, 0, width, height)
        self._gl = _open_gl(width, height)
        self._gl.make_current()
        with _without_extras(model, self._scene) if fast else nullcontext():
            self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_resizeOffscreen(width, height, self._context)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)
        self.close = weakref.finalize(self, _free, self._gl, self._context)
        # At interpreter exit it must run before MuJoCo ends its display connection. That was registered when
        # the context was opened, and exit handlers run last in, first out; a finalizer's own hook is older.
        self.close.atexit = False
        atexit.register(self.close)

    def picture(self, data: "mujoco.MjData") -> np.ndarray:
        """(height, width, 3) uint8 picture of the state in `data`."""
        self._gl.make_current()
        mujoco.mjv_updateScene(
            self._model,
            data,
            self._options,
            None,
            self._view,
            mujoco.mjtCatBit.mjCAT_ALL.value,
            self._scene,
        )
        mujoco.mjr_render(self._viewport, self._scene, self._context)
        pixels = np.empty((self._viewport.height, self._viewport.width, 3), dtype=np.uint8)
        mujoco.mjr_readPixels(pixels, None, self._viewport, self._context)
        return np.ascontiguousarray(pixels[::-1])


@lru_cache(maxsize=4)
def shared_camera(model: "mujoco.MjModel", size: int) -> OffscreenCamera:
    """The process's camera for observations of a scene, size × size pixels; it belongs to one thread."""
    return OffscreenCamera(model, size, size, SQUARE_CAMERA, fast=True)


@contextmanager
def _without_extras(model: "mujoco.MjModel", scene: "mujoco.MjvScene") -> Iterator[None]:
    """Let a context be made that has no room for shadows and draws every pixel once."""
    for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
        scene.flags[flag] = 0
    quality = model.vis.quality
    usual = quality.shadowsize, quality.offsamples
    quality.shadowsize, quality.offsamples = 0, 0
    try:
        yield
    finally:
        quality.shadowsize, quality.offsamples = usual


def _open_gl(width: int, height: int):
    """An OpenGL context of the renderer that MUJOCO_GL names, or else of one that works without a screen."""
    named = os.environ.get("MUJOCO_GL", "").lower().strip()
    has_screen = bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
    modules = ["mujoco.egl", "mujoco.osmesa"]
    if named or has_screen or platform.system() != "Linux":
        modules = ["mujoco.gl_context"]
    failures = []
    for module in modules:
        try:
            return importlib.import_module(module).GLContext(width, height)
        except Exception as error:  # the OpenGL bindings raise anything from ImportError to AttributeError
            failures.append(f"{module}: {type(error).__name__}: {error}")
    raise RuntimeError(f"render() found no OpenGL renderer ({'; '.join(failures)}). {_HINT}")


def _free(gl, context: "mujoco.MjrContext") -> None:
    gl.make_current()
    context.free()
    gl.free()
