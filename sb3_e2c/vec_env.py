"""Parameter sharing: any PettingZoo parallel environment as one Stable-Baselines3 ``VecEnv``.

W worlds of N agents become S = W·N slots with slot = world·N + agent, so that
``observations.reshape(W, N, -1)`` is the joint view of every world.

    ParallelEnv ─► worlds.World ─► SuperSuit's rows ─► worlds.SuperSuitWorlds ─┐
    ParallelEnv.batched(W) ──────────────────────────► worlds.BatchedWorlds ───┴─► MultiAgentVecEnv

Both ways give the same trajectories for the same seeds. SuperSuit's own adapter to
Stable-Baselines3 is not used, because it loses seeds, time limits and the infos of an
episode's last step.
"""

from collections.abc import Sequence
from numbers import Integral
from typing import Any, Literal, get_args

import gymnasium as gym
import numpy as np
from pettingzoo import ParallelEnv
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import (
    VecEnvIndices,
    VecEnvObs,
    VecEnvStepReturn,
)

from sb3_e2c.constraints import TeamCost
from sb3_e2c.world import MakeEnv, new_env
from sb3_e2c.worlds import BatchedWorlds, SuperSuitWorlds, WorkerWorlds, Worlds

Backend = Literal["auto", "supersuit", "batched"]
TeamReturn = Literal["shared", "sum"]


def share_parameters(
    make_env: MakeEnv,
    n_worlds: int = 16,
    n_processes: int = 1,
    seed: int | None = 0,
    backend: Backend = "auto",
    team_return: TeamReturn | None = None,
    team_cost: TeamCost | None = None,
) -> "MultiAgentVecEnv":
    """Make the worlds and give each of their agents a row, so that all share one policy.

    One environment is made and reset first to look at its agents, spaces and infos.

    :param make_env: returns a new environment at every call
    :param n_worlds: number of worlds W
    :param n_processes: worker processes among which SuperSuit divides the worlds; 1 is this one
    :param seed: world w gets seed + w; None draws a seed from NumPy's global generator
    :param backend: "batched" steps all worlds in one set of arrays and needs an environment with
        a method ``batched``; "supersuit" takes any environment; "auto" is "batched" where the
        environment offers it and one process is asked for
    :param team_return: "shared" if every agent receives the team's reward, "sum" if the team's is
        the sum over its agents; None reads ``env.metadata["team_return"]``, else "sum"
    :param team_cost: "sum" over the agents or "max" if all report one cost; None reads
        ``env.metadata["team_cost"]``, else "sum"
    :return: S = W·N slots
    """
    _check_request(make_env, n_worlds, n_processes, backend, seed)
    example = new_env(make_env)
    critic_state_dim = _critic_state_dim(example)
    worlds: Worlds
    if _is_batched(example, backend, n_processes):
        worlds = BatchedWorlds(example.batched(n_worlds))
    elif n_processes == 1:
        others = [new_env(make_env) for _ in range(n_worlds - 1)]
        worlds = SuperSuitWorlds([example, *others])
    else:
        worlds = WorkerWorlds(make_env, [example, new_env(make_env)], n_worlds, n_processes)
    env = MultiAgentVecEnv(worlds, critic_state_dim, team_return, team_cost)
    env.seed(seed)
    return env


