"""Predictions and bounds of a team cost on problems that are solved exactly (Lemma 1).

A problem is handed to the library as if it were a rollout: its states are the T steps, its joint
actions the W worlds, and ρ(s) π(u|s) the weight of each.
"""

import itertools

import numpy as np
import pytest
import tabular
from tabular import Problems, joint_policy, moved_alone, solve

from sb3_e2c import bounds
from sb3_e2c.returns import gae

EXACT = {"rtol": 0, "atol": 1e-9}
GAMMAS = (0.0, 0.1, 0.3, 0.5, 0.9, 0.99)
STEPS = (1.0, 0.1, 1e-2, 1e-3, 1e-4)
SIZES = ((2, 2, 3), (2, 3, 4), (3, 2, 5), (3, 3, 3))  # agents, actions, states


class Update:
    """Problems, an old and a new policy, and what they are exactly and as the library sees them."""

    def __init__(self, problems, policy, new_policy):
        self.problems, self.policy, self.new_policy = problems, policy, new_policy
        self.old, self.new = joint_policy(policy), joint_policy(new_policy)
        self.solution = solve(problems, self.old)
        self.new_cost = solve(problems, self.new).cost  # (B, M)
        self.log_ratios = tabular.log_ratios(policy, new_policy)  # (B, S, U, N)
        self.weights = self.solution.visits[..., None] * self.old  # (B, S, U)
        self.kls = bounds.categorical_kl(np.log(policy), np.log(new_policy))  # (B, N, S)
        self.tvs = bounds.categorical_tv(np.log(policy), np.log(new_policy))  # (B, N, S)

    def rollouts(self):
        """The arguments of a surrogate, for one problem after the other."""
        return zip(self.log_ratios, self.solution.advantages, self.weights, strict=True)

    def every(self, function):
        return np.array([function(*rollout) for rollout in self.rollouts()])

    def bound(self, function, surrogates, sign=1):
        """A bound of each problem; with sign −1 of the cost −c, and thus a bound from below."""
        solution, gamma = self.solution, self.problems.gamma
        return np.array(
            [
                sign * function(sign * J, sign * L, kls, epsilon, gamma)
                for J, L, kls, epsilon in zip(
                    solution.cost, surrogates, self.kls.max(-1), solution.epsilon, strict=True
                )
            ]
        )


def random_updates(seed, count, steps=STEPS, gammas=GAMMAS, sizes=SIZES):
    """Updates of random policies, toward random policies and toward the others' worst reply."""
    rng = np.random.default_rng(seed)
    for (n_agents, n_actions, n_states), gamma in itertools.product(sizes, gammas):
        for step, worst in itertools.product(steps, (False, True)):
            problems = tabular.random_problems(rng, count, n_states, n_agents, n_actions, gamma)
            policy, toward = (
                tabular.random_policy(rng, count, n_agents, n_states, n_actions) for _ in "ab"
            )
            if worst:
                toward = tabular.worst_reply(solve(problems, joint_policy(policy)), policy)
                toward[:, 0] = policy[:, 0]  # agent 0 stays
                step = 0.9 * step  # a ratio of 0 has no finite KL
            yield Update(problems, policy, (1 - step) * policy + step * toward)


def bernoulli(*probabilities):
    """Policy of agents that play action 1 with these probabilities in every state, (1, N, 1, 2)."""
    p = np.array(probabilities)
    return np.stack([1 - p, p], axis=-1)[None, :, None]


def one_state(cost_of, gamma, before, after):
    """Problem of a single state, where the cost depends on the agents' actions 0 or 1."""
    actions = tabular.joint_actions(len(before), 2)
    costs = cost_of(actions).astype(float)[None, None, :, None]
    problem = Problems(np.ones((1, 1)), np.ones((1, 1, actions.shape[1], 1)), costs, gamma)
    return Update(problem, bernoulli(*before), bernoulli(*after))


def change(update):
    return (update.new_cost - update.solution.cost).item()


def margin(update, function, surrogates):
    """What a bound adds to J(π), of a single problem with one cost."""
    return np.squeeze(update.bound(function, surrogates) - update.solution.cost)


def second_agent(gamma, delta):
    """CE1: the cost is agent 2's action; agent 1 keeps its policy."""
    return one_state(lambda u: u[1] == 1, gamma, (0.5, 0.5), (0.5, 0.5 + delta))


# The exact solver itself


def test_the_solver_satisfies_the_identity_of_the_performance_difference():
    # T0: J(π̄) − J(π) = Σ ρ_π̄ E_π̄[A]
    for update in random_updates(0, count=5, steps=(1.0,)):
        visits = solve(update.problems, update.new).visits
        difference = np.einsum("bs,bsu,bsum->bm", visits, update.new, update.solution.advantages)
        np.testing.assert_allclose(update.new_cost - update.solution.cost, difference, **EXACT)


# Predictions


