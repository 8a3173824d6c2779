"""MuJoCo's data of many worlds, stepped side by side on threads."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from sb3_e2c.envs._mujoco_import import mujoco
from sb3_e2c.envs._mujoco_models import BOMB
from sb3_e2c.envs._mujoco_robots import FRAME_SKIP, Snapshot

# All that a later step depends on, the solver's warm start included
_STATE = mujoco.mjtState.mjSTATE_INTEGRATION
_TORSO = 1  # number of the robot's first body


class Physics:
    """W worlds of one model.

    :param model: the model
    :param n_worlds: W
    :param needs_contact: whether to compute and read the forces on bodies; without, snapshots have
        none
    :param n_threads: threads that step worlds; None is one for each core, at most W
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        n_worlds: int,
        needs_contact: bool,
        n_threads: int | None = None,
    ) -> None:
        self.model = model
        self.datas = [mujoco.MjData(model) for _ in range(n_worlds)]
        self.needs_contact = needs_contact
        self._windows = [_windows(model, data, needs_contact) for data in self.datas]
        n_threads = min(n_worlds, n_threads or _n_cores())
        self._shares = [share.tolist() for share in np.array_split(np.arange(n_worlds), n_threads)]
        # The calling thread steps the first share.
        self._pool = ThreadPoolExecutor(n_threads - 1) if n_threads > 1 else None

    def restart(self, world: int, qpos: np.ndarray, qvel: np.ndarray) -> None:
        """Put a world at time 0 with these positions and velocities."""
        data = self.datas[world]
        mujoco.mj_resetData(self.model, data)
        data.qpos[:] = qpos
        data.qvel[:] = qvel
        mujoco.mj_forward(self.model, data)

    def advance(self, controls: np.ndarray) -> Snapshot:
        """Advance all worlds by one step of the environment, and read them.

        :param controls: inputs of all motors, shape (W, nu)
        """
        now = self._empty(len(self.datas))
        futures = []
        if self._pool is not None:
            futures = [self._pool.submit(self._step, s, controls, now) for s in self._shares[1:]]
        self._step(self._shares[0], controls, now)
        for future in futures:
            future.result()
        return now

    def close(self) -> None:
        """End the threads."""
        if self._pool is not None:
            self._pool.shutdown()

    def _step(self, worlds: list[int], controls: np.ndarray, now: Snapshot) -> None:
        """Step some worlds one after the other; MuJoCo computes outside of Python's lock."""
        for world in worlds:
            data = self.datas[world]
            data.ctrl[:] = controls[world]
            mujoco.mj_step(self.model, data, nstep=FRAME_SKIP)
            if self.needs_contact:
                mujoco.mj_rnePostConstraint(self.model, data)
            self._read(world, world, now)

    def read(self, worlds: list[int]) -> Snapshot:
        """Read some worlds, in this order."""
        now = self._empty(len(worlds))
        for row, world in enumerate(worlds):
            self._read(world, row, now)
        return now

    def _read(self, world: int, row: int, into: Snapshot) -> None:
        into.time[row] = self.datas[world].time
        for column, window in zip(into[1:], self._windows[world], strict=True):
            column[row] = window

    def _empty(self, n_rows: int) -> Snapshot:
        columns = [np.empty((n_rows, *window.shape)) for window in self._windows[0]]
        return Snapshot(np.empty(n_rows), *columns)


def take_snapshot(model: mujoco.MjModel, data: mujoco.MjData) -> Snapshot:
    """Read a single world with all forces; the arrays are fresh.

    :param model: its model
    :param data: MuJoCo's data
    """
    columns = [np.array(window)[None] for window in _windows(model, data, needs_contact=True)]
    return Snapshot(np.array([data.time]), *columns)


def get_state(model: mujoco.MjModel, datas: list[mujoco.MjData]) -> np.ndarray:
    """All that the next steps of worlds depend on, shape (W, L)."""
    state = np.empty((len(datas), mujoco.mj_stateSize(model, _STATE)))
    for row, data in zip(state, datas, strict=True):
        mujoco.mj_getState(model, data, row, _STATE)
    return state


def set_state(model: mujoco.MjModel, datas: list[mujoco.MjData], state: np.ndarray) -> None:
    """Put worlds into a state of :func:`get_state`."""
    for row, data in zip(state, datas, strict=True):
        mujoco.mj_setState(model, data, row, _STATE)


def _windows(
    model: mujoco.MjModel, data: mujoco.MjData, needs_contact: bool
) -> tuple[np.ndarray, ...]:
    """Views of what a snapshot reads besides the time: they show the data as they are now."""
    bomb = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, BOMB)
    x = data.geom_xpos[bomb, 0:1] if bomb >= 0 else np.full(1, np.nan)
    forces = data.cfrc_ext.ravel() if needs_contact else np.empty(0)
    return data.qpos, data.qvel, data.xpos[_TORSO], x.reshape(()), forces


def _n_cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
