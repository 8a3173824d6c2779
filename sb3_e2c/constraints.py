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
    limits = np.atleast_1d(np.asarray([] if cost_limits is None else cost_limits, dtype=np.float64))
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
    :return: Shape (..., K, M)
    """
    if cost_scope == "individual":
        return agent_costs
    return team_costs(agent_costs, team_cost)[..., None, :]


def violation(episode_costs: np.ndarray, limits: np.ndarray) -> np.ndarray:
    """How far the mean episode cost exceeds the limit, J − l (the bracket of Eq. 6).

    :param episode_costs: Undiscounted costs of E finished episodes, shape (E, K, M), E >= 1
    :param limits: Limits of the parties, shape (K, M)
    :return: Shape (K, M); negative where the limit is kept
    """
    return episode_costs.mean(axis=0) - limits


def read_costs(infos: Sequence[dict[str, Any]], n_costs: int, agents: Sequence[str]) -> np.ndarray:
    """Costs that the environment reports in ``info["cost"]``.

    :param infos: One dict for each slot
    :param n_costs: M, the number of constraints
    :param agents: Names of the N agents, for the error message
    :return: Shape (W, N, M), float64
    :raises ValueError: if a slot reports no cost, or another number of costs
    """
    if n_costs == 0:
        return np.zeros((len(infos) // len(agents), len(agents), 0))
    try:
        costs = np.array([info["cost"] for info in infos], dtype=np.float64)
    except (KeyError, TypeError, ValueError):
        costs = np.empty(0)
    if costs.size != len(infos) * n_costs:
        raise _bad_cost(infos, n_costs, agents)
    return costs.reshape(-1, len(agents), n_costs)


def _bad_cost(infos: Sequence[dict[str, Any]], n_costs: int, agents: Sequence[str]) -> ValueError:
    slot = next(s for s, i in enumerate(infos) if np.size(i.get("cost", ())) != n_costs)
    world, agent = divmod(slot, len(agents))
    found = repr(infos[slot]["cost"]) if "cost" in infos[slot] else "nothing"
    return ValueError(
        f"agent {agents[agent]!r} of world {world} reports {found} in info['cost'], but there are "
        f"{n_costs} cost limits; expected a number, or a list of {n_costs} numbers, in the info "
        "of every agent at every step. Report the cost there, or train without cost_limits"
    )
