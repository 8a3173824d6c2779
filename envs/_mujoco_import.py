"""MuJoCo and gymnasium's use of it, with one line that says what to do where they fail."""

from __future__ import annotations

import os

__all__ = ["GL_ADVICE", "Batch", "MujocoEnv", "mujoco"]

GL_ADVICE = "install libegl1 and set MUJOCO_GL=egl, or install libosmesa6 and set MUJOCO_GL=osmesa"

try:
    import mujoco
    from gymnasium.envs.mujoco import MujocoEnv
except ModuleNotFoundError as error:
    raise ImportError(
        f"the robots need MuJoCo, and {error.name} is not installed: pip install mujoco"
    ) from error
except Exception as error:  # MuJoCo loads OpenGL at once, which fails in many ways
    raise OSError(
        f"MuJoCo cannot be imported with MUJOCO_GL={os.environ.get('MUJOCO_GL')!r} "
        f"({type(error).__name__}); unset MUJOCO_GL, or {GL_ADVICE}"
    ) from error

try:
    from mujoco.batch import Batch
except ImportError:  # before MuJoCo 4.0
    Batch = None
