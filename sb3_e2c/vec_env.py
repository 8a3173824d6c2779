"""Parameter sharing: any PettingZoo parallel environment as one Stable-Baselines3 ``VecEnv``.

W worlds of N agents become S = W·N slots with slot = world·N + agent, so that
``observations.reshape(W, N, -1)`` is the joint view of every world.

    ParallelEnv ─► worlds.World ─► SuperSuit's rows ─► worlds.SuperSuitWorlds ─┐
    ParallelEnv.batched(W) ──────────────────────────► worlds.BatchedWorlds ───┴─► MultiAgentVecEnv
    with opponents, both ways: sides.Sides ─► opponents.OpponentWorlds ──────────► OpponentVecEnv

Both ways give the same trajectories for the same seeds. SuperSuit's own adapter to
Stable-Baselines3 is not used, because it loses seeds, time limits and the infos of an
episode's last step.
"""

import math
from collections.abc import Mapping, Sequence
from numbers import Integral, Real
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

from sb3_e2c.checks import check_answer, check_simulator, named_world
from sb3_e2c.constraints import TeamCost
from sb3_e2c.opponents import (
    LearningOpponents,
    Opponent,
    Opponents,
    OpponentWorlds,
    RandomOpponents,
    TrainedOpponents,
    check_fits,
    check_learns,
)
from sb3_e2c.sides import Side, make_sides
from sb3_e2c.world import MakeEnv, new_env, split_agents
from sb3_e2c.worlds import (
    BatchedWorlds,
    SuperSuitWorlds,
    WorkerWorlds,
    Worlds,
    close_episodes,
)

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
    team: Sequence[str] | None = None,
    timeout: float | None = 600.0,
) -> "MultiAgentVecEnv":
    """Make the worlds and give each agent of the team a row, so that all share one policy.

    One environment is made and reset first to look at its agents, spaces and infos.

    :param make_env: returns a new environment at every call
    :param n_worlds: number of worlds W
    :param n_processes: worker processes among which SuperSuit divides the worlds; 1 is this one
    :param seed: world w gets seed + w; None draws a seed from NumPy's global generator. As in
        Stable-Baselines3, a model that is made with a seed seeds its worlds anew with that
    :param backend: "batched" steps all worlds in one set of arrays and needs an environment with
        a method ``batched``; "supersuit" takes any environment; "auto" is "batched" where the
        environment offers it and one process is asked for
    :param team_return: "shared" if every agent receives the team's reward, "sum" if the team's is
        the sum over its agents; None reads ``env.metadata["team_return"]``, else "sum"
    :param team_cost: "sum" over the agents or "max" if all report one cost; None reads
        ``env.metadata["team_cost"]``, else "sum"
    :param team: names of the agents that are trained; None reads ``env.metadata["team"]``, else
        all. If there are others, they are opponents and the result is an :class:`OpponentVecEnv`
    :param timeout: seconds after which a worker process that does not answer is ended with an
        error; None waits without end. Worlds of this process (``n_processes=1``) cannot be
        interrupted: give an environment that may hang at least 2 processes
    :return: S = W·N slots, N being the size of the team
    """
    _check_request(make_env, n_worlds, n_processes, backend, seed)
    _check_timeout(timeout)
    example = new_env(make_env)
    members, opponents = split_agents(example, team)
    critic_state_dim = _critic_state_dim(example, members[0])
    rules = (critic_state_dim, team_return, team_cost)
    env: MultiAgentVecEnv
    if opponents:
        agents = (members, opponents)
        batched = _has_simulator(example, backend, n_processes, agents)
        sides = make_sides(make_env, example, agents, n_worlds, n_processes, timeout, batched)
        env = OpponentVecEnv(OpponentWorlds(sides), *rules)
    else:
        batched = _has_simulator(example, backend, n_processes)
        env = MultiAgentVecEnv(
            _make_worlds(make_env, example, n_worlds, n_processes, timeout, batched), *rules
        )
    env.seed(seed)
    return env


def _make_worlds(
    make_env: MakeEnv,
    example: Any,
    n_worlds: int,
    n_processes: int,
    timeout: float | None,
    batched: bool,
) -> Worlds:
    if batched:
        sim = check_simulator(example.batched(n_worlds), n_worlds, example.possible_agents)
        return BatchedWorlds(sim)
    if n_processes == 1:
        others = [new_env(make_env) for _ in range(n_worlds - 1)]
        return SuperSuitWorlds([example, *others])
    examples = [example, new_env(make_env)]
    return WorkerWorlds(make_env, examples, n_worlds, n_processes, timeout=timeout)


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
        dones = close_episodes(step)
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
        if self.worlds.shared_owner and n_named != self.n_worlds:
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


