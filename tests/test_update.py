"""The update by hand, in halves, on threads, against the formulas and torch (Alg. 2 l. 13-16)."""

import math
import multiprocessing
import threading
from typing import Any

import numpy as np
import pytest
import torch as th
from conftest import TwoOnALine
from gymnasium import spaces
from torch import nn
from torch.distributions import Categorical, Normal

from sb3_e2c import MAPPO, descent, share_parameters
from sb3_e2c.buffers import halves
from sb3_e2c.descent import Descent, update_threads
from sb3_e2c.losses import approx_kl, clip_fraction, normalize, policy_loss, value_loss
from sb3_e2c.objective import Outputs, Targets, Terms, Weights, objective, reference
from sb3_e2c.passes import MlpPasses, Passes
from sb3_e2c.policies import TeamPolicy
from sb3_e2c.ratings import CategoricalRating, GaussianRating, Rating
from sb3_e2c.sequences import Memory, Sequences, alternate

SMALL = {"n_steps": 16, "batch_size": 32, "n_epochs": 2, "device": "cpu", "seed": 0}
BOX = spaces.Box(-1.0, 1.0, (2,))
CHOICE, CHOICES = spaces.Discrete(3), spaces.MultiDiscrete([2, 3])
WEIGHTS = Weights(clip_range=0.2, clip_range_vf=None, ent_coef=0.1, vf_coef=0.7)


def world(space=CHOICE, **kwargs):
    """Two on a line, with any actions: those whose numbers are positive in sum are fast."""

    class AnyActions(TwoOnALine):
        batched = None

        def action_space(self, agent):
            return space

        def step(self, actions):
            return super().step({agent: int(np.sum(u) > 0) for agent, u in actions.items()})

    return AnyActions(length=5, spread=3, **kwargs)


def make(policy: Any = "MlpPolicy", space=CHOICE, env=None, **kwargs):
    worlds = share_parameters(lambda: world(space, **(env or {})), 3)
    return MAPPO(policy, worlds, **{**SMALL, "cost_limits": 2.0, **kwargs})


def collected(*args, **kwargs):
    """A model with a rollout, whose policy has moved since, and that as one minibatch."""
    model = make(*args, **kwargs)
    _, callback = model._setup_learn(32)
    callback.on_training_start({}, {})
    model.collect_rollouts(model.env, callback, model.rollout_buffer, model.n_steps)
    samples = model.rollout_buffer.samples(model.policy, model.multipliers.values, True)
    generator = th.Generator().manual_seed(0)
    with th.no_grad():
        for parameter in model.policy.parameters():
            parameter += 0.1 * th.randn(parameter.shape, generator=generator)
    ((batch, sequences),) = model.rollout_buffer.minibatches(samples, 10_000)
    return model, batch._replace(advantages=normalize(batch.advantages)), sequences


def by_the_formulas(model, batch, sequences, weights):
    """Loss and gradients of all parameters, as the equations and torch have them."""
    policy = model.policy
    new = policy.evaluate_steps(batch.observations, batch.actions, batch.critic_states, sequences)
    log_ratio = new.log_prob - batch.old_log_prob
    clip = weights.clip_range_vf
    actor = policy_loss(log_ratio.exp(), batch.advantages, weights.clip_range)
    values = value_loss(new.values, batch.returns, batch.old_values, clip)
    for j in range(new.cost_values.shape[-1]):
        pair = (batch.cost_returns[..., j], batch.old_cost_values[..., j])
        values = values + value_loss(new.cost_values[..., j], *pair, clip)
    loss = actor - weights.ent_coef * new.entropy.mean() + weights.vf_coef * values
    parameters = list(policy.parameters())
    gradients = th.autograd.grad(loss, parameters, allow_unused=True)
    return loss, dict(zip(parameters, gradients, strict=True)), log_ratio