def test_enumerated_samples_give_the_exact_surrogates():
    for update in random_updates(1, count=3):
        solution, agents = update.solution, range(update.policy.shape[1])
        joint = tabular.surrogate(solution, update.new)
        alone = np.stack(
            [
                tabular.surrogate(
                    solution, joint_policy(moved_alone(update.policy, update.new_policy, i))
                )
                for i in agents
            ],
            axis=1,
        )
        np.testing.assert_allclose(update.every(bounds.joint_surrogate), joint, **EXACT)
        np.testing.assert_allclose(update.every(bounds.agent_surrogates), alone, **EXACT)
        np.testing.assert_allclose(update.every(bounds.sum_surrogate), alone.sum(1), **EXACT)
        np.testing.assert_allclose(update.every(bounds.interaction), joint - alone.sum(1), **EXACT)


def test_enumerated_samples_give_the_exact_cost_and_divergences():
    for update in random_updates(2, count=3):
        visits = update.solution.visits
        rate = update.problems.costs
        kl = (update.old * np.log(update.old / update.new)).sum(-1)
        tv = np.abs(update.old - update.new).sum(-1) / 2
        alone = np.abs(update.policy - update.new_policy).sum(-1) / 2
        for b, (log_ratios, _, weights) in enumerate(update.rollouts()):
            np.testing.assert_allclose(
                bounds.visit_sum(rate[b], weights), update.solution.cost[b], **EXACT
            )
            mean_kl = bounds.visit_mean(bounds.sampled_kl(log_ratios), weights)
            exact = [np.average(agent, weights=visits[b]) for agent in update.kls[b]]
            np.testing.assert_allclose(mean_kl, exact, **EXACT)
            np.testing.assert_allclose(
                bounds.mean_tv(log_ratios, weights), np.average(tv[b], weights=visits[b]), **EXACT
            )
        # a joint policy is a product: its KL is the sum of the agents'
        np.testing.assert_allclose(update.kls.sum(1), kl, **EXACT)
        np.testing.assert_allclose(update.tvs, alone, **EXACT)


def test_the_first_agents_surrogate_is_blind_to_the_second_agent():
    update = second_agent(gamma=0.5, delta=0.125)
    # agent 2 raises the cost from 1/2 to 5/8 in each step: 1/8 · 2
    np.testing.assert_allclose(update.every(bounds.agent_surrogates), [[[0], [0.25]]], **EXACT)
    assert change(update) == pytest.approx(0.25)


@pytest.mark.parametrize("gae_lambda", [0.0, 0.95, 1.0])
@pytest.mark.parametrize("error", [0.0, 3.0])
def test_all_episodes_of_a_short_problem_give_the_exact_surrogate(gae_lambda, error):
    horizon, gamma, rng = 3, 0.8, np.random.default_rng(3)
    problem = tabular.random_problems(rng, 1, 2, n_agents=2, n_actions=2, gamma=gamma)
    policy, new_policy = (tabular.random_policy(rng, 1, 2, 2, 2) for _ in "ab")
    old, new = joint_policy(policy)[0], joint_policy(new_policy)[0]
    log_ratio = tabular.log_ratios(policy, new_policy)[0]
    start, transitions, costs = problem.start[0], problem.transitions[0], problem.costs[0]

    # values by backward recursion, visits by forward recursion: they depend on the time left
    values, visits = np.zeros((horizon + 1, 2, 2)), [start]
    advantages = np.zeros((horizon, *costs.shape))
    for t in reversed(range(horizon)):
        action_values = costs + gamma * transitions @ values[t + 1]
        values[t] = np.einsum("su,sum->sm", old, action_values)
        advantages[t] = action_values - values[t][:, None]
    for _ in range(horizon - 1):
        visits.append(np.einsum("s,su,suz->z", visits[-1], old, transitions))
    exact = sum(
        gamma**t * np.einsum("s,su,sum->m", visits[t], new, advantages[t]) for t in range(horizon)
    )

    # every episode with its probability, side by side as if they were worlds
    episodes = np.array(list(itertools.product(range(2), range(4), repeat=horizon)))
    s, u = episodes[:, ::2].T, episodes[:, 1::2].T  # (T, W)
    probability = start[s[0]] * old[s, u].prod(0)
    probability *= transitions[s[:-1], u[:-1], s[1:]].prod(0)
    ages = np.arange(horizon)[:, None] * np.ones(len(episodes), dtype=int)
    weights = bounds.visit_weights(ages, gamma) * len(episodes) * probability
    # a critic that is wrong in every state, by a number of the state and the time
    predicted = values[ages, s] + error * np.sin(1 + ages + 2 * s)[..., None]
    dones = np.zeros((*ages.shape, 1), dtype=bool)
    dones[-1] = True
    estimate = gae(costs[s, u], predicted, predicted[-1], dones, gamma, gae_lambda)
    predictions = bounds.joint_surrogate(log_ratio[s, u], estimate, weights)
    if error == 0 or gae_lambda == 1:
        # the critic's error cancels, unless it bootstraps
        np.testing.assert_allclose(predictions, exact, rtol=0, atol=1e-12)
    else:
        assert np.abs(predictions - exact).max() > 0.01
    np.testing.assert_allclose(
        bounds.visit_sum(costs[s, u], weights), start @ values[0], rtol=0, atol=1e-12
    )


