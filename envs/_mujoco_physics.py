"""MuJoCo's data of many worlds, stepped side by side on threads."""

from __future__ import annotations

import ctypes
import os
from abc import ABC, abstractmethod
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from typing import Any
from weakref import WeakSet

import numpy as np

from sb3_e2c.envs._mujoco_import import Batch, mujoco
from sb3_e2c.envs._mujoco_models import BOMB
from sb3_e2c.envs._mujoco_robots import FRAME_SKIP, Snapshot
from sb3_e2c.envs._mujoco_start import Start

# All that a later step depends on, the solver's warm start included
_STATE = mujoco.mjtState.mjSTATE_INTEGRATION
_TORSO = 1  # number of the robot's first body


class Physics(ABC):
    """W worlds of one model. Threads are started when they are first needed.

    :param model: the model
    :param n_worlds: W
    :param n_threads: threads that step worlds, the calling one included

    Subclasses add themselves to ``_LIVING`` when they are complete: a fork calls
    :meth:`lose_threads` of all that stand there.
    """

    def __init__(self, model: mujoco.MjModel, n_worlds: int, n_threads: int) -> None:
        self.model = model
        self.n_worlds = n_worlds
        self.n_threads = n_threads

    @abstractmethod
    def restart(self, worlds: np.ndarray, starts: list[Start]) -> Snapshot:
        """Put R worlds at time 0 with these positions and velocities, and read them."""

    @abstractmethod
    def advance(self, controls: np.ndarray) -> Snapshot:
        """Advance all worlds by one step of the environment, and read them.

        :param controls: inputs of all motors, shape (W, nu)
        """

    @abstractmethod
    def read(self) -> Snapshot:
        """Read all worlds; the arrays are fresh."""

    @abstractmethod
    def get_state(self) -> np.ndarray:
        """All that the next steps depend on, shape (W, L), the same rows in all subclasses."""

    @abstractmethod
    def set_state(self, rows: np.ndarray) -> None:
        """Continue from :meth:`get_state`."""

    @abstractmethod
    def close(self) -> None:
        """End the threads; the state stays."""

    @abstractmethod
    def lose_threads(self) -> None:
        """Go on in a forked process, which has none of its parent's threads."""


_LIVING: WeakSet[Physics] = WeakSet()


def _lose_threads() -> None:
    for physics in list(_LIVING):
        physics.lose_threads()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_lose_threads)


def new_physics(
    model: mujoco.MjModel, n_worlds: int, needs_contact: bool, n_threads: int | None = None
) -> Physics:
    """Make worlds, in the fastest way that this MuJoCo has.

    :param model: the model
    :param n_worlds: W
    :param needs_contact: whether the forces on bodies are read; without, snapshots have none
    :param n_threads: threads that step worlds; None is one for each core, at most W
    """
    n_threads = min(n_worlds, n_threads or _n_cores())
    # MuJoCo's batches do not compute the forces on bodies.
    if Batch is None or needs_contact:
        return ThreadedPhysics(model, n_worlds, n_threads, needs_contact)
    return BatchPhysics(model, n_worlds, n_threads)


class ThreadedPhysics(Physics):
    """Worlds that Python's threads step one after the other; MuJoCo computes outside of its lock.

    :param model: the model
    :param n_worlds: W
    :param n_threads: threads that step worlds, the calling one included
    :param needs_contact: whether to compute and read the forces on bodies
    """

    def __init__(
        self, model: mujoco.MjModel, n_worlds: int, n_threads: int, needs_contact: bool
    ) -> None:
        super().__init__(model, n_worlds, n_threads)
        self.datas = [mujoco.MjData(model) for _ in range(n_worlds)]
        self.needs_contact = needs_contact
        self._windows = [_windows(model, data, needs_contact) for data in self.datas]
        self._pool: ThreadPoolExecutor | None = None
        _LIVING.add(self)

    def restart(self, worlds: np.ndarray, starts: list[Start]) -> Snapshot:
        """Put R worlds at time 0 with these positions and velocities, and read them."""
        begun = self._empty(len(worlds))
        for row, (world, start) in enumerate(zip(worlds.tolist(), starts, strict=True)):
            _begin(self.model, self.datas[world], start)
            self._read(world, row, begun)
        return begun

    def advance(self, controls: np.ndarray) -> Snapshot:
        """Advance all worlds by one step of the environment, and read them.

        :param controls: inputs of all motors, shape (W, nu)
        """
        now, waiting = self._empty(self.n_worlds), deque(range(self.n_worlds))
        if self._pool is None and self.n_threads > 1:
            self._pool = ThreadPoolExecutor(self.n_threads - 1)
        futures = []
        if self._pool is not None:
            others = range(self.n_threads - 1)
            futures = [self._pool.submit(self._step, waiting, controls, now) for _ in others]
        self._step(waiting, controls, now)
        for future in futures:
            future.result()
        return now

    def _step(self, waiting: deque[int], controls: np.ndarray, now: Snapshot) -> None:
        """Step one world after the other, until none is waiting for any thread."""
        while True:
            try:
                world = waiting.popleft()
            except IndexError:
                return
            data = self.datas[world]
            data.ctrl[:] = controls[world]
            mujoco.mj_step(self.model, data, nstep=FRAME_SKIP)
            if self.needs_contact:
                mujoco.mj_rnePostConstraint(self.model, data)
            self._read(world, world, now)

    def read(self) -> Snapshot:
        """Read all worlds; the arrays are fresh."""
        now = self._empty(self.n_worlds)
        for world in range(self.n_worlds):
            self._read(world, world, now)
        return now

    def _read(self, world: int, row: int, into: Snapshot) -> None:
        _copy(self.datas[world].time, self._windows[world], row, into)

    def _empty(self, n_rows: int) -> Snapshot:
        return _empty(n_rows, self._windows[0])

    def get_state(self) -> np.ndarray:
        """All that the next steps depend on, shape (W, L)."""
        return get_state(self.model, self.datas)

    def set_state(self, rows: np.ndarray) -> None:
        """Continue from :meth:`get_state`."""
        set_state(self.model, self.datas, rows)

    def close(self) -> None:
        """End the threads; the state stays."""
        if self._pool is not None:
            self._pool.shutdown()
        self._pool = None

    def lose_threads(self) -> None:
        """Go on in a forked process: the next step starts a pool."""
        self._pool = None


