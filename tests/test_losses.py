"""The objective on literal numbers (Eqs. 6, 8)."""

import pytest
import torch as th

from sb3_e2c import losses


def tensor(*numbers):
    return th.tensor(numbers, dtype=th.float64)


def test_the_penalty_is_subtracted_from_the_advantage():
    # two constraints of the team: 3 − (0.5·2 + 2·(−1)) = 4 for each of the two agents
    penalized = losses.penalized_advantages(
        tensor(3, 5), cost_advantages=tensor(2, -1)[None], multipliers=tensor(0.5, 2)[None]
    )
    assert penalized.tolist() == [4.0, 6.0]


def test_with_individual_constraints_each_agent_pays_its_own_price():
    penalized = losses.penalized_advantages(
        tensor(3, 3), cost_advantages=tensor(1, 1)[:, None], multipliers=tensor(0, 2)[:, None]
    )
    assert penalized.tolist() == [3.0, 1.0]


def test_with_no_constraint_or_lambda_zero_the_advantage_stays():
    advantages = tensor(3, -1)
    none = losses.penalized_advantages(advantages, th.empty(1, 0), th.empty(1, 0))
    free = losses.penalized_advantages(advantages, tensor(7)[None], tensor(0)[None])
    assert none.tolist() == free.tolist() == [3.0, -1.0]


@pytest.mark.parametrize(
    ("ratio", "advantage", "objective"),
    [
        (1.1, 2.0, 2.2),  # inside the clip
        (1.5, 2.0, 2.4),  # a gain counts up to 1.2
        (0.5, 2.0, 1.0),  # a loss counts in full
        (0.5, -2.0, -1.6),  # below 0.8 there is no more gain in avoiding a bad action
        (1.5, -2.0, -3.0),  # a mistake counts in full
    ],
)
def test_the_surrogate_is_clipped_on_the_side_of_the_gain(ratio, advantage, objective):
    loss = losses.policy_loss(tensor(ratio), tensor(advantage), clip_range=0.2)
    assert loss.item() == pytest.approx(-objective)


@pytest.mark.parametrize("multiplier", [0.5, 5.0])
def test_the_gradient_lowers_the_probability_of_a_costly_action(multiplier):
    logits = th.zeros(2, requires_grad=True)
    log_prob = th.log_softmax(logits, dim=0)
    cost_advantages = th.tensor([[1.0], [-1.0]])  # action 0 costs, action 1 saves
    penalized = losses.penalized_advantages(
        th.zeros(2, 1), cost_advantages[:, None], th.tensor([[multiplier]])
    )
    losses.policy_loss(th.exp(log_prob - log_prob.detach()), penalized[:, 0], 0.2).backward()
    assert logits.grad is not None
    assert logits.grad[0] > 0 > logits.grad[1]  # the optimizer steps against the gradient


def test_normalized_advantages_have_mean_zero_and_standard_deviation_one():
    normalized = losses.normalize(tensor(1, 2, 3))
    assert normalized.tolist() == pytest.approx([-1.0, 0.0, 1.0])
    assert losses.normalize(tensor(4)).tolist() == [4.0]


def test_a_clipped_value_may_only_move_by_the_clip_range():
    # predictions 3 and 1.1 were 1: the first counts as 1.5, (1.5 − 4)² + (1.1 − 4)² over 2
    loss = losses.value_loss(tensor(3, 1.1), tensor(4, 4), old_values=tensor(1, 1), clip_range=0.5)
    assert loss.item() == pytest.approx((2.5**2 + 2.9**2) / 2)
    assert losses.value_loss(tensor(3, 1), tensor(4, 4)).item() == pytest.approx(5.0)


def test_kl_estimate_is_zero_for_the_same_policy_and_positive_otherwise():
    assert losses.approx_kl(tensor(0, 0)).item() == 0.0
    # q − 1 − log q at q = 2: 1 − log 2
    assert losses.approx_kl(th.log(tensor(2))).item() == pytest.approx(0.3068528)


def test_clip_fraction_counts_ratios_outside_the_range():
    assert losses.clip_fraction(tensor(1.0, 1.3, 0.7, 1.1), 0.2).item() == pytest.approx(0.5)