def test_samples_agree_with_the_exact_numbers_within_four_standard_errors():
    horizon, episodes, gamma, rng = 40, 3000, 0.5, np.random.default_rng(4)
    problems = tabular.random_problems(rng, 1, 4, n_agents=3, n_actions=2, gamma=gamma)
    # no rare action: its huge ratio would be missing from most samples, and from their error
    policy, new_policy = (0.25 + 0.5 * tabular.random_policy(rng, 1, 3, 4, 2) for _ in "ab")
    update = Update(problems, policy, new_policy)

    def draw(probabilities):
        return (probabilities.cumsum(-1) < rng.random((episodes, 1))).sum(-1)

    s = np.zeros((horizon, episodes), dtype=int)
    u = np.zeros_like(s)
    state = draw(np.repeat(problems.start, episodes, axis=0))
    for t in range(horizon):
        s[t], u[t] = state, draw(update.old[0, state])
        state = draw(problems.transitions[0, s[t], u[t]])
    ages = np.arange(horizon)[:, None] * np.ones(episodes, dtype=int)
    log_ratios, advantages = update.log_ratios[0, s, u], update.solution.advantages[0, s, u]
    tv = np.abs(update.old - update.new).sum(-1)[0] / 2
    visits = update.solution.visits[0]

    def estimates(world):
        sample = log_ratios[:, world], advantages[:, world]
        weights = bounds.visit_weights(ages[:, world], gamma)
        return np.concatenate(
            [
                bounds.visit_sum(problems.costs[0, s, u][:, world], weights),
                bounds.joint_surrogate(*sample, weights),
                bounds.agent_surrogates(*sample, weights).ravel(),
                bounds.sum_surrogate(*sample, weights),
                bounds.interaction(*sample, weights),
                bounds.visit_mean(bounds.sampled_kl(sample[0]), weights),
                bounds.mean_tv(sample[0], weights)[None],
            ]
        )

    (rollout,) = update.rollouts()
    exact = np.concatenate(
        [
            update.solution.cost[0],
            bounds.joint_surrogate(*rollout),
            bounds.agent_surrogates(*rollout).ravel(),
            bounds.sum_surrogate(*rollout),
            bounds.interaction(*rollout),
            np.average(update.kls[0], axis=1, weights=visits),
            [np.average(tv, weights=visits)],
        ]
    )
    groups = np.array([estimates(slice(i, i + 30)) for i in range(0, episodes, 30)])
    error = groups.std(0, ddof=1) / np.sqrt(len(groups))
    assert (np.abs(groups.mean(0) - exact) <= 4 * error).all()
    np.testing.assert_allclose(estimates(slice(None)), groups.mean(0), **EXACT)


def test_a_step_weighs_what_discounting_leaves_of_it():
    # episodes of two, one and one step in one world, an episode of four in the other
    ages = np.array([[0, 0], [1, 1], [0, 2], [0, 3]])
    weights = bounds.visit_weights(ages, gamma=0.5)
    np.testing.assert_allclose(weights * 4, [[1, 1], [0.5, 0.5], [1, 0.25], [1, 0.125]])
    # discounted sums 1, 0, 4 and 4 · ¼ = 1, their mean 3/2
    costs = np.array([[1, 0], [0, 0], [0, 4], [4, 0]], dtype=float)[..., None]
    assert bounds.visit_sum(costs, weights) == pytest.approx([1.5])


def test_without_the_beginning_of_an_episode_there_is_no_estimate():
    with pytest.raises(ValueError, match=r"No episode begins in these 2 steps.*larger n_steps"):
        bounds.visit_weights(np.array([[3], [4]]), gamma=0.9)


def test_without_a_change_everything_is_zero():
    log_ratios, advantages = np.zeros((3, 2, 4)), np.ones((3, 2, 1))
    sample = log_ratios, advantages, np.ones((3, 2))
    assert bounds.joint_surrogate(*sample).tolist() == [0.0]
    assert bounds.agent_surrogates(*sample).tolist() == [[0.0]] * 4
    assert bounds.mean_tv(log_ratios, np.ones((3, 2))) == 0.0
    assert bounds.sampled_kl(log_ratios).max() == 0.0
    assert bounds.effective_sample_size(log_ratios) == 1.0


def test_an_agent_that_takes_no_part_changes_nothing():
    rng = np.random.default_rng(5)
    log_ratios, advantages = rng.normal(size=(4, 3, 2)), rng.normal(size=(4, 3, 2))
    weights = rng.random((4, 3))
    with_absent = np.concatenate([log_ratios, np.zeros((4, 3, 1))], axis=-1)
    np.testing.assert_allclose(
        bounds.joint_surrogate(with_absent, advantages, weights),
        bounds.joint_surrogate(log_ratios, advantages, weights),
    )
    assert bounds.agent_surrogates(with_absent, advantages, weights)[2].tolist() == [0.0, 0.0]
    assert bounds.effective_sample_size(with_absent) == bounds.effective_sample_size(log_ratios)


