"""The worlds behind a :class:`~sb3_e2c.vec_env.MultiAgentVecEnv`, in one of two ways.

    ParallelEnv ─► World ─► SuperSuit's rows ─► SuperSuitWorlds, WorkerWorlds ─┐
    ParallelEnv.batched(W) ───────────────────► BatchedWorlds ─────────────────┴─► Step

Both give the same trajectories for the same seeds. W worlds of N agents are S = W·N slots,
slot = world·N + agent; a world begins its next episode within the step that ends the last one.
"""

import atexit
import multiprocessing
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

from sb3_e2c.checks import (
    Form,
    as_type,
    check_array,
    check_fresh,
    check_parts,
)
from sb3_e2c.workers import WorkerProcesses, is_of_a_world, kill
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
        self._form = Form(self.n_worlds, len(self.agents), self.observation_space)
        self._last: np.ndarray | None = None  # observations of the last step

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_last": None}

    @override
    def reset(self, seeds: Sequence[int | None], options: Infos) -> tuple[np.ndarray, Infos]:
        return begun(reset_all(self.sim, seeds, options), self._form)

    @override
    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions.reshape(self.n_worlds, len(self.agents), *actions.shape[1:])

    @override
    def step_wait(self) -> Step:
        answer = check_parts("step", self.sim.step(self._actions), 5)
        self._last = check_fresh(answer[0], self._last)
        step = batched_step(self._form, *answer)
        ended = ended_worlds(step, len(self.agents))
        if len(ended):
            first = self.sim.reset(ended, [None] * len(ended), None)
            begin(step, ended, self._form, *check_parts("reset", first, 2))
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
        constructor = MakeCPUAsyncConstructor(1)
        self.vec: Any = constructor(makers, self.observation_space, self.action_space)

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
    :param timeout: seconds to wait for a worker's answer; None waits without end
    """

    def __init__(
        self,
        make_env: MakeEnv,
        examples: list[ParallelEnv],
        n_worlds: int,
        n_processes: int,
        new_world: NewWorld = World,
        timeout: float | None = None,
    ):
        check_distinct(examples)
        Worlds.__init__(self, n_worlds, new_world(examples[0], 0))
        for env in examples:
            env.close()
        makers = [partial(_make_rows, new_world, make_env, world) for world in range(n_worlds)]
        others = set(multiprocessing.active_children())
        try:
            self.vec = WorkerProcesses(makers, n_processes, self, timeout)
        except BaseException:
            kill([p for p in multiprocessing.active_children() if p not in others])
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
        """Stop all workers on any error, and say which has died if a message cannot be sent."""
        try:
            yield
        except BaseException as error:
            self.failed = True
            unsent = isinstance(error, ConnectionError) and not is_of_a_world(error)
            death = self.vec.a_death() if unsent else None
            kill(self.vec.procs)
            self.vec.close()
            if death is not None:
                raise death from error
            raise

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
        kill(self.vec.procs)
        self.vec.close()


def _rows_of(new_world: NewWorld, env: ParallelEnv, world: int) -> Any:
    return ss.pettingzoo_env_to_vec_env_v1(new_world(env, world))


def _make_rows(new_world: NewWorld, make_env: MakeEnv, world: int) -> Any:
    return _rows_of(new_world, new_env(make_env), world)


def reset_all(sim: Any, seeds: Sequence[int | None], options: Infos) -> list[tuple[Any, ...]]:
    """Reset all worlds of a simulator, at once unless they get different options.

    :param sim: Its ``reset(worlds, seeds, options)`` is called
    :param seeds: One for each world
    :param options: One dict for each world
    :return: What the calls returned; together they hold all worlds in their order
    """
    worlds = np.arange(len(seeds))
    if all(option is options[0] for option in options) or not any(options):
        return [check_parts("reset", sim.reset(worlds, seeds, options[0] or None), 2)]
    answers = (sim.reset(worlds[[w]], [seeds[w]], options[w] or None) for w in worlds.tolist())
    return [check_parts("reset", answer, 2) for answer in answers]


def ended_worlds(step: Step, n_agents: int) -> np.ndarray:
    """Numbers of the worlds whose episode ended.

    :param step: of all worlds
    :param n_agents: N
    """
    return (step.terminated | step.truncated)[::n_agents].nonzero()[0]


def begun(parts: Sequence[tuple[Any, ...]], form: Form) -> tuple[np.ndarray, Infos]:
    """Observations (S, D) and infos of all slots, from a simulator's resets.

    :param parts: See :func:`reset_all`
    :param form: What all of them together must be like
    """
    n_worlds = form.n_worlds // len(parts)
    arrays = [form.observations("reset", found, n_worlds) for found, _ in parts]
    infos = [row for _, columns in parts for row in _rows("reset", columns, n_worlds, form)]
    return _flat(np.concatenate(arrays)), infos


def batched_step(
    form: Form,
    observations: np.ndarray,
    rewards: np.ndarray,
    terminated: np.ndarray,
    truncated: np.ndarray,
    columns: dict[str, np.ndarray],
) -> Step:
    """Slots from what a simulator's step returned; no episode has begun yet.

    :param form: What the arrays must be like
    :param observations: Shape (W, N, D); the step goes on to use this array
    :param rewards: Shape (W, N)
    :param terminated: Shape (W,)
    :param truncated: Shape (W,)
    :param columns: Arrays (W, N, ...)
    """
    n_worlds, n_agents, _ = form
    ends = {"terminated": terminated, "truncated": truncated}
    for name, flags in ends.items():
        if check_array("step", name, flags, (n_worlds,)).dtype != bool:
            raise ValueError(
                f"step() of the simulator returned {name} of type {flags.dtype}; expected bool"
            )
    check_array("step", "rewards", rewards, (n_worlds, n_agents))
    paid = as_type(rewards, np.float32)
    if paid is None:
        raise ValueError(
            f"step() of the simulator returned rewards of type {rewards.dtype}; expected numbers"
        )
    return Step(
        _flat(form.observations("step", observations, n_worlds)),
        np.array(paid).reshape(-1),
        terminated.repeat(n_agents),
        truncated.repeat(n_agents),
        _rows("step", columns, n_worlds, form),
        {},
    )


def begin(
    step: Step,
    ended: np.ndarray,
    form: Form,
    observations: np.ndarray,
    columns: dict[str, np.ndarray],
) -> None:
    """Begin the next episode of some worlds within the step that ended the last one.

    :param step: Of all worlds; edited in place
    :param ended: Numbers of the R worlds
    :param form: What the arrays must be like
    :param observations: First ones of their next episodes, shape (R, N, D)
    :param columns: Infos of their resets, arrays (R, N, ...)
    """
    n_agents = form.n_agents
    first = form.observations("reset", observations, len(ended))
    slots = (ended[:, None] * n_agents + np.arange(n_agents)).ravel()
    for slot, last in zip(slots.tolist(), step.observations[slots], strict=True):
        step.infos[slot]["terminal_observation"] = last
    step.observations[slots] = _flat(first)
    rows = _rows("reset", columns, len(ended), form)
    step.reset_infos.update(zip(slots.tolist(), rows, strict=True))


def _column(call: str, name: str, found: Any, shape: tuple[int, ...]) -> np.ndarray:
    """One of a simulator's infos, an array (W, N, ...)."""
    inner = found.shape[len(shape) :] if isinstance(found, np.ndarray) else ()
    return check_array(call, f"infos[{name!r}]", found, (*shape, *inner))


