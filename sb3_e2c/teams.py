"""What an algorithm needs to know of its team, and what it refuses."""

from collections.abc import Collection
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv, is_vecenv_wrapped
from supersuit.vector.sb3_vector_wrapper import SB3VecEnvWrapper


def check_env(env: VecEnv) -> None:
    """Refuse SuperSuit's own environment, which hides who belongs to which team, and dicts.

    :param env: Given by the user
    """
    if is_vecenv_wrapped(env, SB3VecEnvWrapper):
        raise TypeError(
            "env is SuperSuit's own vector environment, which does not say how many agents "
            "share a world; use sb3_e2c.share_parameters(make_env, n_worlds=...) instead"
        )
    if isinstance(env.observation_space, (spaces.Dict, spaces.Tuple)):
        raise ValueError(
            f"the observation space is {env.observation_space}; expected vectors, images or "
            "numbers. Flatten observations in a PettingZoo wrapper, for example with "
            "gymnasium.spaces.flatten"
        )


def check_policy(policy: Any, known: Collection[str]) -> None:
    """Refuse a name of a policy that teams do not have.

    :param policy: What the user gave
    :param known: Names of those that they have
    """
    if isinstance(policy, str) and policy not in known:
        raise ValueError(
            f"policy is {policy!r}; expected one of {sorted(known)}, or a subclass of TeamPolicy. "
            "For images add policy_kwargs={'features_extractor_class': NatureCNN}"
        )


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


def check_spaces(observations: spaces.Space, actions: spaces.Space) -> None:
    """Refuse spaces that the networks would misunderstand.

    :param observations: Of an agent
    :param actions: Of an agent
    """
    for kind, space in (("observation", observations), ("action", actions)):
        if np.any(getattr(space, "start", 0)):
            raise ValueError(
                f"the {kind} space is {space}; expected numbers from 0 on, as Stable-Baselines3 "
                "does. Shift them in a PettingZoo wrapper"
            )
    if isinstance(actions, spaces.Box) and not (actions.shape and actions.dtype.kind == "f"):
        raise ValueError(
            f"the action space is {actions}; expected floating-point numbers and at least one "
            "dimension, such as Box(-1, 1, (2,)); for whole numbers use Discrete or MultiDiscrete"
        )
    if isinstance(actions, spaces.MultiDiscrete) and len(actions.shape) != 1:
        raise ValueError(f"the action space is {actions}; expected one dimension: flatten it")


def check_subclass(name: str, given: Any, kind: type) -> None:
    """Refuse something else than a class of a kind.

    :param name: The argument
    :param given: What the user gave
    :param kind: What it must derive from
    """
    if not isinstance(given, type) or not issubclass(given, kind):
        raise TypeError(f"{name} is {given!r}; expected a subclass of {kind.__name__}")