def assert_close(ours, theirs, tolerance=1e-6):
    scale = max(1.0, theirs.abs().max().item()) if theirs.numel() else 1.0
    th.testing.assert_close(ours, theirs.to(ours), rtol=1e-5, atol=tolerance * scale)


def flat(model):
    return th.cat([p.detach().flatten() for p in model.policy.parameters()])


# The objective


def problem(n_constraints=2, parties=1, seed=0):
    """Outputs of 40 team steps of 3 agents whose ratios and values have moved far."""
    generator = th.Generator().manual_seed(seed)

    def draw(*shape, scale=1.0):
        return scale * th.randn(shape, generator=generator)

    slots, costs = (40, 3), (40, parties, n_constraints)
    outputs = Outputs(draw(*slots, scale=0.3), draw(*slots), draw(*slots), draw(*costs))
    targets = Targets(
        *(draw(*slots, scale=scale) for scale in (0.3, 1, 0.5, 1)), draw(*costs), draw(*costs)
    )
    return outputs, targets


@pytest.mark.parametrize("share", [1.0, 0.3])
@pytest.mark.parametrize("clip", [None, 0.4])
@pytest.mark.parametrize(("n_constraints", "parties"), [(0, 1), (1, 1), (2, 1), (2, 3)])
def test_the_compiled_objective_and_its_gradient_are_those_of_the_formulas(
    n_constraints, parties, clip, share
):
    outputs, targets = problem(n_constraints, parties)
    weights = WEIGHTS._replace(clip_range_vf=clip)
    terms, gradients = objective(outputs, targets, weights, share)
    in_double = (type(each)(*(t.double() for t in each)) for each in (outputs, targets))
    expected, slopes = reference(*in_double, weights, share)
    assert terms == pytest.approx(expected, abs=1e-6)
    assert 0 < terms.clip_fraction < 1
    for ours, theirs in zip(gradients, slopes, strict=True):
        assert_close(ours, theirs)


def test_the_reference_is_the_formulas_of_losses():
    outputs, targets = problem()
    terms, _ = reference(outputs, targets, WEIGHTS)
    log_ratio = outputs.log_prob - targets.old_log_prob
    cost_pairs = zip(outputs.cost_values.unbind(-1), targets.cost_returns.unbind(-1), strict=True)
    expected = Terms(
        policy_loss(log_ratio.exp(), targets.advantages, 0.2).item(),
        value_loss(outputs.values, targets.returns).item(),
        sum(value_loss(*pair).item() for pair in cost_pairs),
        -outputs.entropy.mean().item(),
        clip_fraction(log_ratio.exp(), 0.2).item(),
        approx_kl(log_ratio).item(),
    )
    assert terms == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("compute", [objective, reference])
def test_the_objective_of_two_agents_by_hand(compute):
    # ratios 2 (clipped at 1.2, as its advantage is 3) and 1 (advantage -1); errors 2 and 0; cost 1
    two, none = th.log(th.tensor([[2.0, 1.0]])), th.zeros(1, 2)
    outputs = Outputs(two, th.tensor([[0.5, 0.7]]), th.tensor([[3.0, 1.0]]), th.ones(1, 1, 1))
    targets = Targets(none, th.tensor([[3.0, -1.0]]), none, th.ones(1, 2), *[th.zeros(1, 1, 1)] * 2)
    terms, gradients = compute(outputs, targets, WEIGHTS)
    assert terms.policy_gradient_loss == pytest.approx(-(1.2 * 3 - 1) / 2)
    assert terms.value_loss == pytest.approx((2**2 + 0) / 2)
    assert terms.cost_value_loss == pytest.approx(1.0)
    assert terms.entropy_loss == pytest.approx(-0.6)
    assert terms.clip_fraction == 0.5
    assert terms.approx_kl == pytest.approx((2 - 1 - math.log(2)) / 2)
    assert terms.loss(WEIGHTS) == pytest.approx(-1.3 - 0.06 + 0.7 * 3)
    assert gradients.log_prob.flatten().tolist() == pytest.approx([0.0, 0.5])
    assert gradients.entropy.flatten().tolist() == pytest.approx([-0.05, -0.05])
    assert gradients.values.flatten().tolist() == pytest.approx([0.7 * 2 * 2 / 2, 0.0])
    assert gradients.cost_values.flatten().tolist() == pytest.approx([1.4])


