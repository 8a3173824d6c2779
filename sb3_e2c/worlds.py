"""The worlds behind a :class:`~sb3_e2c.vec_env.MultiAgentVecEnv`, in one of two ways.

    ParallelEnv ─► World ─► SuperSuit's rows ─► SuperSuitWorlds, WorkerWorlds ─┐
    ParallelEnv.batched(W) ───────────────────► BatchedWorlds ─────────────────┴─► Step

Both give the same trajectories for the same seeds. W worlds of N agents are S = W·N slots,
slot = world·N + agent; a world begins its next episode within the step that ends the last one.
"""

import atexit
import multiprocessing
import multiprocessing.connection
import time
import weakref
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from typing import Any, NamedTuple, Protocol

import numpy as np
import supersuit as ss
from gymnasium import spaces
from pettingzoo import ParallelEnv
from supersuit.vector import MakeCPUAsyncConstructor
from supersuit.vector.multiproc_vec import decompress_info
from typing_extensions import override

from sb3_e2c.world import RESET_INFO, MakeEnv, World, as_float32, check_distinct, new_env

Infos = list[dict[str, Any]]
NewWorld = Callable[[ParallelEnv, int], World]

# Patience with worlds that are being closed; then their workers are killed.
_CLOSE_SECONDS = 5.0


