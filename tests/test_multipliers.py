"""Dual steps by hand (Eq. 7, Alg. 2 l. 11)."""

import math

import pytest
import torch as th

from sb3_e2c.multipliers import GradientMultipliers, PIDMultipliers


def trajectory(multipliers, violations):
    values = []
    for violation in violations:
        multipliers.update(th.full_like(multipliers.values, violation))
        values.append(multipliers.values[0, 0].item())
    return values


def test_lambda_rises_with_the_violation_falls_when_satisfied_and_is_never_negative():
    # 0 + 0.05·20 = 1, 1 − 0.05·10 = 0.5, 0.5 − 0.05·30 < 0
    assert trajectory(GradientMultipliers((1, 1)), [20, -10, -30]) == pytest.approx([1, 0.5, 0])


def test_lambda_starts_where_it_is_told_and_stops_at_its_maximum():
    multipliers = GradientMultipliers((1, 1), initial=1.0, maximum=1.5)
    assert multipliers.values.item() == 1.0
    assert trajectory(multipliers, [20]) == [1.5]


def test_the_step_of_individual_multipliers_is_n_times_the_literal_one():
    # a violation of 6 by the team is one of 2 by each of 3 agents: both rise by 0.3
    team = trajectory(GradientMultipliers((1, 1)), [6])
    individual = trajectory(GradientMultipliers((3, 1)), [2])
    literal = trajectory(GradientMultipliers((3, 1), agent_scaling=False), [2])
    assert team == pytest.approx([0.3])
    assert individual == pytest.approx(team)
    assert literal == pytest.approx([0.1])


def test_agents_and_constraints_have_multipliers_of_their_own():
    multipliers = GradientMultipliers((2, 2), learning_rate=1.0, agent_scaling=False)
    multipliers.update(th.tensor([[1.0, -1.0], [0.0, 2.0]]))
    assert multipliers.values.tolist() == [[1.0, 0.0], [0.0, 2.0]]


@pytest.mark.parametrize("cls", [GradientMultipliers, PIDMultipliers])
def test_pooled_multipliers_follow_the_team_as_one_multiplier_of_the_team_does(cls):
    pooled, team = cls((3, 1), pooled=True), cls((1, 1))
    for violations in ([9.0, -3.0, 0.0], [0.0, 15.0, -3.0], [-6.0, -3.0, 8.0]):
        pooled.update(th.tensor(violations)[:, None])
        team.update(th.tensor([[sum(violations)]]))
        assert pooled.values.flatten().tolist() == pytest.approx([team.values.item()] * 3)
    assert team.values.item() > 0


def test_pid_with_only_an_integral_is_gradient_ascent():
    violations = [20, -10, -30, 5]
    pid = PIDMultipliers((1, 1), kp=0, ki=0.05, kd=0)
    assert trajectory(pid, violations) == trajectory(GradientMultipliers((1, 1)), violations)


def test_pid_adds_the_violation_and_the_rise_of_the_cost():
    # 1st: p 0.1·10 + i 0.01·10, no rise yet; 2nd: p 0.1·15 + i 0.25 + d 0.2·5;
    # 3rd: the cost falls, d = 0: p −0.5 + i 0.2 < 0
    pid = PIDMultipliers((1, 1), kp=0.1, ki=0.01, kd=0.2)
    assert trajectory(pid, [10, 15, -5]) == pytest.approx([1.1, 2.75, 0.0])


def test_a_violation_beyond_the_largest_counts_as_the_largest():
    # gradient: 0.05·4, + 0.05·3, − 0.05·6; pooled: the mean of 2 and 10 is 6, and counts as 4
    gradient = GradientMultipliers((1, 1), largest_violation=4.0)
    assert trajectory(gradient, [100, 3, -6]) == pytest.approx([0.2, 0.35, 0.05])
    pooled = GradientMultipliers(
        (2, 1), 0.05, agent_scaling=False, pooled=True, largest_violation=4.0
    )
    pooled.update(th.tensor([[2.0], [10.0]]))
    assert pooled.values.flatten().tolist() == pytest.approx([0.2, 0.2])
    # PID: p 0.1·4 + i 0.01·4, then the same p, no rise (4 after 4), and i 0.08
    pid = PIDMultipliers((1, 1), kp=0.1, ki=0.01, kd=0.2, largest_violation=4.0)
    assert trajectory(pid, [100, 50]) == pytest.approx([0.44, 0.48])


@pytest.mark.parametrize("cls", [GradientMultipliers, PIDMultipliers])
def test_an_infinite_limit_never_costs_anything(cls):
    assert trajectory(cls((1, 1)), [-math.inf, -math.inf]) == [0.0, 0.0]


@pytest.mark.parametrize("cls", [GradientMultipliers, PIDMultipliers])
def test_saved_and_loaded_multipliers_go_on_alike(cls):
    first, second = cls((2, 1), initial=0.5), cls((2, 1))
    trajectory(first, [3, 4])
    second.load_state_dict(first.state_dict())
    assert trajectory(first, [5, -2]) == trajectory(second, [5, -2])


def test_a_negative_gain_is_refused():
    with pytest.raises(ValueError, match="multipliers: kp is -1; expected a number of at least 0"):
        PIDMultipliers((1, 1), kp=-1)


def test_a_largest_violation_of_nothing_is_refused():
    with pytest.raises(ValueError, match="largest_violation is 0; expected more"):
        GradientMultipliers((1, 1), largest_violation=0)