@pytest.mark.parametrize("clip", [None, 0.4])
@pytest.mark.parametrize("where", [*Outputs._fields, *Targets._fields])
def test_no_number_that_is_not_one_is_lost_on_the_way_to_the_loss(where, clip):
    outputs, targets = problem()
    both = outputs._asdict() | targets._asdict()
    both[where][7] = math.nan
    terms, _ = objective(outputs, targets, WEIGHTS._replace(clip_range_vf=clip))
    assert math.isnan(terms.loss(WEIGHTS))


# Ratings of actions


def test_gaussian_ratings_and_gradients_are_those_of_torch():
    generator = th.Generator().manual_seed(0)
    means, actions = (th.randn(30, 3, generator=generator) for _ in range(2))
    log_std, of_log_std = th.tensor([-1.0, 0.0, 0.5]), th.empty(3)
    known = Rating(*(th.randn(30, generator=generator) for _ in range(2)))
    ratings = GaussianRating(log_std, of_log_std)
    ours = ratings.rate(means, actions)
    of_means = ratings.gradient(known)
    leaves = [each.double().requires_grad_() for each in (means, log_std)]
    normal = Normal(leaves[0], leaves[1].exp().expand(30, 3))
    theirs = [normal.log_prob(actions.double()).sum(1), normal.entropy().sum(1)]
    expected = th.autograd.grad(theirs, leaves, [each.double() for each in known])
    for one, other in zip((*ours, of_means, of_log_std), (*theirs, *expected), strict=True):
        assert_close(one, other.detach())


def test_categorical_ratings_and_gradients_are_those_of_torch():
    generator = th.Generator().manual_seed(0)
    logits = 2 * th.randn(30, 4, generator=generator)
    actions = th.randint(4, (30,), generator=generator)
    known = Rating(*(th.randn(30, generator=generator) for _ in range(2)))
    ratings = CategoricalRating()
    ours = ratings.rate(logits, actions)
    gradient = ratings.gradient(known)
    leaf = logits.double().requires_grad_()
    categorical = Categorical(logits=leaf)
    theirs = [categorical.log_prob(actions), categorical.entropy()]
    (expected,) = th.autograd.grad(theirs, [leaf], [each.double() for each in known])
    for one, other in zip((*ours, gradient), (*theirs, expected), strict=True):
        assert_close(one, other.detach())


def test_a_choice_that_cannot_be_made_adds_no_entropy():
    ratings = CategoricalRating()
    rating = ratings.rate(th.tensor([[0.0, 0.0, -math.inf]]), th.tensor([1]))
    assert rating.log_prob.item() == pytest.approx(-math.log(2))
    assert rating.entropy.item() == pytest.approx(math.log(2))
    gradient = ratings.gradient(Rating(th.ones(1), th.ones(1)))
    assert gradient[0].tolist() == pytest.approx([-0.5, 0.5, 0.0])


# Gradients of the parameters

CASES = {
    "discrete": {"space": CHOICE},
    "continuous": {"space": BOX},
    "several discrete": {"space": CHOICES},
    "individual costs": {"cost_scope": "individual"},
    "two costs": {"cost_limits": [2.0, 3.0], "env": {"n_costs": 2}},
    "no costs": {"cost_limits": None},
    "critic state": {"env": {"critic_state": True}, "space": BOX},
    "ReLU": {"policy_kwargs": {"activation_fn": nn.ReLU}, "space": BOX},
    "ELU": {"policy_kwargs": {"activation_fn": nn.ELU}},
    "no hidden layers": {"policy_kwargs": {"net_arch": []}},
    "uneven layers": {"policy_kwargs": {"net_arch": {"pi": [5], "vf": [7, 3, 4], "cvf": []}}},
    "own extractors": {"policy_kwargs": {"share_features_extractor": False}},
}