def test_ratios_of_impossible_size_neither_overflow_nor_break_the_sums():
    log_ratios = np.array([[[800.0, 800.0], [-np.inf, 0.0]]], dtype=np.float32)
    sample = log_ratios, np.ones((1, 2, 1)), np.ones((1, 2))
    assert np.isfinite(bounds.joint_surrogate(*sample)).all()
    assert bounds.agent_surrogates(*sample)[0, 0] == pytest.approx(np.exp(20) - 2)
    assert bounds.effective_sample_size(log_ratios) == pytest.approx(0.5)


# Gradients at the old policy: what simultaneous updates of all agents improve


def tilt(rng, policy, n_agents):
    """A direction that keeps rows summing to 1: of each agent, or one for all if n_agents is 1."""
    shape = (len(policy), n_agents, *policy.shape[2:])
    scores = rng.normal(size=shape)
    return policy * (scores - (policy * scores).sum(-1, keepdims=True))


def slopes(problems, policy, direction, step=1e-4):
    """Derivatives of J, L, every Lᵢ and Σᵢ Lᵢ along a direction, shape (B, ..., M) each."""
    ahead, behind = (Update(problems, policy, policy + t * direction) for t in (step, -step))

    def numbers(update):
        surrogates = (bounds.joint_surrogate, bounds.agent_surrogates, bounds.sum_surrogate)
        return [update.new_cost, *(update.every(surrogate) for surrogate in surrogates)]

    pairs = zip(numbers(ahead), numbers(behind), strict=True)
    return [(a - b) / (2 * step) for a, b in pairs]


@pytest.mark.parametrize("gamma", [0.0, 0.5, 0.9])
def test_the_joint_surrogate_and_the_sum_have_the_gradient_of_the_cost(gamma):
    rng = np.random.default_rng(14)
    problems = tabular.random_problems(rng, 10, 4, n_agents=3, n_actions=2, gamma=gamma)
    policy = tabular.random_policy(rng, 10, 3, 4, 2)
    cost, joint, agents, together = slopes(problems, policy, tilt(rng, policy, 3))
    np.testing.assert_allclose(joint, cost, rtol=0, atol=1e-6)
    np.testing.assert_allclose(together, cost, rtol=0, atol=1e-6)
    assert np.abs(agents - cost[:, None]).max() > 0.01


def test_the_surrogate_of_an_agent_has_the_gradient_of_the_cost_if_it_moves_alone():
    rng = np.random.default_rng(15)
    problems = tabular.random_problems(rng, 10, 4, n_agents=3, n_actions=2, gamma=0.9)
    policy = tabular.random_policy(rng, 10, 3, 4, 2)
    direction = tilt(rng, policy, 3)
    direction[:, 1:] = 0
    cost, _, agents, _ = slopes(problems, policy, direction)
    np.testing.assert_allclose(agents[:, 0], cost, rtol=0, atol=1e-6)


def test_with_shared_weights_the_sum_has_the_gradient_of_the_cost_and_one_agent_has_not():
    rng = np.random.default_rng(16)
    problems = tabular.random_problems(rng, 10, 4, n_agents=3, n_actions=2, gamma=0.9)
    policy = np.repeat(tabular.random_policy(rng, 10, 1, 4, 2), 3, axis=1)
    cost, _, agents, together = slopes(problems, policy, tilt(rng, policy, 1))
    np.testing.assert_allclose(together, cost, rtol=0, atol=1e-6)
    assert np.abs(agents[:, 0] - cost).max() > 0.1


def test_the_mean_of_the_rows_that_ppo_improves_is_the_sum_of_the_surrogates():
    # E_d[qᵢ A], averaged over the agents as minibatches of rows do: (1 − γ)/N Σᵢ Lᵢ
    for update in random_updates(17, count=2, steps=(0.1,)):
        n_agents, gamma = update.policy.shape[1], update.problems.gamma
        for log_ratios, advantages, weights in update.rollouts():
            rows = np.exp(log_ratios)[..., None] * advantages[..., None, :]
            found = bounds.visit_mean(rows.mean(-2), weights)
            together = bounds.sum_surrogate(log_ratios, advantages, weights)
            np.testing.assert_allclose(found, (1 - gamma) / n_agents * together, **EXACT)


def test_a_penalty_that_is_the_same_for_all_actions_has_no_gradient():
    # the bracket λ (J − l) of Eq. 8 (docs/paper.md, D2), or a critic's error in a state
    for update in random_updates(18, count=2, steps=(0.1,)):
        for log_ratios, advantages, weights in update.rollouts():
            error = 7 * np.sin(np.arange(len(weights)))[:, None, None]
            constant = np.broadcast_to(error, advantages.shape)
            for surrogate in (bounds.joint_surrogate, bounds.agent_surrogates):
                np.testing.assert_allclose(surrogate(log_ratios, constant, weights), 0, **EXACT)


# Divergences