class MultiAgentVecEnv(VecEnv):
    """Worlds of N agents each, as S = W·N slots; made by :func:`share_parameters`.

    Seeds belong to worlds. What Stable-Baselines3 addresses per environment (``get_attr``,
    ``set_attr``, ``env_method``) is answered for a slot by ``env.unwrapped`` of its world; a
    batched simulator answers for all of its worlds at once.

    :param worlds: the backend
    :param critic_state_dim: size of ``info["critic_state"]``, 0 where there is none
    :param team_return: see :func:`share_parameters`
    :param team_cost: see :func:`share_parameters`
    """

    def __init__(
        self,
        worlds: Worlds,
        critic_state_dim: int = 0,
        team_return: TeamReturn | None = None,
        team_cost: TeamCost | None = None,
    ):
        self.worlds = worlds
        self.n_worlds, self.n_agents = worlds.n_worlds, len(worlds.agents)
        self.agents = worlds.agents
        self.critic_state_dim = critic_state_dim
        self.team_return = _team_rule("team_return", team_return, worlds.metadata, TeamReturn)
        self.team_cost = _team_rule("team_cost", team_cost, worlds.metadata, TeamCost)
        self._closed = False
        n_slots = self.n_worlds * self.n_agents
        super().__init__(n_slots, worlds.observation_space, worlds.action_space)
        self.metadata = worlds.metadata

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seed the worlds at their next reset: world w gets seed + w.

        :param seed: None draws one from NumPy's global generator
        :return: the seed of every slot's world, shape (S,)
        """
        first = super().seed(seed)[0]
        assert first is not None
        self._seeds = [first + slot // self.n_agents for slot in range(self.num_envs)]
        return self._seeds

    def set_options(self, options: list[dict] | dict | None = None) -> None:
        """Pass options to the worlds at their next reset, and only there.

        :param options: the same for all, or one dict for each slot; a world takes its first slot's
        """
        if isinstance(options, list) and len(options) != self.num_envs:
            raise ValueError(
                f"options is a list of {len(options)}; expected one dict, or one for each of the "
                f"{self.num_envs} slots ({self.n_worlds} worlds of {self.n_agents} agents)"
            )
        super().set_options(options)

    def reset(self) -> VecEnvObs:
        """Start a new episode in every world.

        :return: observations, shape (S, ...)
        """
        self._check_open()
        every = self.n_agents
        observations, self.reset_infos = self.worlds.reset(
            self._seeds[::every], self._options[::every]
        )
        self._reset_seeds()
        self._reset_options()
        return observations

    def step_async(self, actions: np.ndarray) -> None:
        """Give the actions of a step to the worlds.

        :param actions: shape (S, ...)
        """
        self._check_open()
        actions = np.asarray(actions)
        if len(actions) != self.num_envs:
            raise ValueError(
                f"actions have shape {actions.shape}; expected {self.num_envs} rows, one for each "
                f"agent of each world ({self.n_worlds} worlds of {self.n_agents} agents)"
            )
        self.worlds.step_async(actions)

    def step_wait(self) -> VecEnvStepReturn:
        """Finish the step; worlds whose episode ended have begun the next one.

        :return: observations (S, ...), rewards (S,), dones (S,) and infos (S,)
        """
        step = self.worlds.step_wait()
        dones = step.terminated | step.truncated
        timeouts = step.truncated & ~step.terminated
        for slot in np.flatnonzero(dones).tolist():
            step.infos[slot]["TimeLimit.truncated"] = bool(timeouts[slot])
        for slot, info in step.reset_infos.items():
            self.reset_infos[slot] = info
        return step.observations, step.rewards, dones, step.infos

    def close(self) -> None:
        """Close the worlds and end the worker processes; further calls do nothing."""
        if not self._closed:
            self._closed = True
            self.worlds.close()

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Pictures of the worlds, one for each world and not for each slot."""
        return self.worlds.images()

    def render(self, mode: str | None = None) -> np.ndarray | None:
        """Show every world once; see ``VecEnv.render``."""
        if self.render_mode == "human":
            self.worlds.images()
            return None
        return super().render(mode)

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Attribute of each slot's world; see ``VecEnv.get_attr``."""
        slots = list(self._get_indices(indices))
        if attr_name in ("render_mode", "metadata"):  # known also where worlds are out of reach
            return [getattr(self.worlds, attr_name) for _ in slots]
        return [getattr(self._owner(slot), attr_name) for slot in slots]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of the slots' worlds; see ``VecEnv.set_attr``."""
        slots = list(self._get_indices(indices))
        n_named = len({slot // self.n_agents for slot in slots})
        if isinstance(self.worlds, BatchedWorlds) and n_named != self.n_worlds:
            raise ValueError(
                f"set_attr({attr_name!r}) names {n_named} of {self.n_worlds} worlds, but batched "
                "worlds share their attributes; set it for all, or use backend='supersuit'"
            )
        for slot in slots:
            setattr(self._owner(slot), attr_name, value)

    def env_method(
        self,
        method_name: str,
        *method_args: Any,
        indices: VecEnvIndices = None,
        **method_kwargs: Any,
    ) -> list[Any]:
        """Call a method once for each world; its slots share the result."""
        owners = [self._owner(slot) for slot in self._get_indices(indices)]
        results = {
            owner_id: getattr(owner, method_name)(*method_args, **method_kwargs)
            for owner_id, owner in {id(owner): owner for owner in owners}.items()
        }
        return [results[id(owner)] for owner in owners]

    def env_is_wrapped(
        self,
        wrapper_class: type[gym.Wrapper],  # noqa: ARG002
        indices: VecEnvIndices = None,
    ) -> list[bool]:
        """False for each slot: worlds are never inside gymnasium wrappers."""
        return [False for _ in self._get_indices(indices)]

    def _owner(self, slot: int) -> Any:
        return self.worlds.owner(range(self.num_envs)[slot] // self.n_agents)

    def _check_open(self) -> None:
        if self._closed or self.worlds.failed:
            state = "closed" if self._closed else "stopped by an earlier error in a worker process"
            raise RuntimeError(f"this MultiAgentVecEnv is {state}; make a new one")


def _is_batched(env: ParallelEnv, backend: Backend, n_processes: int) -> bool:
    """Whether to use the environment's batched simulator."""
    # Of the class itself: a wrapper passes its environment's method on, and would be left out.
    offered = callable(getattr(type(env), "batched", None))
    if backend == "batched" and not offered:
        raise ValueError(
            f"backend is 'batched', but {type(env).__name__} has no method batched(n_worlds); "
            "expected an environment that defines it, without wrappers. Use backend='supersuit'"
        )
    return offered and backend != "supersuit" and n_processes == 1


def _critic_state_dim(env: ParallelEnv) -> int:
    """Size of ``info["critic_state"]``, 0 where there is none."""
    _, infos = env.reset(seed=0)
    state = infos.get(env.possible_agents[0], {}).get("critic_state", ())
    if np.ndim(state) != 1:
        raise ValueError(
            f"info['critic_state'] has shape {np.shape(state)}; expected one dimension, flatten it"
        )
    return len(state)


def _team_rule(name: str, rule: str | None, metadata: dict[str, Any], kind: Any) -> str:
    rule = metadata.get(name, "sum") if rule is None else rule
    if rule not in get_args(kind):
        raise ValueError(
            f"{name} is {rule!r}; expected one of {get_args(kind)}, as an argument of "
            "share_parameters or in the environment's metadata"
        )
    return rule


def _check_request(
    make_env: Any, n_worlds: int, n_processes: int, backend: str, seed: int | None
) -> None:
    if not callable(make_env):
        raise TypeError(
            f"make_env is an object of type {type(make_env).__name__}; expected a function that "
            "makes a new environment at every call, such as "
            "lambda: multi_rover_v0.parallel_env(n_rovers=6)"
        )
    for name, number in (("n_worlds", n_worlds), ("n_processes", n_processes)):
        if not isinstance(number, Integral):
            raise TypeError(f"{name} is {number!r}; expected a whole number")
    if seed is not None and (not isinstance(seed, Integral) or seed < 0):
        raise ValueError(f"seed is {seed!r}; expected a whole number of at least 0, or None")
    if n_worlds < 1:
        raise ValueError(f"n_worlds is {n_worlds}; expected at least 1 world")
    if not 1 <= n_processes <= n_worlds:
        raise ValueError(
            f"n_processes is {n_processes} for {n_worlds} worlds; expected 1 (this process) to "
            f"{n_worlds} (one process for each world)"
        )
    if backend not in get_args(Backend):
        raise ValueError(f"backend is {backend!r}; expected one of {get_args(Backend)}")
    if backend == "batched" and n_processes > 1:
        raise ValueError(
            f"n_processes is {n_processes} with backend='batched', which runs all worlds in one "
            "process; use n_processes=1, or backend='supersuit'"
        )
