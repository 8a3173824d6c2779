"""Pictures of a robot with its walls and bomb, drawn by MuJoCo without a window."""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any

import numpy as np

from sb3_e2c.envs._mujoco_import import GL_ADVICE, mujoco
from sb3_e2c.envs._mujoco_models import BOMB

WIDTH, HEIGHT = 640, 480
_RED = (1.0, 0.0, 0.0, 1.0)
_MARKED = (BOMB, "torso_geom", "torso")  # the first of these geoms that exists turns red


class Painter:
    """Draws one model; everything of OpenGL happens at the first picture.

    :param model: the model, whose bomb (or torso, where there is no bomb) is recolored
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model = model
        self.data = mujoco.MjData(model)
        geoms = (mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, name) for name in _MARKED)
        self._color = model.geom_rgba[next(geom for geom in geoms if geom >= 0)]
        self._calm = self._color.copy()
        self._renderer: Any = None

    def draw(self, qpos: np.ndarray, is_costing: bool) -> np.ndarray:
        """Picture of a world, uint8, shape (480, 640, 3).

        :param qpos: positions of all joints, shape (nq,)
        :param is_costing: whether the last step had a cost, which is shown in red
        """
        self.data.qpos[:] = qpos
        mujoco.mj_forward(self.model, self.data)
        self._color[:] = _RED if is_costing else self._calm
        with _headless():
            if self._renderer is None:
                self._renderer = _open(self.model, self.data)
            self._take_context()
            return self._renderer.render("rgb_array")

    def close(self) -> None:
        """Release the OpenGL context."""
        if self._renderer is not None:
            self._take_context()
            if self._renderer.viewer is not None:
                self._renderer.viewer.con.free()  # needs the context, which goes away next
            self._renderer.close()
            self._renderer = None

    def _take_context(self) -> None:
        """Direct OpenGL to this painter: others may have drawn since."""
        if self._renderer.viewer is not None:  # made at the first picture
            self._renderer.viewer.make_context_current()


def _open(model: mujoco.MjModel, data: mujoco.MjData) -> Any:
    _check_opengl()
    from gymnasium.envs.mujoco.mujoco_rendering import MujocoRenderer  # imports a window toolkit

    return MujocoRenderer(model, data, width=WIDTH, height=HEIGHT, camera_name="track")


def _check_opengl() -> None:
    """Draw on trial: gymnasium's viewer cannot be closed if OpenGL fails inside it."""
    backend = os.environ.get("MUJOCO_GL", "glfw")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of glfw, which goes on without a display
            context = import_module(f"mujoco.{backend}").GLContext(WIDTH, HEIGHT)
            context.make_current()
            nothing = mujoco.MjModel.from_xml_string("<mujoco/>")
            mujoco.MjrContext(nothing, mujoco.mjtFontScale.mjFONTSCALE_100).free()
            context.free()
    except Exception as error:  # every backend fails in its own ways
        raise OSError(
            f"rendering needs OpenGL, and the backend {backend!r} does not work here "
            f"({type(error).__name__}); {GL_ADVICE}"
        ) from error


@contextmanager
def _headless() -> Iterator[None]:
    """Without a display and a choice of the user, draw with EGL; the variable is put back."""
    has_display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if "MUJOCO_GL" in os.environ or has_display or not sys.platform.startswith("linux"):
        yield
        return
    os.environ["MUJOCO_GL"] = "egl"
    try:
        yield
    finally:
        del os.environ["MUJOCO_GL"]