def close_episodes(step: Step) -> np.ndarray:
    """Tell in the infos whether a time limit ended an episode, as Stable-Baselines3 does.

    :param step: Its infos are edited
    :return: Whether the episode of each slot has ended, shape (S,)
    """
    dones: np.ndarray = step.terminated | step.truncated
    timeouts = step.truncated & ~step.terminated
    for slot in dones.nonzero()[0].tolist():
        step.infos[slot]["TimeLimit.truncated"] = bool(timeouts[slot])
    return dones


def _flat(array: np.ndarray) -> np.ndarray:
    """Worlds and agents as slots: (W, N, ...) becomes (S, ...)."""
    return array.reshape(-1, *array.shape[2:])


def _rows(call: str, columns: dict[str, np.ndarray], n_worlds: int, form: Form) -> Infos:
    """Infos of every slot, from arrays (W, N, ...): Python numbers and rows of arrays."""
    shape = (n_worlds, form.n_agents)
    if not isinstance(columns, dict):
        raise ValueError(f"{call}() of the simulator returned infos {columns!r}; expected a dict")
    flat = [_flat(_column(call, name, column, shape)) for name, column in columns.items()]
    lists = [column.tolist() if column.ndim == 1 else list(column) for column in flat]
    if not lists:
        return [{} for _ in range(n_worlds * form.n_agents)]
    if len(lists) == 1:  # several times faster than the general way, and the common case
        (name,) = columns
        return [{name: value} for value in lists[0]]
    return [dict(zip(columns, row, strict=True)) for row in zip(*lists, strict=True)]


def _close_if_alive(reference: "weakref.ref[WorkerWorlds]") -> None:
    worlds = reference()
    if worlds is not None:
        worlds.close()