class OpponentVecEnv(MultiAgentVecEnv):
    """Worlds in which others act beside the team; made by :func:`share_parameters`.

    Only the team has slots. Somebody must be chosen to act for the opponents: ``MAPPO`` gives
    them a model of their own that learns beside the team, unless :meth:`set_opponent` was called.

    :param worlds: the team's slots
    :param critic_state_dim: see :class:`MultiAgentVecEnv`
    :param team_return: see :func:`share_parameters`
    :param team_cost: see :func:`share_parameters`
    """

    worlds: OpponentWorlds

    def __init__(
        self,
        worlds: OpponentWorlds,
        critic_state_dim: int = 0,
        team_return: TeamReturn | None = None,
        team_cost: TeamCost | None = None,
    ):
        super().__init__(worlds, critic_state_dim, team_return, team_cost)
        self.opponent: Opponent | None = None
        self.deterministic_opponent = False
        self.chosen = False  # whether by set_opponent, and not by an algorithm or an evaluation

    @property
    def opponents(self) -> Side:
        """Names and spaces of the opponents."""
        return self.worlds.sides.opponents

    @property
    def learner(self) -> LearningOpponents | None:
        """Who learns for the opponents, if anybody does."""
        acting = self.worlds.opponents
        return acting if isinstance(acting, LearningOpponents) else None

    def set_opponent(
        self, opponent: Opponent, learning: bool = False, deterministic: bool = False
    ) -> None:
        """Choose who acts for the opponents, from the next step on.

        :param opponent: "random", or a model with Stable-Baselines3's ``predict`` that fits their
            spaces, such as ``model.opponent`` of a trained team
        :param learning: whether it learns beside the team; it must come from
            ``MAPPO.new_opponent``, and a ``MAPPO`` must train the team
        :param deterministic: whether it takes the most likely actions; never while it learns
        """
        self.attach(opponent, learning, deterministic)
        self.chosen = True

    def attach(
        self, opponent: Opponent, learning: bool = False, deterministic: bool = False
    ) -> None:
        """Let somebody act as long as nobody is chosen; for algorithms and evaluations.

        :param opponent: see :meth:`set_opponent`
        :param learning: see :meth:`set_opponent`
        :param deterministic: see :meth:`set_opponent`
        """
        acting: Opponents
        if isinstance(opponent, str):
            if opponent != "random" or learning:
                kind = (
                    "a model that learns"
                    if learning
                    else "'random' or a model, such as MAPPO.load('team.adversary.zip')"
                )
                raise ValueError(f"opponent is {opponent!r}; expected {kind}")
            acting = RandomOpponents(self.opponents, self.n_worlds)
        elif not hasattr(opponent, "predict"):
            raise TypeError(f"opponent is {opponent!r}; expected 'random' or a model")
        elif learning:
            check_learns(opponent, self.opponents, self.n_worlds)
            acting = LearningOpponents(self.opponents, self.n_worlds, opponent)
        else:
            check_fits(opponent, self.opponents)
            acting = TrainedOpponents(self.opponents, self.n_worlds, opponent, deterministic)
        self.opponent, self.deterministic_opponent = opponent, deterministic
        self.worlds.let_act(acting)


def opponent_env(env: Any) -> OpponentVecEnv | None:
    """The environment with opponents below all wrappers, if it has any.

    :param env: given by the user
    """
    flat = env.unwrapped if isinstance(env, VecEnv) else None
    return flat if isinstance(flat, OpponentVecEnv) else None


def _has_simulator(
    env: ParallelEnv,
    backend: Backend,
    n_processes: int,
    sides: tuple[list[str], list[str]] | None = None,
) -> bool:
    """Whether to use the environment's batched simulator."""
    # Of the class itself: a wrapper passes its environment's method on, and would be left out.
    method = "batched" if sides is None else "batched_groups"
    offered = callable(getattr(type(env), method, None))
    if offered and sides is not None:  # its groups are the environment's own
        offered = split_agents(env, None) == sides
    if backend == "batched" and not offered:
        whose = "" if sides is None else f" for the team {sides[0]}"
        raise ValueError(
            f"backend is 'batched', but {type(env).__name__} has no method {method}(n_worlds)"
            f"{whose}; expected an environment that defines it, without wrappers. Use "
            "backend='supersuit'"
        )
    return offered and backend != "supersuit" and n_processes == 1


def _critic_state_dim(env: ParallelEnv, agent: str) -> int:
    """Size of ``info["critic_state"]``, 0 where there is none."""
    with named_world("reset", 0):
        answer = env.reset(seed=0)
    _, infos = check_answer("reset", answer, 0)
    info = infos.get(agent, {})
    state = info.get("critic_state", ()) if isinstance(info, Mapping) else ()
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


def _check_timeout(timeout: float | None) -> None:
    if timeout is None:
        return
    if not isinstance(timeout, Real) or isinstance(timeout, bool) or not 0 < timeout < math.inf:
        raise ValueError(
            f"timeout is {timeout!r}; expected seconds above 0, or None to wait without end"
        )


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
        if isinstance(number, bool) or not isinstance(number, Integral):
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
