"""One world as SuperSuit needs it, and what an environment must be like to become one."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from pettingzoo import AECEnv, ParallelEnv
from pettingzoo.utils import BaseParallelWrapper
from typing_extensions import override

from sb3_e2c.checks import check_answer, described, fitting, named_world, number

MakeEnv = Callable[[], ParallelEnv]

# SuperSuit lays the infos of a reset over those of the step before it; under a key of their own
# both arrive.
RESET_INFO = "_reset_info"


class World(BaseParallelWrapper):
    """A world as SuperSuit needs it: agents in one order, own infos, its own seed and options.

    :param env: environment whose agents all end in the same step
    :param index: number of the world
    :raises ValueError: if its agents cannot share one policy
    """

    def __init__(self, env: ParallelEnv, index: int):
        super().__init__(env)
        self.index = index
        self.possible_agents = self._order(list(env.possible_agents))
        self.agents = list(self.possible_agents)  # SuperSuit resets before it looks again
        self.metadata = getattr(env, "metadata", {})
        # Multi-agent MuJoCo keeps the mode in the robot's environment only.
        robot = getattr(env.unwrapped, "single_agent_env", None)
        self.render_mode = getattr(env, "render_mode", None) or getattr(robot, "render_mode", None)
        self._space, self._action_space = self._common_spaces()
        self._own_spaces = {a: as_float32(env.observation_space(a)) for a in self.agents}

    def _order(self, agents: list[str]) -> list[str]:
        """The order of the rows."""
        return agents

    def _common_spaces(self) -> tuple[spaces.Space, spaces.Space]:
        """Observation and action space of every row."""
        check_spaces(self.env, self.agents)
        first = self.agents[0]
        return as_float32(self.env.observation_space(first)), self.env.action_space(first)

    @property
    @override
    def unwrapped(self) -> ParallelEnv:
        # SuperSuit reads unwrapped.render_mode, which not every environment has.
        return self

    @override
    def observation_space(self, agent: str) -> spaces.Space:
        return self._space

    @override
    def action_space(self, agent: str) -> spaces.Space:
        return self._action_space

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
        """Reset, with what is meant for this world if the reset is not an automatic one."""
        if options is not None:
            seed, own = options["seeds"][self.index], options["options"][self.index]
            options = own or None
        with named_world("reset", self.index):
            answer = self.env.reset(seed=seed, options=options)
        observations, infos = check_answer("reset", answer, self.index)
        self._check_agents("reset", observations=observations)
        own_infos = {a: {RESET_INFO: self._own_info(infos, a)} for a in self.agents}
        return self._observations(observations), own_infos

    def step(self, actions: dict[str, Any]) -> tuple[dict, dict, dict, dict, dict]:
        """Step, and refuse what does not fit one row for each agent."""
        with named_world("step", self.index):
            answer = self.env.step(actions)
        observations, rewards, terminated, truncated, infos = check_answer(
            "step", answer, self.index
        )
        self._check_agents(
            "step",
            observations=observations,
            rewards=rewards,
            terminations=terminated,
            truncations=truncated,
        )
        terminated = self._ends("termination", terminated)
        truncated = self._ends("truncation", truncated)
        self._check_end(terminated, truncated)
        return (
            self._observations(observations),
            {agent: self._reward(agent, rewards[agent]) for agent in self.agents},
            terminated,
            truncated,
            {agent: self._own_info(infos, agent) for agent in self.agents},
        )

    def _observations(self, observations: Mapping[str, Any]) -> dict[str, Any]:
        return {agent: self._observation(agent, observations[agent]) for agent in self.agents}

    def _observation(self, agent: str, found: Any) -> Any:
        """An agent's observation in its space's type, as a copy if it is an array."""
        space = self._own_spaces[agent]
        observation = fitting(found, space)
        if observation is None:
            raise ValueError(
                f"the observation of world {self.index}, agent {agent!r} is {described(found)}; "
                f"expected one of its space {space}. Mend the environment or observation_space()"
            )
        return observation

    def _reward(self, agent: str, found: Any) -> np.float32:
        reward = number(found)
        if reward is None:
            raise ValueError(
                f"the reward of world {self.index}, agent {agent!r} is {described(found)}; "
                "expected one number for each agent"
            )
        with np.errstate(over="ignore"):  # too large ones become infinite, which learners refuse
            return np.float32(reward)

    def _ends(self, kind: str, answers: Mapping[str, Any]) -> dict[str, bool]:
        for agent in self.agents:
            if number(answers[agent]) not in (0, 1):
                raise ValueError(
                    f"the {kind} of world {self.index}, agent {agent!r} is "
                    f"{described(answers[agent])}; expected True or False"
                )
        return {agent: bool(answers[agent]) for agent in self.agents}

    def _own_info(self, infos: Mapping[str, Any], agent: str) -> dict[str, Any]:
        found = infos.get(agent, {})
        if not isinstance(found, Mapping):
            raise ValueError(
                f"the info of world {self.index}, agent {agent!r} is {described(found)}; expected "
                "a dict, or none of this agent"
            )
        info = dict(found)
        info.pop("TimeLimit.truncated", None)  # patched wrappers set it; the VecEnv decides it
        return info

    def _check_agents(self, call: str, **answers: Mapping[str, Any]) -> None:
        missing = {a: None for answer in answers.values() for a in self.agents if a not in answer}
        if missing:
            kinds = [kind for kind, answer in answers.items() if not set(missing) <= set(answer)]
            raise ValueError(
                f"{call}() of world {self.index} returned {' and '.join(kinds)} with nothing for "
                f"the agents {list(missing)}; expected all of {self.agents}, because each has a "
                "slot of its own until all end together. Keep ended agents in the environment "
                "(reward and cost of zero, any observation)"
            )

    def _check_end(self, terminated: Mapping[str, bool], truncated: Mapping[str, bool]) -> None:
        ended = [agent for agent in self.agents if terminated[agent] or truncated[agent]]
        if 0 < len(ended) < len(self.agents):
            others = [agent for agent in self.agents if agent not in ended]
            raise ValueError(
                f"the agents {ended} of world {self.index} ended while {others} go on; expected "
                "all agents of a world to end in the same step. Keep ended agents in the "
                "environment (reward and cost of zero, any observation), or end the episode for all"
            )


def as_float32(space: spaces.Space) -> spaces.Space:
    """The same space in float32 if it is a box of float64, which SB3's buffers would keep."""
    if not isinstance(space, spaces.Box) or space.dtype != np.float64:
        return space
    with np.errstate(over="ignore"):  # the largest float64 becomes infinity, no bound at all
        return spaces.Box(space.low.astype(np.float32), space.high.astype(np.float32))