def test_the_sampled_kl_is_never_negative():
    log_ratios = np.linspace(-30, 30, 100_001)
    assert bounds.sampled_kl(log_ratios).min() >= 0.0
    assert bounds.sampled_kl(log_ratios * 1e-16).min() >= 0.0
    # q − 1 − log q at q = 2: 1 − log 2
    assert bounds.sampled_kl(np.log(2)) == pytest.approx(0.30685281944)


def test_categorical_divergences_on_literal_numbers():
    old, new = np.log([0.5, 0.5]), np.log([0.25, 0.75])
    # ½ log 2 + ½ log ⅔, and the other way round ¼ log ½ + ¾ log 3/2
    assert bounds.categorical_kl(old, new) == pytest.approx(np.log(2 * 2 / 3) / 2)
    assert bounds.categorical_kl(new, old) == pytest.approx(0.75 * np.log(1.5) - 0.25 * np.log(2))
    assert bounds.categorical_tv(old, new) == pytest.approx(0.25)
    # two of four actions give ¼ each to the two others
    old, new = np.log([0.25, 0.25, 0.25, 0.25]), np.array([0.5, 0.5, 0, 0]) + 1e-12
    assert bounds.categorical_tv(old, np.log(new)) == pytest.approx(0.5)


def test_rounding_makes_no_divergence_negative():
    log_probs = np.log(np.random.default_rng(12).dirichlet(np.ones(3), 1000))
    assert bounds.categorical_kl(log_probs, log_probs * (1 + 1e-16)).min() >= 0
    near = log_probs + np.random.default_rng(13).normal(0, 1e-16, log_probs.shape)
    assert bounds.categorical_kl(log_probs, near).min() >= 0
    assert bounds.gaussian_kl(log_probs, log_probs, near, near).min() >= 0


def test_an_action_that_is_not_available_does_not_count():
    old, new = np.array([0, -np.inf, -np.inf]), np.array([np.log(0.5), np.log(0.5), -np.inf])
    assert bounds.categorical_kl(old, new) == pytest.approx(np.log(2))
    assert bounds.categorical_tv(old, new) == pytest.approx(0.5)


def test_gaussian_kl_is_the_integral_over_each_dimension():
    old_mean, new_mean = np.array([0.3, -1.0]), np.array([0.1, 0.5])
    old_log_std, new_log_std = np.array([-0.2, 0.4]), np.array([0.1, -0.3])
    x = np.linspace(-25, 25, 20_001)[:, None]

    def log_density(mean, log_std):
        return -0.5 * ((x - mean) / np.exp(log_std)) ** 2 - log_std - np.log(2 * np.pi) / 2

    old, new = log_density(old_mean, old_log_std), log_density(new_mean, new_log_std)
    integral = (np.exp(old) * (old - new)).sum() * (x[1] - x[0])
    exact = bounds.gaussian_kl(old_mean, old_log_std, new_mean, new_log_std)
    np.testing.assert_allclose(exact, integral.item(), **EXACT)


def test_the_effective_sample_size_of_literal_ratios():
    # joint ratios 2·½ = 1 and 3·1 = 3: (1 + 3)² / (2 (1 + 9)) = 0.8
    log_ratios = np.log([[[2.0, 0.5]], [[3.0, 1.0]]])
    assert bounds.effective_sample_size(log_ratios) == pytest.approx(0.8)


# Bounds


def test_bounds_on_literal_numbers():
    # γ = ½: 2γε/(1−γ)² = 4ε, and 1/(1−γ) = 2; Σ KL = 0.02 + 0.08 + 0 = 0.1; ε = 3 and 1
    cost, kls, epsilon = np.array([1.0, 2.0]), np.array([0.02, 0.08, 0.0]), np.array([3.0, 1.0])
    joint = bounds.joint_bound(cost, np.array([0.5, -0.5]), kls, epsilon, gamma=0.5)
    np.testing.assert_allclose(joint, [1.5 + 1.2, 1.5 + 0.4])
    # and (3 − 1) ε · 2 · 0.1 = 0.4ε
    together = bounds.sum_bound(cost, np.array([0.5, -0.5]), kls, epsilon, gamma=0.5)
    np.testing.assert_allclose(together, [1.5 + 1.2 + 1.2, 1.5 + 0.4 + 0.4])
    # √(KL/2) = 0.1, 0.2, 0, of the others 0.2, 0.1, 0.3, times 2ε · 2
    agents = bounds.agent_bounds(cost, np.zeros((3, 2)), kls, epsilon, gamma=0.5)
    np.testing.assert_allclose(agents[:, 0], [2.2 + 2.4, 2.2 + 1.2, 2.2 + 3.6])
    np.testing.assert_allclose(agents[:, 1], [2.4 + 0.8, 2.4 + 0.4, 2.4 + 1.2])
    printed = bounds.printed_not_a_bound(cost, np.array([[0.5, 0]] * 3), kls, epsilon, gamma=0.5)
    np.testing.assert_allclose(printed, [[1.5 + 2.4, 2 + 0.8]] * 3)
    # 2γ/(1−γ)² = 4, times 0.3 · 0.05
    average = bounds.average_bound(cost, np.array([0.5, -0.5]), 0.3, 0.05, gamma=0.5)
    np.testing.assert_allclose(average, [1.56, 1.56])


