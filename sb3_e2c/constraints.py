"""Cost limits of a team and of its agents (Eqs. 2, 4).

K is the number of constrained parties: 1 when the team is constrained as a whole, N when each
agent has limits of its own. Everything that belongs to costs has the trailing shape (K, M).
"""

from collections.abc import Sequence
from typing import Any, Literal, get_args

import numpy as np

CostScope = Literal["team", "individual"]
TeamCost = Literal["sum", "max"]


def parse_cost_limits(cost_limits: float | Sequence[float] | np.ndarray | None) -> np.ndarray:
    """Limits on the undiscounted team cost of an episode, one for each constraint.

    :param cost_limits: None (no constraint), a number, or M numbers, each at least 0
    :return: Limits l, shape (M,), float64
    :raises ValueError: if a limit is negative or not a number
    """
    try:
        if isinstance(cost_limits, str | bytes):
            raise TypeError
        limits = np.atleast_1d(np.asarray([] if cost_limits is None else cost_limits, np.float64))
    except (OverflowError, TypeError, ValueError):
        limits = np.array([np.nan])
    if limits.ndim != 1 or np.isnan(limits).any() or (limits < 0).any():
        raise ValueError(
            f"cost_limits is {cost_limits!r}; expected None, a number or a list of numbers that "
            "are at least 0, each a limit on the team's cost of a whole episode"
        )
    return limits


def check_cost_scope(cost_scope: str) -> None:
    """Refuse an unknown scope.

    :param cost_scope: What the user gave
    :raises ValueError: if it is neither "team" nor "individual"
    """
    if cost_scope not in get_args(CostScope):
        raise ValueError(f"cost_scope is {cost_scope!r}; expected one of {get_args(CostScope)}")


def n_parties(cost_scope: str, n_agents: int) -> int:
    """Number K of parties that have limits and multipliers of their own.

    :param cost_scope: "team" or "individual"
    :param n_agents: N
    :return: 1 or N
    """
    return 1 if cost_scope == "team" else n_agents


def party_limits(cost_limits: np.ndarray, n_parties: int) -> np.ndarray:
    """Limit of each party: the team's limit, divided evenly among individual agents (Sec. 5.2).

    :param cost_limits: Team limits l, shape (M,)
    :param n_parties: K
    :return: Shape (K, M)
    """
    return np.tile(cost_limits / n_parties, (n_parties, 1))


def team_costs(agent_costs: np.ndarray, team_cost: str) -> np.ndarray:
    """Cost of the team in a step, from the costs of its agents.

    :param agent_costs: Shape (..., N, M)
    :param team_cost: "sum" over the agents, or "max" where all report one and the same cost
    :return: Shape (..., M)
    """
    return agent_costs.max(axis=-2) if team_cost == "max" else agent_costs.sum(axis=-2)


def party_costs(agent_costs: np.ndarray, cost_scope: str, team_cost: str) -> np.ndarray:
    """Cost of each constrained party in a step.

    :param agent_costs: Shape (..., N, M)
    :param cost_scope: "team" or "individual"
    :param team_cost: See :func:`team_costs`
    :return: Shape (..., K, M); of one cost that all agents report ("max"), an agent's share is
        1 / N, so that limits of l / N for each are kept when the team's is
    """
    if cost_scope == "individual":
        return agent_costs / agent_costs.shape[-2] if team_cost == "max" else agent_costs
    return team_costs(agent_costs, team_cost)[..., None, :]


def violation(episode_costs: np.ndarray, limits: np.ndarray) -> np.ndarray:
    """How far the mean episode cost exceeds the limit, J − l (the bracket of Eq. 6).

    :param episode_costs: Undiscounted costs of E finished episodes, shape (E, K, M), E >= 1
    :param limits: Limits of the parties, shape (K, M)
    :return: Shape (K, M); negative where the limit is kept
    """
    return episode_costs.mean(axis=0) - limits


def read_costs(infos: Sequence[dict[str, Any]], agents: Sequence[str]) -> np.ndarray:
    """Costs that the environment reports in ``info["cost"]``, as many as it reports.

    :param infos: One dict for each slot
    :param agents: Names of the N agents
    :return: Shape (W, N, M), float64; M = 0 where no agent reports any
    :raises ValueError: if agents report different numbers of costs
    """
    found = [info["cost"] for info in infos if "cost" in info]
    if not found:
        return np.zeros((len(infos) // len(agents), len(agents), 0))
    try:
        if len(found) == len(infos):
            return np.array(found, dtype=np.float64).reshape(-1, len(agents), np.size(found[0]))
    except (TypeError, ValueError):
        pass  # of different lengths, or no numbers
    odd = next((s for s, info in enumerate(infos) if _n_costs(info) != _n_costs(infos[0])), 0)
    world = odd // len(agents)
    team = zip(agents, infos[world * len(agents) :], strict=False)
    reports = {agent: info.get("cost", "nothing") for agent, info in team}
    raise ValueError(
        f"the agents report different costs in info['cost'], those of world {world}: {reports}; "
        "expected a number, or equally many numbers, from every agent at every step, zeros "
        "included, or nothing from all"
    )


def _n_costs(info: dict[str, Any]) -> int:
    try:
        return np.asarray(info["cost"], dtype=np.float64).size
    except (KeyError, TypeError, ValueError):
        return -1


def check_n_costs(agent_costs: np.ndarray, n_constraints: int, agents: Sequence[str]) -> None:
    """Refuse limits that do not fit the costs.

    :param agent_costs: Shape (W, N, M)
    :param n_constraints: Number of limits
    :param agents: Names of the N agents
    :raises ValueError: unless M is the number of limits
    """
    if agent_costs.shape[-1] != n_constraints:
        raise ValueError(
            f"there are {n_constraints} cost limits, but agent {agents[0]!r} of world 0 reports "
            f"{agent_costs.shape[-1]} costs in info['cost']; expected one for each limit, from "
            "every agent at every step. Report it there, or change cost_limits (None: no limit)"
        )