def new_env(make_env: MakeEnv) -> Any:
    """Make an environment and check that it is of the right kind.

    :param make_env: given by the user
    :return: a ``ParallelEnv`` that names its agents
    """
    env = make_env()
    hint = ""
    if isinstance(env, AECEnv):
        hint = "; convert it with pettingzoo.utils.conversions.aec_to_parallel(env)"
    elif isinstance(env, gym.Env):
        hint = "; a gymnasium environment has one agent, use SB3's make_vec_env for it"
    if not isinstance(env, ParallelEnv):
        raise TypeError(
            f"make_env returned an object of type {type(env).__name__}; expected a PettingZoo "
            f"ParallelEnv{hint}"
        )
    if not getattr(env, "possible_agents", None):
        raise ValueError(
            f"{type(env).__name__} has no possible_agents; expected a list of all agents that ever "
            "act, in a fixed order"
        )
    return env


def check_spaces(env: ParallelEnv, agents: Sequence[str]) -> None:
    """Refuse agents with different spaces, because one policy acts for all of them.

    :param env: knows their spaces
    :param agents: names of those that shall share a policy
    """
    kinds = (
        (env.observation_space, "observation", "pad_observations_v0"),
        (env.action_space, "action", "pad_action_space_v0"),
    )
    for space, kind, padding in kinds:
        for agent in agents[1:]:
            if space(agent) != space(agents[0]):
                raise ValueError(
                    f"the agents {agents[0]!r} and {agent!r} have different {kind} spaces, "
                    f"{space(agents[0])} and {space(agent)}; expected equal ones, because they "
                    f"share one policy. Pad them, for example with supersuit.{padding}, or say "
                    "which agents are the team: share_parameters(..., team=[...])"
                )


def split_agents(env: ParallelEnv, team: Sequence[str] | None) -> tuple[list[str], list[str]]:
    """Who belongs to the team, and who are its opponents.

    :param env: its ``metadata["team"]`` is the default
    :param team: names of the team's agents, or None
    :return: the names of both sides in the environment's order; the second may be empty
    """
    everyone = list(env.possible_agents)
    if team is None:
        team = getattr(env, "metadata", {}).get("team", everyone)
    if isinstance(team, str) or not team or not set(team) <= set(everyone):
        raise ValueError(f"team is {team!r}; expected a list of some of the agents {everyone}")
    return [a for a in everyone if a in team], [a for a in everyone if a not in team]


def check_distinct(envs: list[ParallelEnv]) -> None:
    """Refuse worlds that are one and the same object.

    :param envs: What ``make_env`` returned at different calls
    """
    if len({id(env.unwrapped) for env in envs}) < len(envs):
        raise ValueError(
            "make_env returned the same environment twice; expected a new one at every call, "
            "because worlds are independent. Make it inside the function: "
            "share_parameters(lambda: MyEnv(...)), not share_parameters(lambda: env)"
        )