def test_no_advantage_exceeds_its_bound_from_the_largest_cost():
    assert bounds.largest_advantage(max_cost=6.0, gamma=0.9) == pytest.approx(60.0)
    for update in random_updates(6, count=3, steps=(1.0,)):
        gamma = update.problems.gamma
        assert (update.solution.epsilon <= bounds.largest_advantage(1.0, gamma) + 1e-12).all()


def test_the_expected_advantage_is_limited_by_epsilon_by_the_costs_and_by_the_step():
    # √(0.08 / 2) = 0.2 of 2ε = 0.6 or of c_max/(1−γ) = 2
    expected = bounds.largest_expected_advantage(np.array([0.3, 5.0]), 0.08, 1.0, gamma=0.5)
    np.testing.assert_allclose(expected, [0.12, 0.4])
    far = bounds.largest_expected_advantage(0.3, 18.0, 1.0, gamma=0.5)
    assert far == pytest.approx(0.6)  # a total variation is at most 1


def test_the_bounds_hold_on_thousands_of_random_updates_from_above_and_from_below():
    n_updates = 0
    for update in random_updates(7, count=20):
        joint, alone = (update.every(f) for f in (bounds.joint_surrogate, bounds.agent_surrogates))
        cost = update.new_cost
        for sign in (1, -1):
            t1 = sign * (update.bound(bounds.joint_bound, joint, sign) - cost)
            t3 = sign * (update.bound(bounds.sum_bound, alone.sum(1), sign) - cost)
            t4 = sign * (update.bound(bounds.agent_bounds, alone, sign) - cost[:, None])
            assert min(t1.min(), t3.min(), t4.min()) > -1e-9
        n_updates += len(joint)
    assert n_updates == 4800


def test_the_bounds_with_mean_divergences_hold_too():
    for update in random_updates(8, count=5):
        gamma, solution = update.problems.gamma, update.solution
        expected = np.abs(np.einsum("bsu,bsum->bsm", update.new, solution.advantages)).max(1)
        for b, (log_ratios, advantages, weights) in enumerate(update.rollouts()):
            rollout = log_ratios, advantages, weights
            joint_kl, epsilon = update.kls[b].sum(0).max(), solution.epsilon[b]
            limit = bounds.largest_expected_advantage(epsilon, joint_kl, 1.0, gamma)
            assert (expected[b] <= limit + 1e-12).all()
            tv, joint = bounds.mean_tv(log_ratios, weights), bounds.joint_surrogate(*rollout)
            for sign in (1, -1):
                cost = sign * solution.cost[b]
                bound = bounds.average_bound(cost, sign * joint, expected[b], tv, gamma)
                assert (sign * update.new_cost[b] <= bound + 1e-9).all()
            tvs = np.repeat(update.tvs[b].T[:, None], weights.shape[1], axis=1)  # (S, U, N)
            largest = bounds.interaction_bound(tvs, weights, epsilon)
            assert (np.abs(bounds.interaction(*rollout)) <= largest + 1e-9).all()


@pytest.mark.parametrize("n_agents", [2, 3, 6])
def test_the_sum_of_surrogates_may_keep_the_printed_penalty_when_gamma_is_large(n_agents):
    # 2γε/(1−γ)² + (N−1)ε/(1−γ) ≤ 4γε/(1−γ)²  if and only if  γ ≥ (N−1)/(N+1)
    threshold = (n_agents - 1) / (n_agents + 1)
    for gamma, enough in ((threshold - 0.01, False), (threshold + 0.01, True)):
        arguments = np.zeros(1), np.zeros(1), np.full(n_agents, 0.1), 1.0, gamma
        assert (bounds.sum_bound(*arguments) <= bounds.printed_not_a_bound(*arguments)) == enough


# The printed lemma, and the counterexamples


def printed_excess(update):
    """By how much the new cost exceeds what agent 0's printed bound allows, (B, M)."""
    alone = update.every(bounds.agent_surrogates)
    printed = update.bound(bounds.printed_not_a_bound, alone)
    return update.new_cost - printed[:, 0]


def test_the_printed_form_fails_for_small_steps_and_only_for_small_steps():
    share = {}
    for step in STEPS:
        updates = random_updates(9, count=25, steps=(step,), gammas=(0.5,))
        # every second update moves the others toward what costs most, the first cost
        worst = itertools.islice(updates, 1, None, 2)
        share[step] = np.mean([printed_excess(update)[:, 0] > 1e-12 for update in worst])
    assert share[1.0] == 0.0  # why a test with large steps would not notice
    assert share[1e-3] > 0.7
    assert share[1e-4] > 0.9