@pytest.mark.parametrize("is_halved", [False, True])
@pytest.mark.parametrize("policy", ["MlpPolicy", "GruPolicy"])
@pytest.mark.parametrize("case", CASES)
def test_the_gradient_is_that_of_the_formulas(case, policy, is_halved, monkeypatch):
    monkeypatch.setattr(descent, "HALVED_FROM", 1)
    model, batch, sequences = collected(policy, **CASES[case])
    weights = WEIGHTS._replace(clip_range_vf=0.5)
    loss, expected, log_ratio = by_the_formulas(model, batch, sequences, weights)
    with Descent(model.policy, 2 if is_halved else 1) as slope:
        assert len(slope._passes) == (2 if is_halved and case != "several discrete" else 1)
        terms = slope.gradient(batch, sequences, weights)
    assert terms.loss(weights) == pytest.approx(loss.item(), rel=1e-5, abs=1e-6)
    assert terms.approx_kl == pytest.approx(approx_kl(log_ratio).item(), rel=1e-4, abs=1e-6)
    for parameter, gradient in expected.items():
        if gradient is not None:
            assert_close(parameter.grad, gradient, 2e-6)
        else:
            assert parameter.grad is None


def kind_of(model):
    return type(Descent(model.policy, 1)._passes[0])


@pytest.mark.parametrize("case", sorted(set(CASES) - {"several discrete", "ELU"}))
def test_mlps_that_are_known_are_computed_by_hand(case):
    assert kind_of(make(**CASES[case])) is MlpPasses


class OwnPolicy(TeamPolicy):
    """Somebody's own."""


class WithDropout(TeamPolicy):
    def _build_mlp_extractor(self):
        super()._build_mlp_extractor()
        self.mlp_extractor.policy_net.append(nn.Dropout(0.5))


class WithSpareLayer(TeamPolicy):
    def _build_mlp_extractor(self):
        super()._build_mlp_extractor()
        self.spare = nn.Linear(2, 2)


def test_all_other_networks_are_left_to_torch():
    model = make()
    nn.utils.spectral_norm(model.policy.action_net)
    frozen = make()
    frozen.policy.action_net.bias.requires_grad_(False)
    others = [make(**CASES[case]) for case in ("several discrete", "ELU")]
    others += [make("GruPolicy"), make(OwnPolicy), model, frozen]
    assert [kind_of(each) for each in others] == [Passes] * 6


@pytest.mark.parametrize("policy", [OwnPolicy, WithDropout])
def test_networks_that_nobody_knows_see_whole_minibatches(policy, monkeypatch):
    monkeypatch.setattr(descent, "HALVED_FROM", 1)
    model, batch, sequences = collected(policy)
    rows = []
    evaluate = model.policy.evaluate_steps
    monkeypatch.setattr(
        model.policy,
        "evaluate_steps",
        lambda *args: (rows.append(len(args[0])), evaluate(*args))[1],
    )
    with Descent(model.policy, 2) as slope:
        assert slope._pool is None
        slope.gradient(batch, sequences, WEIGHTS)
    assert rows == [len(batch.observations)]


def test_what_the_objective_does_not_depend_on_is_left_alone():
    model = make(WithSpareLayer, policy_kwargs={"optimizer_kwargs": {"weight_decay": 0.1}})
    spare = model.policy.spare
    before = spare.weight.clone()
    model.learn(96)
    assert spare.weight.equal(before)
    assert spare.weight.grad is None
    assert model.policy.action_net.weight.grad is not None


def test_a_layer_that_is_frozen_does_not_learn():
    model = make()
    frozen = model.policy.action_net.weight.requires_grad_(False)
    before, others = frozen.clone(), flat(model)
    model.learn(96)
    assert frozen.equal(before)
    assert not flat(model).equal(others)


