"""What an algorithm needs to know of its team, and what it refuses."""

from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv, is_vecenv_wrapped
from supersuit.vector.sb3_vector_wrapper import SB3VecEnvWrapper

from sb3_e2c.monitor import TeamMonitor
from sb3_e2c.vec_env import MultiAgentVecEnv


def monitored(env: VecEnv) -> VecEnv:
    """Add a monitor to an environment of teams that has none.

    :param env: Given by the user
    :raises TypeError: if it is SuperSuit's own, which hides who belongs to which team
    """
    if is_vecenv_wrapped(env, SB3VecEnvWrapper):
        raise TypeError(
            "env is SuperSuit's own vector environment, which does not say how many agents "
            "share a world; use sb3_e2c.share_parameters(make_env, n_worlds=...) instead"
        )
    is_team = isinstance(env.unwrapped, MultiAgentVecEnv)
    return TeamMonitor(env) if is_team and not is_vecenv_wrapped(env, TeamMonitor) else env


def team_of(env: VecEnv | None) -> tuple[list[str], int]:
    """Names of a team's agents and the size of the critics' extra state.

    :param env: A single-agent environment is a team of one
    """
    return list(getattr(env, "agents", ["agent"])), getattr(env, "critic_state_dim", 0)


def check_team(env: VecEnv, agents: list[str], critic_state_dim: int) -> None:
    """Refuse an environment with another team than the model was made for.

    :param env: The environment
    :param agents: Names of the model's agents
    :param critic_state_dim: Size of the extra state of the model's critics
    """
    found_agents, found_dim = team_of(env)
    if found_agents != agents:
        raise ValueError(
            f"the environment has the agents {found_agents}, but the model was made for {agents}; "
            "use an environment with the same team"
        )
    if found_dim != critic_state_dim:
        raise ValueError(
            f"the environment reports {found_dim} numbers in info['critic_state'], but the model's "
            f"critics were made for {critic_state_dim}; use an environment with the same settings"
        )


def check_batch(n_agents: int, batch_size: int) -> None:
    """Refuse a batch smaller than a team.

    :param n_agents: N
    :param batch_size: Largest minibatch in agent steps
    """
    if batch_size < n_agents:
        raise ValueError(
            f"batch_size is {batch_size}, smaller than the team of {n_agents} agents; a minibatch "
            "holds whole team steps, so raise batch_size"
        )


def check_actions(space: spaces.Space) -> None:
    """Refuse numbered actions that do not begin at 0, as those of the networks do.

    :param space: The actions of an agent
    """
    if np.any(getattr(space, "start", 0)):
        raise ValueError(
            f"the action space is {space}; expected actions that are numbered from 0 on, as "
            "Stable-Baselines3 does. Shift them in a PettingZoo wrapper's step"
        )


def check_subclass(name: str, given: Any, kind: type) -> None:
    """Refuse something else than a class of a kind.

    :param name: The argument
    :param given: What the user gave
    :param kind: What it must derive from
    """
    if not isinstance(given, type) or not issubclass(given, kind):
        raise TypeError(f"{name} is {given!r}; expected a subclass of {kind.__name__}")