class BatchPhysics(Physics):
    """Worlds that MuJoCo's own threads step, without Python in between; needs MuJoCo 4.0.

    Snapshots have no forces on bodies.

    :param model: the model
    :param n_worlds: W
    :param n_threads: threads that step worlds, the calling one included
    """

    def __init__(self, model: mujoco.MjModel, n_worlds: int, n_threads: int) -> None:
        super().__init__(model, n_worlds, n_threads)
        self._bomb = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, BOMB)
        self._state: np.ndarray | None = None  # what a batch begins with, if not with the default
        self._batch: Any = None
        self._controls = np.empty(0)
        self._live: Snapshot | None = None
        _LIVING.add(self)

    def _started(self) -> Any:
        """The batch, a new one if there is none."""
        if self._batch is None:
            self._batch = Batch(self.model, self.n_worlds, self.n_threads)
            if self._state is not None:
                self._batch.state[:] = self._state
            self._controls = self._batch.bind("ctrl")
            self._live = self._columns(self._batch)
        return self._batch

    def _columns(self, batch: Any) -> Snapshot:
        """Arrays that show the worlds as they are now."""
        x = np.full(self.n_worlds, np.nan)
        return Snapshot(
            batch.bind("time"),
            batch.bind("qpos"),
            batch.bind("qvel"),
            batch.bind("xpos")[:, _TORSO],
            batch.bind("geom_xpos")[:, self._bomb, 0] if self._bomb >= 0 else x,
            np.empty((self.n_worlds, 0)),
        )

    def restart(self, worlds: np.ndarray, starts: list[Start]) -> Snapshot:
        """Put R worlds at time 0 with these positions and velocities, and read them."""
        # A forward pass of the batch would reset what is unstable, which that of a world does not.
        rows, data = self._started().state, mujoco.MjData(self.model)
        windows = _windows(self.model, data, needs_contact=False)
        begun = _empty(len(worlds), windows)
        for row, (world, start) in enumerate(zip(worlds.tolist(), starts, strict=True)):
            _begin(self.model, data, start)
            mujoco.mj_getState(self.model, data, rows[world], _STATE)
            _copy(data.time, windows, row, begun)
        return begun

    def advance(self, controls: np.ndarray) -> Snapshot:
        """Advance all worlds by one step of the environment, and read them.

        :param controls: inputs of all motors, shape (W, nu)
        """
        batch = self._started()
        self._controls[:] = controls
        batch.step(nstep=FRAME_SKIP)
        return self.read()

    def read(self) -> Snapshot:
        """Read all worlds; the arrays are fresh."""
        self._started()
        assert self._live is not None
        return Snapshot(*(column.copy() for column in self._live))

    def get_state(self) -> np.ndarray:
        """All that the next steps depend on, shape (W, L)."""
        if self._batch is None and self._state is not None:
            return self._state.copy()  # closed; starting again would be for nothing
        return np.array(self._started().state)

    def set_state(self, rows: np.ndarray) -> None:
        """Continue from :meth:`get_state`."""
        self._started().state[:] = rows

    def close(self) -> None:
        """End the threads; the state stays."""
        if self._batch is not None:
            self._state = self.get_state()
        # The batch ends its threads when nothing refers to it, its arrays included.
        self._batch, self._controls, self._live = None, np.empty(0), None

    def lose_threads(self) -> None:
        """Go on in a forked process: the next step makes another batch.

        The old one is never freed, because it would wait for threads that there are not.
        """
        if self._batch is not None:
            ctypes.pythonapi.Py_IncRef(ctypes.py_object(self._batch))
        self.close()


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


def _begin(model: mujoco.MjModel, data: mujoco.MjData, start: Start) -> None:
    """Put a world at time 0."""
    mujoco.mj_resetData(model, data)
    data.qpos[:], data.qvel[:] = start
    mujoco.mj_forward(model, data)


def _empty(n_rows: int, windows: tuple[np.ndarray, ...]) -> Snapshot:
    """Room for worlds with these windows."""
    return Snapshot(np.empty(n_rows), *(np.empty((n_rows, *window.shape)) for window in windows))


def _copy(time: float, windows: tuple[np.ndarray, ...], row: int, into: Snapshot) -> None:
    """Copy what a world's windows show into a row."""
    into.time[row] = time
    for column, window in zip(into[1:], windows, strict=True):
        column[row] = window


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