@pytest.mark.parametrize("policy", ["MlpPolicy", "GruPolicy"])
def test_a_layer_that_is_frozen_later_stays_where_it_is(policy):
    model = make(policy).learn(96)
    frozen = model.policy.action_net.weight.requires_grad_(False)
    before = frozen.clone()
    model.learn(96)  # the optimizer would go on with the last gradient
    assert frozen.equal(before)


class Gated(TeamPolicy):
    """Adds a layer after the optimizer was made, as is usual with Stable-Baselines3."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.gate = nn.Linear(self.action_net.out_features, self.action_net.out_features)
        self.optimizer = th.optim.Adam(self.parameters(), lr=1e-3)

    def _rate(self, latent, actions):
        self.gated = True
        return super()._rate(latent, actions)

    def evaluate_steps(self, observations, *args):
        found = super().evaluate_steps(observations, *args)
        return found._replace(entropy=found.entropy + self.gate.bias.sum())


def test_a_layer_that_was_added_later_learns():
    model = make(Gated, ent_coef=0.1)
    before = model.policy.gate.bias.clone()
    model.learn(96)
    assert not model.policy.gate.bias.equal(before)


class Odd(nn.Module):
    """Hidden layers that are no sequence."""

    def __init__(self, inner):
        super().__init__()
        self.inner = inner

    def forward(self, inputs):
        return self.inner(inputs)


def _other_activation(policy):
    policy.mlp_extractor.policy_net[-1] = nn.ReLU()


def _without_activation(policy):
    policy.mlp_extractor.policy_net[-1] = nn.Identity()


def _other_container(policy):
    policy.mlp_extractor.policy_net = Odd(policy.mlp_extractor.policy_net)


def _hook(policy):
    policy.action_net.register_forward_hook(lambda module, inputs, output: 2.0 * output)


def _backward_hook(policy):
    policy.value_net.register_full_backward_pre_hook(lambda module, gradient: gradient)


def _weight_hook(policy):
    policy.action_net.weight.register_hook(lambda gradient: 0.0 * gradient)


def _other_method(policy):
    policy._rate = lambda *args: TeamPolicy._rate(policy, *args)


def _no_bias(policy):
    policy.value_net.bias = None


CHANGES = [_other_activation, _without_activation, _other_container, _hook, _backward_hook]
CHANGES += [_weight_hook, _other_method, _no_bias]


@pytest.mark.parametrize("change", CHANGES, ids=lambda change: change.__name__)
def test_changed_networks_are_left_to_torch(change):
    model, batch, sequences = collected("MlpPolicy")
    assert MlpPasses.is_for(model.policy, [*model.policy.parameters()])
    change(model.policy)
    assert not MlpPasses.is_for(model.policy, [*model.policy.parameters()])
    _, expected, _ = by_the_formulas(model, batch, sequences, WEIGHTS)
    with Descent(model.policy, 1) as slope:
        slope.gradient(batch, sequences, WEIGHTS)
    for parameter in model.policy.parameters():
        if change is _weight_hook and parameter is model.policy.action_net.weight:
            assert not parameter.grad.any()
        else:
            assert_close(parameter.grad, expected[parameter])


def test_a_gradient_that_is_missing_once_is_none_then():
    model, batch, sequences = collected("MlpPolicy")
    passes = Passes(model.policy, [*model.policy.parameters()])
    outputs = passes.forward(batch, sequences)
    passes.backward(Outputs(*(th.ones_like(each) for each in outputs)))
    assert passes.gradient.all()
    outputs = passes.forward(batch, sequences)
    passes._outputs = passes._outputs._replace(values=th.zeros_like(outputs.values))
    passes.backward(Outputs(*(th.ones_like(each) for each in outputs)))
    sizes = dict(
        zip(
            passes.parameters,
            passes.gradient.split([p.numel() for p in passes.parameters]),
            strict=True,
        )
    )
    assert not sizes[model.policy.value_net.weight].any()
    assert sizes[model.policy.action_net.weight].any()


@pytest.mark.parametrize("policy", ["MlpPolicy", "GruPolicy"])
@pytest.mark.parametrize("size", [0.01, 100.0])
def test_gradients_are_clipped_as_by_torch_the_cost_critics_on_their_own(policy, size):
    model, batch, sequences = collected(policy)
    _, expected, _ = by_the_formulas(model, batch, sequences, WEIGHTS)
    with Descent(model.policy, 1) as slope:
        slope.gradient(batch, sequences, WEIGHTS)
        norms = slope.clip(size)
    ours = [[p.grad for p in group] for group in model.policy.clipped_together()]
    for group, got, norm in zip(model.policy.clipped_together(), ours, norms, strict=True):
        for parameter in group:
            parameter.grad = expected[parameter]
        assert norm == pytest.approx(nn.utils.clip_grad_norm_(group, size).item(), rel=1e-5)
        for parameter, gradient in zip(group, got, strict=True):
            assert_close(gradient, parameter.grad)


# Halves


def test_half_of_the_sequences_are_every_other_one():
    # five sequences of 3, 3, 2, 1 and 1 steps, rows in the order of PackedSequence
    initial = th.arange(5.0).view(5, 1, 1)
    sequences = Sequences(th.tensor([5, 3, 2]), Memory(initial, initial, initial))
    (first, own), (second, other) = alternate(sequences)
    assert first.tolist() == [0, 2, 4, 5, 7, 8]
    assert second.tolist() == [1, 3, 6, 9]
    assert own.batch_sizes.tolist() == [3, 2, 1]
    assert other.batch_sizes.tolist() == [2, 1, 1]
    assert own.initial.actor.flatten().tolist() == [0, 2, 4]
    assert other.initial.cost.flatten().tolist() == [1, 3]


def test_a_single_sequence_and_a_single_step_are_not_divided():
    nothing = th.zeros(1, 1, 1)
    sequences = Sequences(th.tensor([1, 1, 1]), Memory(nothing, nothing, nothing))
    ((rows, whole),) = alternate(sequences)
    assert rows.tolist() == [0, 1, 2]
    assert whole.batch_sizes.tolist() == [1, 1, 1]
    _, batch, _ = collected()
    one = type(batch)(*(field[:1] for field in batch))
    assert len(halves(one, None)) == 1


@pytest.mark.parametrize("policy", ["MlpPolicy", "GruPolicy"])
def test_halves_hold_every_step_once(policy):
    _, batch, sequences = collected(policy)
    parts = halves(batch, sequences)
    advantages = th.cat([part.advantages for part, _ in parts])
    assert len(parts) == 2
    assert sorted(advantages.flatten().tolist()) == sorted(batch.advantages.flatten().tolist())


def test_only_large_minibatches_are_halved(monkeypatch):
    model, batch, _ = collected()
    sizes = []
    monkeypatch.setattr(descent, "halves", lambda *part: sizes.append(part) or halves(*part))
    for least in (batch.advantages.numel(), batch.advantages.numel() + 1):
        monkeypatch.setattr(descent, "HALVED_FROM", least)
        for threads in (1, 2):
            Descent(model.policy, threads).gradient(batch, None, WEIGHTS)
    assert len(sizes) == 1  # two threads, the first size


# Threads


def learned(policy, cores, monkeypatch, **kwargs):
    monkeypatch.setattr(descent, "HALVED_FROM", 1)
    monkeypatch.setattr(descent, "n_cores", lambda: cores)
    return make(policy, **{"update_threads": 2, **kwargs}).learn(3 * 96)


@pytest.mark.parametrize("space", [CHOICE, BOX, CHOICES], ids=["one", "box", "several"])
@pytest.mark.parametrize("policy", ["MlpPolicy", "GruPolicy"])
def test_two_threads_give_the_same_bits_again_and_where_there_is_one_core(
    policy, space, monkeypatch
):
    used = []
    compute = descent._part
    monkeypatch.setattr(
        descent, "_part", lambda *a: (used.append(threading.current_thread().name), compute(*a))[1]
    )
    alone = learned(policy, 1, monkeypatch, space=space)
    assert set(used) == {"MainThread"}
    together, again = (learned(policy, 2, monkeypatch, space=space) for _ in range(2))
    assert len(set(used)) == (1 if space is CHOICES else 2)  # their rating is kept in one object
    assert flat(together).equal(flat(alone))
    assert flat(together).equal(flat(again))
    single = learned(policy, 2, monkeypatch, space=space, update_threads=1)
    assert_close(flat(single), flat(together), 1e-4)


@pytest.fixture
def torch_threads():
    """Torch may use three."""
    before = th.get_num_threads()
    th.set_num_threads(3)
    yield 3
    th.set_num_threads(before)


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt, MemoryError])
@pytest.mark.parametrize("where", ["here", "beside"])
def test_an_error_on_either_thread_ends_the_update_and_the_thread(
    where, error, monkeypatch, torch_threads
):
    monkeypatch.setattr(descent, "HALVED_FROM", 1)
    monkeypatch.setattr(descent, "n_cores", lambda: 2)
    model = make(update_threads=2)
    compute, before = descent._part, threading.active_count()

    def fail(*args):
        if (threading.current_thread() is threading.main_thread()) == (where == "here"):
            raise error("stop")
        return compute(*args)

    with monkeypatch.context() as patch:
        patch.setattr(descent, "_part", fail)
        with pytest.raises(error):
            model.learn(96)
        assert th.get_num_threads() == torch_threads
    assert threading.active_count() == before
    model.learn(96)


def test_updates_leave_no_threads_and_the_number_of_torch_s_threads(monkeypatch):
    before = threading.active_count()
    monkeypatch.setattr(th, "get_num_threads", lambda: 3)
    chosen, of_others = [], []
    main = threading.current_thread()

    def choose(number):
        (chosen if threading.current_thread() is main else of_others).append(number)

    monkeypatch.setattr(th, "set_num_threads", choose)
    model = learned("MlpPolicy", 2, monkeypatch)
    assert threading.active_count() == before
    assert chosen == [1, 3] * (len(chosen) // 2) != []
    assert of_others == [1] * 3  # once in each update's second thread
    assert model._n_updates == 3 * 2


@pytest.mark.parametrize(
    ("wanted", "of_torch", "cores", "is_worker", "expected"),
    [
        (None, 2, 2, False, 2),
        (None, 8, 8, False, 1),  # torch's own do more than two halves
        (None, 1, 2, False, 1),  # several runs at once
        (None, 2, 1, False, 1),
        (None, 2, 2, True, 1),
        (1, 2, 2, False, 1),
        (2, 1, 1, True, 2),
    ],
)
def test_threads_follow_torch_and_the_cores_unless_they_are_chosen(
    wanted, of_torch, cores, is_worker, expected, monkeypatch
):
    monkeypatch.setattr(th, "get_num_threads", lambda: of_torch)
    monkeypatch.setattr(descent, "n_cores", lambda: cores)
    monkeypatch.setattr(multiprocessing, "parent_process", lambda: object() if is_worker else None)
    assert update_threads(wanted) == expected


@pytest.mark.parametrize("wanted", [0, 3, -1, 1.5, True, "2"])
def test_any_other_number_of_threads_is_refused(wanted):
    with pytest.raises(
        (ValueError, TypeError), match=r"update_threads is .*; expected 1 or 2, or None"
    ):
        make(update_threads=wanted)


def test_the_number_of_threads_is_saved(tmp_path):
    make(update_threads=2).save(tmp_path / "team")
    assert MAPPO.load(tmp_path / "team").update_threads == 2
    assert MAPPO.load(tmp_path / "team", update_threads=1).update_threads == 1