def test_the_printed_form_holds_where_an_agent_moves_alone_and_is_then_twice_the_penalty_of_t1():
    for update in random_updates(10, count=3):
        alone = moved_alone(update.policy, update.new_policy, agent=1)
        update = Update(update.problems, update.policy, alone)
        surrogates = update.every(bounds.agent_surrogates)
        joint = update.every(bounds.joint_surrogate)
        np.testing.assert_allclose(surrogates[:, 1], joint, **EXACT)
        printed = update.bound(bounds.printed_not_a_bound, surrogates)[:, 1]
        t1 = update.bound(bounds.joint_bound, joint)
        assert (update.new_cost <= printed + 1e-9).all()
        predicted = update.solution.cost + joint
        np.testing.assert_allclose(printed - predicted, 2 * (t1 - predicted), rtol=1e-6, atol=1e-9)


def test_for_a_single_agent_all_forms_are_one():
    arguments = np.array([1.0]), np.array([0.2]), np.array([0.05]), 0.7, 0.9
    t1 = bounds.joint_bound(*arguments)
    assert bounds.sum_bound(*arguments) == pytest.approx(t1)
    assert bounds.agent_bounds(*arguments)[0] == pytest.approx(t1)
    assert bounds.printed_not_a_bound(*arguments) == pytest.approx(2 * t1 - 1.2)


def test_the_printed_form_holds_where_all_others_move_far_and_its_excess_is_limited():
    # T5: the total variation of each reaches (1 − γ)/(2γ) in some state
    checked = 0
    for update in random_updates(11, count=10, gammas=(0.5, 0.9, 0.99)):
        gamma, largest = update.problems.gamma, update.tvs[:, 1:].max(-1)
        far = (largest >= (1 - gamma) / (2 * gamma)).all(-1)
        excess, n_agents = printed_excess(update), update.policy.shape[1]
        assert (excess[far] <= 1e-12).all()
        assert (excess <= (n_agents - 1) * update.solution.epsilon / (4 * gamma) + 1e-12).all()
        checked += far.sum()
    assert checked > 300


@pytest.mark.parametrize(
    ("gamma", "delta", "true_change", "printed"),
    [(0.5, 1 / 8, 0.25, 0.1291), (0.9, 0.01, 0.1, 0.0360), (0.0, 0.3, 0.3, 0.0)],
)
def test_ce1_the_other_agent_moves(gamma, delta, true_change, printed):
    update = second_agent(gamma, delta)
    nu, kl = 2 * gamma / (1 - gamma) ** 2, -np.log(1 - 4 * delta**2) / 2
    assert change(update) == pytest.approx(delta / (1 - gamma))
    assert change(update) == pytest.approx(true_change)
    surrogates = update.every(bounds.agent_surrogates)
    right_hand_side = margin(update, bounds.printed_not_a_bound, surrogates)
    assert right_hand_side[0] == pytest.approx(nu * kl)
    assert right_hand_side[0] == pytest.approx(printed, abs=5e-5)
    assert right_hand_side[0] < change(update) <= right_hand_side[1] + 1e-12
    corrected = margin(update, bounds.joint_bound, update.every(bounds.joint_surrogate))
    assert corrected == pytest.approx(delta / (1 - gamma) + nu * kl / 2)


def test_ce1_no_constant_repairs_the_printed_form():
    # the change is of first order in the step, the divergence of second
    needed = [
        change(update) / update.kls.sum()
        for update in (second_agent(0.9, 10.0**-k) for k in range(1, 6))
    ]
    growth = np.array(needed[1:]) / needed[:-1]
    np.testing.assert_allclose(growth, 10, rtol=0.03)


def test_ce1_attains_the_term_that_the_printed_form_lacks():
    # T4 at γ = 0 is 2ε √(KL/2) with ε = ½: all of the change, up to the gap of Pinsker
    update = second_agent(gamma=0.0, delta=0.01)
    t4 = margin(update, bounds.agent_bounds, update.every(bounds.agent_surrogates))
    assert change(update) / t4[0] == pytest.approx(1, abs=2e-4)
    assert change(update) <= t4[0]


@pytest.mark.parametrize("gamma", [0.0, 0.5, 0.9])
def test_ce2_agents_with_shared_weights_collide(gamma):
    delta = 0.002
    update = one_state(lambda u: u.all(0), gamma, (0.5, 0.5), (0.5 + delta, 0.5 + delta))
    nu, kl = 3 * gamma / (1 - gamma) ** 2, -np.log(1 - 4 * delta**2) / 2
    assert update.solution.epsilon.item() == pytest.approx(3 / 4)
    assert change(update) == pytest.approx((delta + delta**2) / (1 - gamma))
    surrogates = update.every(bounds.agent_surrogates)
    np.testing.assert_allclose(surrogates.ravel(), [delta / 2 / (1 - gamma)] * 2, **EXACT)
    printed = margin(update, bounds.printed_not_a_bound, surrogates)
    np.testing.assert_allclose(printed, delta / 2 / (1 - gamma) + 2 * nu * kl)
    assert (printed < change(update)).all()


def test_ce2_with_six_agents():
    delta, n_agents = 0.002, 6
    update = one_state(lambda u: u.sum(0) >= 2, 0.9, [0.5] * n_agents, [0.5 + delta] * n_agents)
    printed = margin(update, bounds.printed_not_a_bound, update.every(bounds.agent_surrogates))
    assert (printed < change(update)).all()


