"""Limits, parties and costs (Eqs. 2, 4)."""

import numpy as np
import pytest

from sb3_e2c import constraints

AGENTS = ["a_0", "a_1"]


def test_limits_are_given_as_nothing_a_number_or_several():
    assert constraints.parse_cost_limits(None).shape == (0,)
    assert constraints.parse_cost_limits(20).tolist() == [20.0]
    assert constraints.parse_cost_limits([0, np.inf]).tolist() == [0.0, np.inf]


@pytest.mark.parametrize("limits", [-1, [3, float("nan")], [[1.0]], "20"])
def test_a_limit_that_makes_no_sense_is_refused(limits):
    with pytest.raises(ValueError, match=r"cost_limits is .* expected None, a number or a list"):
        constraints.parse_cost_limits(limits)


def test_an_unknown_scope_is_refused():
    with pytest.raises(ValueError, match="cost_scope is 'joint'; expected one of"):
        constraints.check_cost_scope("joint")


def test_an_agents_limit_is_the_teams_divided_by_n():
    limits = np.array([20.0, 3.0])
    assert constraints.party_limits(limits, n_parties=1).tolist() == [[20.0, 3.0]]
    assert constraints.party_limits(limits, n_parties=2).tolist() == [[10.0, 1.5], [10.0, 1.5]]


def test_team_cost_is_the_sum_over_agents_or_their_maximum():
    agent_costs = np.array([[[1.0, 0.0], [1.0, 2.0]]])  # one world, two agents, two constraints
    assert constraints.party_costs(agent_costs, "team", "sum").tolist() == [[[2.0, 2.0]]]
    assert constraints.party_costs(agent_costs, "team", "max").tolist() == [[[1.0, 2.0]]]
    assert constraints.party_costs(agent_costs, "individual", "sum") is agent_costs


def test_agents_that_report_one_cost_share_it():
    agent_costs = np.array([[[6.0], [6.0]]])  # a robot's cost, from both of its halves
    shares = constraints.party_costs(agent_costs, "individual", "max")
    assert shares.tolist() == [[[3.0], [3.0]]]
    limits = constraints.party_limits(np.array([6.0]), n_parties=2)
    assert constraints.violation(shares, limits).tolist() == [[0.0], [0.0]]


def test_violation_is_the_mean_episode_cost_minus_the_limit():
    episodes = np.array([[[10.0]], [[20.0]]])
    assert constraints.violation(episodes, np.array([[12.0]])).tolist() == [[3.0]]


def test_costs_are_read_by_world_and_agent():
    infos = [{"cost": c} for c in (0, 1.0, 2, np.float32(3))]
    assert constraints.read_costs(infos, AGENTS).tolist() == [[[0], [1]], [[2], [3]]]
    infos = [{"cost": (0.0, 1.0)}, {"cost": np.array([2.0, 3.0])}]
    assert constraints.read_costs(infos, AGENTS).tolist() == [[[0, 1], [2, 3]]]
    assert constraints.read_costs([{}] * 4, AGENTS).shape == (2, 2, 0)


@pytest.mark.parametrize(
    ("second", "report"),
    [({}, "'nothing'"), ({"cost": [0, 1]}, r"\[0, 1\]"), ({"cost": "x"}, "'x'")],
)
def test_agents_that_report_different_costs_are_named(second, report):
    with pytest.raises(ValueError, match=f"those of world 1: {{'a_0': 0.0, 'a_1': {report}}}"):
        constraints.read_costs([{"cost": 0.0}] * 3 + [second], AGENTS)


def test_limits_must_fit_the_costs():
    constraints.check_n_costs(np.zeros((1, 2, 3)), 3, AGENTS)
    with pytest.raises(
        ValueError, match=r"there are 2 cost limits, but agent 'a_0' of world 0 rep"
    ):
        constraints.check_n_costs(np.zeros((1, 2, 3)), 2, AGENTS)