class BatchedSimulator(Protocol):
    """What ``ParallelEnv.batched(n_worlds)`` returns: W worlds in one set of arrays.

    Every world has a random stream of its own, which a seed restarts and None continues.
    """

    n_worlds: int
    possible_agents: list[str]
    render_mode: str | None
    metadata: dict[str, Any]

    def observation_space(self, agent: str) -> spaces.Space:
        """Observation space of an agent, the same for all."""

    def action_space(self, agent: str) -> spaces.Space:
        """Action space of an agent, the same for all."""

    def reset(
        self,
        worlds: np.ndarray,
        seeds: Sequence[int | None],
        options: dict[str, Any] | None = None,
    ) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Start an episode in R worlds: observations (R, N, D), infos as arrays (R, N, ...)."""

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, np.ndarray]]:
        """Step all worlds without any reset; all that is returned is fresh.

        :param actions: shape (W, N, ...)
        :return: observations (W, N, D), rewards (W, N), terminated (W,), truncated (W,), infos as
            arrays (W, N, ...)
        """

    def render(self, world: int) -> np.ndarray:
        """Picture of one world, uint8 (height, width, 3)."""

    def close(self) -> None:
        """Release what the simulator holds."""


class Step(NamedTuple):
    """One step of all worlds; ``reset_infos`` has the slots that began a new episode."""

    observations: Any  # (S, ...)
    rewards: np.ndarray  # (S,) float32
    terminated: np.ndarray  # (S,) bool
    truncated: np.ndarray  # (S,) bool
    infos: Infos  # S own dicts
    reset_infos: dict[int, dict[str, Any]]


class Worlds(ABC):
    """W worlds that are stepped together and begin a new episode by themselves.

    :param n_worlds: W
    :param like: a world or simulator with the agents and spaces of all
    """

    failed = False
    shared_owner = False  # whether one object holds the attributes of all worlds

    def __init__(self, n_worlds: int, like: Any):
        self.n_worlds = n_worlds
        self.agents = list(like.possible_agents)
        self.observation_space = as_float32(like.observation_space(self.agents[0]))
        self.action_space = like.action_space(self.agents[0])
        self.render_mode: str | None = like.render_mode
        self.metadata: dict[str, Any] = like.metadata

    @abstractmethod
    def reset(self, seeds: Sequence[int | None], options: Infos) -> tuple[Any, Infos]:
        """Reset all worlds, given one seed and one dict of options for each of them."""

    @abstractmethod
    def step_async(self, actions: np.ndarray) -> None:
        """Begin a step, actions (S, ...)."""

    @abstractmethod
    def step_wait(self) -> Step:
        """Finish the step."""

    @abstractmethod
    def images(self) -> list[Any]:
        """Render every world, W results."""

    @abstractmethod
    def owner(self, world: int) -> Any:
        """Object that holds the attributes of a world."""

    @abstractmethod
    def close(self) -> None:
        """Release all worlds."""


class BatchedWorlds(Worlds):
    """All worlds in one simulator; picklable with their whole state if the simulator is."""

    shared_owner = True

    def __init__(self, sim: BatchedSimulator):
        super().__init__(sim.n_worlds, sim)
        self.sim = sim

    @override
    def reset(self, seeds: Sequence[int | None], options: Infos) -> tuple[np.ndarray, Infos]:
        return begun(reset_all(self.sim, seeds, options))

    @override
    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions.reshape(self.n_worlds, len(self.agents), *actions.shape[1:])

    @override
    def step_wait(self) -> Step:
        observations, rewards, terminated, truncated, columns = self.sim.step(self._actions)
        shape = (self.n_worlds, len(self.agents))
        assert observations.shape[:2] == rewards.shape == shape, "sim.step returns (W, N, ...)"
        step = batched_step(observations, rewards, terminated, truncated, columns)
        ended = np.flatnonzero(terminated | truncated)
        if len(ended):
            begin(step, ended, *self.sim.reset(ended, [None] * len(ended), None))
        return step

    @override
    def images(self) -> list[Any]:
        return [self.sim.render(world) for world in range(self.n_worlds)]

    @override
    def owner(self, world: int) -> Any:
        return self.sim

    @override
    def close(self) -> None:
        self.sim.close()


class SuperSuitWorlds(Worlds):
    """One PettingZoo environment for each world, flattened by SuperSuit in this process.

    :param envs: W environments
    :param new_world: makes a world of an environment and its number
    """

    def __init__(self, envs: list[ParallelEnv], new_world: NewWorld = World):
        check_distinct(envs)
        super().__init__(len(envs), new_world(envs[0], 0))
        self.envs = envs
        makers = [partial(_rows_of, new_world, env, world) for world, env in enumerate(envs)]
        self.vec = self._build(makers, 1)

    def _build(self, makers: Sequence[Callable[[], Any]], n_processes: int) -> Any:
        constructor = MakeCPUAsyncConstructor(n_processes)
        return constructor(makers, self.observation_space, self.action_space)

    @override
    def reset(self, seeds: Sequence[int | None], options: Infos) -> tuple[Any, Infos]:
        observations, infos = self.vec.reset(options={"seeds": list(seeds), "options": options})
        return observations, [info[RESET_INFO] for info in infos]

    @override
    def step_async(self, actions: np.ndarray) -> None:
        self.vec.step_async(actions)

    @override
    def step_wait(self) -> Step:
        observations, rewards, terminated, truncated, infos = self.vec.step_wait()
        # Empty infos of worker processes are all one and the same dict.
        infos = [dict(info) for info in infos]
        reset_infos = {
            slot: info.pop(RESET_INFO) for slot, info in enumerate(infos) if RESET_INFO in info
        }
        return Step(
            observations,
            rewards,
            terminated.astype(bool),
            truncated.astype(bool),
            infos,
            reset_infos,
        )

    @override
    def images(self) -> list[Any]:
        return [env.render() for env in self.envs]

    @override
    def owner(self, world: int) -> Any:
        return self.envs[world].unwrapped

    @override
    def close(self) -> None:
        self.vec.close()


class WorkerWorlds(SuperSuitWorlds):
    """SuperSuit's worlds divided among worker processes.

    :param make_env: makes the worlds inside the workers
    :param examples: environments of this process, only looked at
    :param n_worlds: W
    :param n_processes: number of workers
    :param new_world: makes a world of an environment and its number
    """

    def __init__(
        self,
        make_env: MakeEnv,
        examples: list[ParallelEnv],
        n_worlds: int,
        n_processes: int,
        new_world: NewWorld = World,
    ):
        check_distinct(examples)
        Worlds.__init__(self, n_worlds, new_world(examples[0], 0))
        for env in examples:
            env.close()
        makers = [partial(_make_rows, new_world, make_env, world) for world in range(n_worlds)]
        others = set(multiprocessing.active_children())
        try:
            self.vec = self._build(makers, n_processes)
        except BaseException:
            _kill([p for p in multiprocessing.active_children() if p not in others])
            raise
        # Workers still alive at the interpreter's exit would be waited for, without end.
        atexit.register(_close_if_alive, weakref.ref(self))

    @override
    def reset(self, seeds: Sequence[int | None], options: Infos) -> tuple[Any, Infos]:
        with self._answering():
            payload = {"seeds": list(seeds), "options": options}
            observations, packed = self.vec.reset(options=payload)
        infos = decompress_info(self.vec.num_envs, self.vec.idx_starts, packed)
        return observations, [info[RESET_INFO] for info in infos]

    @override
    def step_async(self, actions: np.ndarray) -> None:
        with self._answering():
            super().step_async(actions)

    @override
    def step_wait(self) -> Step:
        with self._answering():
            return super().step_wait()

    @contextmanager
    def _answering(self) -> Iterator[None]:
        """Turn a broken pipe into the news that a worker died; stop all workers on any error."""
        try:
            yield
        except BaseException as error:
            self.failed = True
            dead = self._dead_workers() if isinstance(error, (EOFError, OSError)) else ""
            _kill(self.vec.procs)
            self.vec.close()
            if dead:
                raise RuntimeError(
                    f"{dead}; expected it to answer with its worlds' next observations. Look above "
                    "for its traceback and for lack of memory, try n_processes=1, and make the "
                    "environment again"
                ) from error
            raise

    def _dead_workers(self) -> str:
        """Name a worker that did not end by itself; a world's own exception ends it with code 0."""
        procs = self.vec.procs
        ended = multiprocessing.connection.wait([proc.sentinel for proc in procs], timeout=1.0)
        for number, proc in enumerate(procs):
            if proc.sentinel in ended:
                proc.join(timeout=1.0)  # its pipes close a moment before it has an exit code
            if proc.exitcode:
                first, end = (i // len(self.agents) for i in self.vec.idx_starts[number:][:2])
                return (
                    f"worker process {number} (worlds {first} to {end - 1}) ended with exit code "
                    f"{proc.exitcode}"
                )
        return ""

    @override
    def images(self) -> list[Any]:
        return [self.owner(0)]

    @override
    def owner(self, world: int) -> Any:
        raise AttributeError(
            f"world {world} lives in one of {len(self.vec.procs)} worker processes, where its "
            "attributes, methods and pictures are out of reach; use n_processes=1 for them"
        )

    @override
    def close(self) -> None:
        # SuperSuit's close() ends the workers by an error inside them, without closing the worlds.
        for pipe in self.vec.pipes:
            with suppress(OSError):
                pipe.send("close")
                pipe.send("terminate")
        deadline = time.monotonic() + _CLOSE_SECONDS
        for proc in self.vec.procs:
            proc.join(timeout=max(0.0, deadline - time.monotonic()))
        _kill(self.vec.procs)
        self.vec.close()


def _rows_of(new_world: NewWorld, env: ParallelEnv, world: int) -> Any:
    return ss.pettingzoo_env_to_vec_env_v1(new_world(env, world))


def _make_rows(new_world: NewWorld, make_env: MakeEnv, world: int) -> Any:
    return _rows_of(new_world, new_env(make_env), world)


def reset_all(sim: Any, seeds: Sequence[int | None], options: Infos) -> list[tuple[Any, Any]]:
    """Reset all worlds of a simulator, at once unless they get different options.

    :param sim: Its ``reset(worlds, seeds, options)`` is called
    :param seeds: One for each world
    :param options: One dict for each world
    :return: What the calls returned; together they hold all worlds in their order
    """
    worlds = np.arange(len(seeds))
    if all(option is options[0] for option in options) or not any(options):
        return [sim.reset(worlds, seeds, options[0] or None)]
    return [sim.reset(worlds[[w]], [seeds[w]], options[w] or None) for w in range(len(worlds))]


def begun(parts: Sequence[tuple[np.ndarray, dict[str, np.ndarray]]]) -> tuple[np.ndarray, Infos]:
    """Observations (S, D) and infos of all slots, from a simulator's resets.

    :param parts: See :func:`reset_all`
    """
    infos = [row for obs, columns in parts for row in _rows(columns, obs.shape[:2])]
    return _flat(np.concatenate([observations for observations, _ in parts])), infos


def batched_step(
    observations: np.ndarray,
    rewards: np.ndarray,
    terminated: np.ndarray,
    truncated: np.ndarray,
    columns: dict[str, np.ndarray],
) -> Step:
    """Slots from what a simulator's step returned; no episode has begun yet.

    :param observations: Shape (W, N, D); the step goes on to use this array
    :param rewards: Shape (W, N)
    :param terminated: Shape (W,)
    :param truncated: Shape (W,)
    :param columns: Arrays (W, N, ...)
    """
    n_agents = rewards.shape[1]
    return Step(
        _flat(observations),
        np.array(rewards, dtype=np.float32).reshape(-1),
        np.repeat(terminated, n_agents),
        np.repeat(truncated, n_agents),
        _rows(columns, rewards.shape),
        {},
    )


def begin(
    step: Step, ended: np.ndarray, observations: np.ndarray, columns: dict[str, np.ndarray]
) -> None:
    """Begin the next episode of some worlds within the step that ended the last one.

    :param step: Of all worlds; edited in place
    :param ended: Numbers of the R worlds
    :param observations: First ones of their next episodes, shape (R, N, D)
    :param columns: Infos of their resets, arrays (R, N, ...)
    """
    n_agents = observations.shape[1]
    slots = (ended[:, None] * n_agents + np.arange(n_agents)).ravel()
    for slot, last in zip(slots.tolist(), step.observations[slots], strict=True):
        step.infos[slot]["terminal_observation"] = last
    step.observations[slots] = _flat(observations)
    rows = _rows(columns, observations.shape[:2])
    step.reset_infos.update(zip(slots.tolist(), rows, strict=True))


def close_episodes(step: Step) -> np.ndarray:
    """Tell in the infos whether a time limit ended an episode, as Stable-Baselines3 does.

    :param step: Its infos are edited
    :return: Whether the episode of each slot has ended, shape (S,)
    """
    dones: np.ndarray = step.terminated | step.truncated
    timeouts = step.truncated & ~step.terminated
    for slot in np.flatnonzero(dones).tolist():
        step.infos[slot]["TimeLimit.truncated"] = bool(timeouts[slot])
    return dones


def _flat(array: np.ndarray) -> np.ndarray:
    """Worlds and agents as slots: (W, N, ...) becomes (S, ...)."""
    return array.reshape(-1, *array.shape[2:])


def _rows(columns: dict[str, np.ndarray], shape: tuple[int, ...]) -> Infos:
    """Infos of every slot, from arrays (W, N, ...): Python numbers and rows of arrays."""
    flat = [_flat(column) for column in columns.values()]
    lists = [column.tolist() if column.ndim == 1 else list(column) for column in flat]
    if not lists:
        return [{} for _ in range(int(np.prod(shape)))]
    if len(lists) == 1:  # several times faster than the general way, and the common case
        (name,) = columns
        return [{name: value} for value in lists[0]]
    return [dict(zip(columns, row, strict=True)) for row in zip(*lists, strict=True)]


def _kill(procs: list[Any]) -> None:
    for proc in procs:
        if proc.is_alive():
            proc.kill()
        proc.join()


def _close_if_alive(reference: "weakref.ref[WorkerWorlds]") -> None:
    worlds = reference()
    if worlds is not None:
        worlds.close()