def test_ce3_an_agent_is_pushed_into_its_own_cost_by_another():
    # s' = 1 if and only if u² = 1; agent 1 pays in state 1 whatever it does
    gamma, delta = 0.9, 0.005
    transitions, costs = np.zeros((1, 2, 4, 2)), np.zeros((1, 2, 4, 1))
    second = tabular.joint_actions(2, 2)[1]
    transitions[0, :, np.arange(4), second] = 1.0
    costs[0, 1] = 1.0
    problem = Problems(np.array([[1.0, 0.0]]), transitions, costs, gamma)
    before, after = (np.repeat(bernoulli(*p), 2, axis=2) for p in ((0.5, 0.5), (0.5, 0.5 + delta)))
    update = Update(problem, before, after)
    assert change(update) == pytest.approx(gamma * delta / (1 - gamma))
    surrogates = update.every(bounds.agent_surrogates)
    assert surrogates[0, 0].item() == pytest.approx(0, abs=1e-12)
    # what agent 1's own actions do to its cost is nothing at all
    own = update.solution.advantages.reshape(2, 2, 2).mean(-1)
    np.testing.assert_allclose(own, 0, **EXACT)
    printed = margin(update, bounds.printed_not_a_bound, surrogates)
    assert printed[0] == pytest.approx(0.0081, abs=5e-5)
    assert printed[0] < change(update)


@pytest.mark.parametrize("gamma", [0.0, 0.1, 0.5])
def test_ce4_a_disagreement_attains_the_bound_of_the_interaction(gamma):
    # cost 1{u¹ ≠ u²}, the agents move apart: no surrogate of one agent sees it
    delta = 0.05
    update = one_state(lambda u: u[0] != u[1], gamma, (0.5, 0.5), (0.5 + delta, 0.5 - delta))
    (rollout,) = update.rollouts()
    assert change(update) == pytest.approx(2 * delta**2 / (1 - gamma))
    np.testing.assert_allclose(bounds.agent_surrogates(*rollout), 0, **EXACT)
    interaction = bounds.interaction(*rollout)
    assert interaction == pytest.approx([change(update)])
    tvs = np.full((1, 4, 2), delta)
    assert bounds.interaction_bound(tvs, rollout[2], 0.5) == pytest.approx(interaction)
    t3 = margin(update, bounds.sum_bound, update.every(bounds.sum_surrogate))
    t1 = margin(update, bounds.joint_bound, np.zeros((1, 1)))
    assert change(update) <= t3
    # the printed penalty with Σ Lᵢ is enough from γ = 1/5 on, and T1's with Σ Lᵢ from 1/3 on
    printed = margin(update, bounds.printed_not_a_bound, update.every(bounds.agent_surrogates))
    assert (change(update) <= printed[0]) == (gamma > 1 / 5)
    assert (change(update) <= t1) == (gamma > 1 / 3)


def test_ce4_attains_the_bound_of_the_interaction_with_unequal_steps_too():
    # 2 δ₁ δ₂ per step; and an agent that moves alone interacts with nobody
    for first, second in ((0.05, 0.2), (0.05, 0.0)):
        after = (0.5 + first, 0.5 - second)
        update = one_state(lambda u: u[0] != u[1], 0.5, (0.5, 0.5), after)
        (rollout,) = update.rollouts()
        limit = bounds.interaction_bound(np.array([[[first, second]] * 4]), rollout[2], 0.5)
        assert limit == pytest.approx(4 * first * second)
        np.testing.assert_allclose(bounds.interaction(*rollout), limit, **EXACT)


def test_ce4_attains_the_bound_of_the_sum_for_small_steps():
    # T3 at γ = 0 is ε Σ KL with ε = ½ and KL ≈ 2δ² twice: the change of 2δ²
    delta = 0.01
    update = one_state(lambda u: u[0] != u[1], 0.0, (0.5, 0.5), (0.5 + delta, 0.5 - delta))
    t3 = margin(update, bounds.sum_bound, update.every(bounds.sum_surrogate))
    assert change(update) / t3 == pytest.approx(1, abs=3e-4)


def test_ce5_many_small_steps_raise_the_cost_far_beyond_their_certificates():
    # CE1 with 4000 steps of 1e-4 from ½ to 0.9: J rises from 5 to 9
    gamma, p = 0.9, np.linspace(0.5, 0.9, 4001)
    log_probs = np.log(np.stack([1 - p, p], axis=-1))
    kl = bounds.categorical_kl(log_probs[:-1], log_probs[1:])
    epsilon = np.maximum(p, 1 - p)[:-1]
    certificates = [
        bounds.printed_not_a_bound(np.zeros(1), np.zeros((2, 1)), np.array([0, k]), e, gamma)[0, 0]
        for k, e in zip(kl, epsilon, strict=True)
    ]
    assert (np.diff(p) / (1 - gamma) > certificates).all()
    assert sum(certificates) == pytest.approx(0.029, abs=5e-4)
    assert (p[-1] - p[0]) / (1 - gamma) == pytest.approx(4.0)
