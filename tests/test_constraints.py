"""Limits, parties and costs (Eqs. 2, 4)."""

import numpy as np
import pytest

from sb3_e2c import constraints

AGENTS = ["a_0", "a_1"]


def test_limits_are_given_as_nothing_a_number_or_several():
    assert constraints.parse_cost_limits(None).shape == (0,)
    assert constraints.parse_cost_limits(20).tolist() == [20.0]
    assert constraints.parse_cost_limits([0, np.inf]).tolist() == [0.0, np.inf]


@pytest.mark.parametrize("limits", [-1, [3, float("nan")], [[1.0]]])
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


def test_violation_is_the_mean_episode_cost_minus_the_limit():
    episodes = np.array([[[10.0]], [[20.0]]])
    assert constraints.violation(episodes, np.array([[12.0]])).tolist() == [[3.0]]


def test_costs_are_read_by_world_and_agent():
    infos = [{"cost": c} for c in (0, 1.0, 2, np.float32(3))]
    assert constraints.read_costs(infos, 1, AGENTS).tolist() == [[[0], [1]], [[2], [3]]]
    infos = [{"cost": (0.0, 1.0)}, {"cost": np.array([2.0, 3.0])}]
    assert constraints.read_costs(infos, 2, AGENTS).tolist() == [[[0, 1], [2, 3]]]


@pytest.mark.parametrize(
    ("infos", "message"),
    [
        ([{"cost": 0.0}, {}], r"agent 'a_1' of world 0 reports nothing in info\['cost'\]"),
        ([{"cost": 0.0}, {"cost": [0, 1]}], r"agent 'a_1' of world 0 reports \[0, 1\]"),
        ([{"cost": [0, 1]}, {"cost": [0, 1]}], "there are 1 cost limits"),
    ],
)
def test_a_missing_cost_names_the_agent_and_the_convention(infos, message):
    with pytest.raises(ValueError, match=message):
        constraints.read_costs(infos, 1, AGENTS)
