"""Watch how far every update moves a team, and what it does to its costs (Lemma 1).

What the numbers mean, and what they do not, stands in docs/bounds.md.

Shapes: T steps, W worlds, N agents, S = W·N slots, B = T·W team steps, K constrained parties (1 or
N), M costs.
"""

import math
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from numbers import Real
from typing import Any, NamedTuple

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.distributions import (
    CategoricalDistribution,
    DiagGaussianDistribution,
    Distribution,
    MultiCategoricalDistribution,
)

from sb3_e2c import bounds
from sb3_e2c.buffers import TeamRolloutBuffer
from sb3_e2c.constraints import party_costs, read_costs
from sb3_e2c.mappo import MAPPO
from sb3_e2c.monitor import named_costs
from sb3_e2c.policies import TeamPolicy
from sb3_e2c.sequences import Memory, Sequences, cut_at_ends


class Signal(NamedTuple):
    """What the team has got in a rollout: costs, summed over the parties, or the mean reward."""

    gamma: float
    values: np.ndarray  # (T, W, M), without the bootstrap of time-outs
    advantages: np.ndarray  # (T, W, M), not standardized


class ActorOutputs(NamedTuple):
    """What the actor says about all slots of a rollout, in the order of :func:`team_rows`."""

    raw: th.Tensor | None  # (B·N, A), logits or means; None where the policy shows none
    log_std: th.Tensor | None  # (A,), of a Gaussian policy
    log_prob: th.Tensor  # (B, N), of the actions taken


class Step(NamedTuple):
    """How far an update has moved the policy."""

    log_ratios: np.ndarray  # (T, W, N)
    kls: np.ndarray  # (T, W, N)


class Rollout(NamedTuple):
    """What is kept of a rollout while the policy learns from it."""

    buffer: TeamRolloutBuffer  # its arrays stay as they are until the next step
    initial: Memory | None
    ages: np.ndarray  # (T, W), steps since the episode began
    costs: Signal
    reward: Signal
    old: ActorOutputs

    @property
    def begins(self) -> bool:
        """Whether an episode begins in it, without which there is no mean over episodes."""
        return bool((self.ages == 0).any())

    def weights(self, gamma: float) -> np.ndarray:
        """Weight g of each step, shape (T, W); see :func:`sb3_e2c.bounds.visit_weights`."""
        return bounds.visit_weights(self.ages, gamma)


class TrustRegionMonitor(BaseCallback):
    """Log what each update of MAPPO does to the team's costs: predicted, bounded and realised.

    After an update, the policy is evaluated once more on the rollout, without gradients; the next
    rollout shows what came of it. One row of the log holds both. Nothing of this changes what is
    learned, unless ``max_joint_kl`` or ``max_excess`` is given: then it is done after every epoch,
    and what remains of the epochs is skipped once a limit is exceeded.

    ``bounds/...``, in discounted cost of an episode, with ``_0, _1, ...`` behind it if there are
    several costs:

    - ``cost``, J of the rollout that was learned from; ``joint``, ``sum`` and ``agent_i``, the
      predictions L(π̄), Σᵢ Lᵢ and Lᵢ of its change; ``interaction``, their difference
    - ``change``, what the next rollout shows, and ``error`` = change − joint
    - ``t1``, ``t1b``, ``t3``: bounds of the new cost; ``printed_not_a_bound``: Lemma 1, the
      smallest over the agents; ``epsilon``, the ε in them
    - ``ep_cost_predicted``: undiscounted cost of an episode after the update, as limits have it
    - ``reward``, ``reward_joint``, ``reward_sum``, ``reward_change``, ``reward_error``: the same
      for the mean agent's reward, with the bonus and the scale that it is learned with
    - ``kl``, ``kl_agent_i``: mean divergence, joint and of each agent; ``kl_max``, the sum of the
      agents' largest; ``tv``; ``sample_size``, the effective one as a share; ``unreliable``, 1 if
      that is below ``min_sample_size``; ``epochs``, if they are limited

    With individual constraints the team's cost is the sum of its agents' (their mean where the
    environment declares ``team_cost="max"``, for agents who all report the same).

    :param max_cost: Largest cost of the team in one step, one number or one for each cost, which
        gives ε = c_max / (1 − γ); None takes the largest |A| and cost of the rollout, and makes
        the bounds estimates
    :param min_sample_size: Effective sample size, as a share of the team steps, below which the
        joint surrogate is called unreliable
    :param max_joint_kl: Largest ``bounds/kl`` (nats) after which another epoch may follow; the
        joint KL is the sum of the agents', N times what ``target_kl`` is compared with
    :param max_excess: By how much ``bounds/ep_cost_predicted`` may exceed its limit; an update that
        is predicted to lower the cost goes on
    :param verbose: 1 says when epochs are skipped
    :raises ValueError: for arguments that make no sense
    """

    model: MAPPO

    def __init__(
        self,
        max_cost: float | Sequence[float] | None = None,
        min_sample_size: float = 0.5,
        max_joint_kl: float | None = None,
        max_excess: float | None = None,
        verbose: int = 0,
    ):
        super().__init__(verbose)
        self.max_cost = None if max_cost is None else np.atleast_1d(max_cost)
        for number in [] if self.max_cost is None else self.max_cost.tolist():
            _check_amount("max_cost", number)
        if self.max_cost is not None and not self.max_cost.all():
            raise ValueError(f"max_cost is {max_cost!r}; expected numbers above 0")
        if min_sample_size is None:
            raise ValueError("min_sample_size is None; expected a share, 0 to 1")
        _check_amount("min_sample_size", min_sample_size, most=1.0)
        _check_amount("max_joint_kl", max_joint_kl)
        _check_amount("max_excess", max_excess)
        self.min_sample_size = min_sample_size
        self.max_joint_kl, self.max_excess = max_joint_kl, max_excess
        self._ages = np.zeros(0, np.int64)  # (W,) of the running episodes
        self._hook: Any = None
        self._warned: set[str] = set()

    @property
    def _limits_epochs(self) -> bool:
        return self.max_joint_kl is not None or self.max_excess is not None

    # ------------------------------------------------------------------ the callback

    def _init_callback(self) -> None:
        if not isinstance(self.model, MAPPO):
            raise TypeError(
                f"{type(self.model).__name__} does not keep its rollouts by team: use "
                "TrustRegionMonitor with MAPPO or E2CMAPPO."
            )
        n_costs = len(self.model.cost_limits)
        if self.max_excess is not None and not n_costs:
            raise ValueError(
                f"max_excess is {self.max_excess}, but the model has no cost limit that could be "
                "exceeded: set cost_limits, or leave max_excess away."
            )
        if self.max_cost is not None and len(self.max_cost) not in (1, n_costs):
            raise ValueError(
                f"max_cost is {self.max_cost.tolist()}, but there are {n_costs} cost limits: give "
                "one number, or one for each."
            )

    def _on_training_start(self) -> None:
        starts = np.asarray(self.model._last_episode_starts, bool)[:: self.model.n_agents]
        if len(self._ages) != len(starts):
            self._ages = np.ones(len(starts), np.int64)  # of episodes that began before this: ≥ 1
        self._ages = np.where(starts, 0, self._ages)
        self._learned_from: Rollout | None = None
        self._predicted: dict[str, np.ndarray] = {}
        self._levels: dict[str, np.ndarray] = {}
        self._epochs = 0
        self._raw: th.Tensor | None = None  # (B·N, A)
        if self._limits_epochs:
            self.model.stop_epochs = self._goes_too_far

    def _follow_actor(self) -> None:
        """Keep what the actor's last layer says: the buffer has no action distributions.

        The last thing before the end of a rollout is to evaluate all of it, with the old policy;
        listening there saves another pass. Networks to which nobody listens learn faster.
        """
        self._release()
        self._raw = None
        buffer = self.model.rollout_buffer
        self._n_rows = buffer.buffer_size * buffer.n_envs
        layer = getattr(self.model.policy, "action_net", None)
        if isinstance(layer, th.nn.Module):
            self._hook = layer.register_forward_hook(self._keep_output)

    def _keep_output(self, _layer: th.nn.Module, _inputs: Any, output: th.Tensor) -> None:
        if len(output) == self._n_rows:  # not a single step of the rollout, nor an evaluation
            self._raw = output.detach()

    def _release(self) -> None:
        if self._hook is not None:
            self._hook.remove()
        self._hook = None

    def _on_rollout_start(self) -> None:
        self._report_update()
        self._follow_actor()
        self._first_ages = self._ages
        self._ends: dict[int, tuple[np.ndarray, np.ndarray]] = {}

    def _on_step(self) -> bool:
        ended = np.asarray(self.locals["dones"], bool)[:: self.model.n_agents]
        self._ages = np.where(ended, 0, self._ages + 1)
        if ended.any():  # the buffer will add what a time limit cut off, which nobody has paid
            step = self.model.rollout_buffer.pos
            self._ends[step] = (self.locals["rewards"], self._paid_costs())
        return True

    def _on_rollout_end(self) -> None:
        self._learned_from = rollout = self._keep_rollout()
        self._release()
        if not rollout.begins:
            self._warn_once(
                "episodes",
                "No episode begins in a rollout, so that TrustRegionMonitor cannot tell the mean "
                "cost of episodes: it logs divergences only. Collect whole episodes (n_steps).",
            )
        before, self._levels = self._levels, self._levels_of(rollout)
        for name in self._predicted.keys() & self._levels.keys():
            change = self._levels[name] - before[name]
            self._record(_key(name, "change"), change)
            self._record(_key(name, "error"), change - self._predicted[name])

    def _on_training_end(self) -> None:
        self._report_update()
        self._release()
        self.model.stop_epochs = None

    # ------------------------------------------------------------------ the rollout

    def _paid_costs(self) -> np.ndarray:
        """Costs of the parties in this step, as the environment reports them, (W, K, M)."""
        model = self.model
        if not len(model.cost_limits):
            return np.zeros((len(self._ages), *model.rollout_buffer.party_shape))
        costs = read_costs(self.locals["infos"], model.agents)
        return party_costs(costs, model.cost_scope, getattr(model.env, "team_cost", "sum"))

    def _keep_rollout(self) -> Rollout:
        buffer = self.model.rollout_buffer
        rewards, costs = buffer.rewards.astype(np.float64), buffer.costs.astype(np.float64)
        for step, paid in self._ends.items():
            rewards[step], costs[step] = paid
        log_prob = th.from_numpy(buffer.log_probs.copy()).view(-1, self.model.n_agents)
        rows, _ = team_rows(buffer, buffer.initial)
        log_prob = log_prob if rows is None else log_prob[rows]
        old = ActorOutputs(self._raw, _log_std(self.model.policy), log_prob)
        return Rollout(
            buffer=buffer,
            initial=buffer.initial,
            ages=episode_ages(buffer.dones, self._first_ages),
            costs=Signal(buffer.cost_gamma, costs.sum(2), buffer.cost_advantages.sum(2)),
            reward=Signal(
                buffer.gamma, self._of_agents(rewards), self._of_agents(buffer.advantages)
            ),
            old=old,
        )

    def _of_agents(self, rewards: np.ndarray) -> np.ndarray:
        """Mean over the agents, which is what an update improves, from (T, S): (T, W, 1)."""
        return rewards.reshape(len(rewards), -1, self.model.n_agents).mean(-1, keepdims=True)

    def _levels_of(self, rollout: Rollout) -> dict[str, np.ndarray]:
        """J of the costs and the reward, shape (M,) and (1,); empty if no episode begins."""
        if not rollout.begins:
            return {}
        signals = {"": rollout.costs, "reward": rollout.reward}
        return {
            name: bounds.visit_sum(signal.values, rollout.weights(signal.gamma))
            for name, signal in signals.items()
        }

    # ------------------------------------------------------------------ the update

    def _measure(self, rollout: Rollout) -> Step:
        """Compare the policy as it is now with the one that collected the rollout."""
        buffer, policy = rollout.buffer, self.model.policy
        rows, sequences = team_rows(buffer, rollout.initial)
        self._follow_actor()
        with _evaluating(policy), th.no_grad(), self.model.explained_divergence():
            log_prob = _log_prob(policy, buffer, rows, sequences)
        self._release()
        new = ActorOutputs(self._raw, _log_std(policy), log_prob.cpu().view(-1, buffer.n_agents))
        log_ratios = (new.log_prob - rollout.old.log_prob).double().numpy()
        kls = agent_kls(policy.action_dist, rollout.old, new)
        shape = (buffer.buffer_size, buffer.n_worlds, buffer.n_agents)
        return Step(*(in_order(each, rows).reshape(shape) for each in (log_ratios, kls)))

    def _report_update(self) -> None:
        """Log what the update from the last rollout has done; nothing if there was none."""
        rollout, self._learned_from = self._learned_from, None
        if rollout is None:
            return
        self._predicted = {}
        step = self._measure(rollout)
        self._report_step(rollout, step)
        if self._limits_epochs:
            self.logger.record("bounds/epochs", self._epochs)
            self._epochs = 0
        if rollout.begins:
            self._report_predictions(rollout, step)

    def _report_step(self, rollout: Rollout, step: Step) -> None:
        kls = mean_kls(rollout, step)
        size = bounds.effective_sample_size(step.log_ratios)
        self.logger.record("bounds/kl", float(kls.sum()))
        for agent, kl in enumerate(kls):
            self.logger.record(f"bounds/kl_agent_{agent}", float(kl), exclude="stdout")
        self.logger.record("bounds/kl_max", float(step.kls.max((0, 1)).sum()))
        self.logger.record("bounds/tv", float(bounds.mean_tv(step.log_ratios, _visits(rollout))))
        self.logger.record("bounds/sample_size", size)
        self.logger.record("bounds/unreliable", int(size < self.min_sample_size))
        if size < self.min_sample_size:
            self._warn_once(
                "sample size",
                f"After {self.model.num_timesteps} agent steps, an update left an effective sample "
                f"size of {size:.2f} (a share of the rollout; min_sample_size is "
                f"{self.min_sample_size:g}): a few samples make the joint surrogate, and "
                "bounds/joint means little where bounds/unreliable is 1. Smaller updates keep it "
                "large: fewer epochs, a lower learning_rate or clip_range, or max_joint_kl.",
            )

    def _report_predictions(self, rollout: Rollout, step: Step) -> None:
        for name, signal in (("", rollout.costs), ("reward", rollout.reward)):
            sample = (step.log_ratios, signal.advantages, rollout.weights(signal.gamma))
            self._predicted[name] = joint = bounds.joint_surrogate(*sample)
            alone = bounds.agent_surrogates(*sample)
            self._record(name or "cost", self._levels[name])
            self._record(_key(name, "joint"), joint)
            self._record(_key(name, "sum"), alone.sum(0))
            if not name:
                self._record("interaction", joint - alone.sum(0))
                self._report_agents(alone)
                self._report_bounds(rollout, step, joint, alone)
        cost, change = episode_costs(rollout, step)
        self._record("ep_cost_predicted", cost + change)

    def _report_agents(self, alone: np.ndarray) -> None:
        for agent, surrogate in enumerate(alone):
            self._record(f"agent_{agent}", surrogate, exclude="stdout")

    def _report_bounds(
        self, rollout: Rollout, step: Step, joint: np.ndarray, alone: np.ndarray
    ) -> None:
        """Log the bounds of the new cost; there are none for a cost without a discount.

        :param rollout: What was learned from
        :param step: How far the policy has moved
        :param joint: L(π̄), shape (M,)
        :param alone: Lᵢ, shape (N, M)
        """
        signal = rollout.costs
        if signal.gamma == 1 or not len(joint):
            return
        cost, gamma, max_kls = self._levels[""], signal.gamma, step.kls.max((0, 1))
        max_cost, epsilon = self._largest(signal)
        tv = bounds.mean_tv(step.log_ratios, rollout.weights(gamma))
        joint_kl = float(step.kls.sum(-1).max())
        expected = bounds.largest_expected_advantage(epsilon, joint_kl, max_cost, gamma)
        printed = bounds.printed_not_a_bound(cost, alone, max_kls, epsilon, gamma)
        self._record("epsilon", epsilon)
        self._record("t1", bounds.joint_bound(cost, joint, max_kls, epsilon, gamma))
        self._record("t1b", bounds.average_bound(cost, joint, expected, tv, gamma))
        self._record("t3", bounds.sum_bound(cost, alone.sum(0), max_kls, epsilon, gamma))
        self._record("printed_not_a_bound", printed.min(0))

    def _largest(self, signal: Signal) -> tuple[np.ndarray, np.ndarray]:
        """Largest cost of the team in a step, and ε ≥ |A|, shape (M,) each."""
        if self.max_cost is None:
            return signal.values.max((0, 1)), np.abs(signal.advantages).max((0, 1))
        max_cost = np.broadcast_to(self.max_cost, signal.values.shape[2:])
        return max_cost, np.asarray(bounds.largest_advantage(max_cost, signal.gamma))

    # ------------------------------------------------------------------ the control

    def _goes_too_far(self) -> bool:
        """Whether the update must end here; MAPPO asks after every epoch."""
        rollout = self._learned_from
        assert rollout is not None, "MAPPO learns from the rollout that has just ended"
        self._epochs += 1
        step = self._measure(rollout)
        reason = self._too_far(rollout, step)
        if reason and self.verbose > 0:
            print(f"TrustRegionMonitor: no more epochs after {self._epochs}, {reason}")
        return bool(reason)

    def _too_far(self, rollout: Rollout, step: Step) -> str:
        """Which limit an update exceeds; empty if none."""
        kl = mean_kls(rollout, step).sum()
        if self.max_joint_kl is not None and kl > self.max_joint_kl:
            return f"joint KL {kl:.4f}"
        if self.max_excess is None or not rollout.begins:
            return ""
        cost, change = episode_costs(rollout, step)
        excess = cost + change - self.model.cost_limits
        if ((change > 0) & (excess > self.max_excess)).any():
            return f"predicted excess {excess.max():.4g}"
        return ""

    # ------------------------------------------------------------------ logging

    def _record(self, name: str, values: np.ndarray, exclude: str | None = None) -> None:
        """Log one number for each cost, shape (M,), or the one of the reward."""
        for key, value in named_costs(values.tolist(), name).items():
            self.logger.record(f"bounds/{key}", value, exclude=exclude)

    def _warn_once(self, topic: str, message: str) -> None:
        if topic not in self._warned:
            self._warned.add(topic)
            warnings.warn(message, stacklevel=2)


def episode_ages(dones: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Steps since the running episode began, at each step of a rollout.

    :param dones: Whether a step ended an episode, shape (T, W)
    :param first: Ages at the first step, shape (W,)
    :return: Shape (T, W)
    """
    ages = np.empty(dones.shape, np.int64)
    ages[0] = first
    for t, ended in enumerate(dones[:-1]):
        ages[t + 1] = np.where(ended, 0, ages[t] + 1)
    return ages


def episode_costs(rollout: Rollout, step: Step) -> tuple[np.ndarray, np.ndarray]:
    """Undiscounted cost of an episode, and its predicted change: Σ c and Σ (q − 1) A per episode.

    Advantages are discounted, so that the change misses what comes long after an action.

    :param rollout: A rollout in which episodes begin
    :param step: How far the policy has moved
    :return: Shape (M,) each
    """
    weights, signal = rollout.weights(1.0), rollout.costs
    change = bounds.joint_surrogate(step.log_ratios, signal.advantages, weights)
    return bounds.visit_sum(signal.values, weights), change


def mean_kls(rollout: Rollout, step: Step) -> np.ndarray:
    """Divergence of each agent in the mean visited state, shape (N,)."""
    return bounds.visit_mean(step.kls, _visits(rollout))


def _visits(rollout: Rollout) -> np.ndarray:
    """Weights of the visits for means, also where no episode begins, shape (T, W)."""
    return rollout.costs.gamma ** (rollout.ages - rollout.ages.min()).astype(np.float64)


def team_rows(
    buffer: TeamRolloutBuffer, initial: Memory | None
) -> tuple[th.Tensor | None, Sequences | None]:
    """Order in which the networks see the team steps of a rollout, and their sequences.

    :param buffer: The rollout
    :param initial: Hidden states before it; None: the policy is not recurrent
    :return: Rows step · W + world, shape (B,); None: as they are
    """
    if initial is None:
        return None, None
    rows, sequences = buffer._pack(cut_at_ends(buffer.dones), initial)
    return rows.cpu(), sequences


def in_order(values: np.ndarray, rows: th.Tensor | None) -> np.ndarray:
    """Undo the order of :func:`team_rows`, shape (B, N)."""
    if rows is None:
        return values
    ordered = np.empty_like(values)
    ordered[rows.numpy()] = values
    return ordered


def agent_kls(distribution: Distribution, old: ActorOutputs, new: ActorOutputs) -> np.ndarray:
    """KL(π ‖ π̄) of every agent in every step: exact where the policy has a closed form.

    :param distribution: What kind of distribution the policy has
    :param old: Before the update
    :param new: After it
    :return: Shape (B, N); otherwise estimates from the actions taken (k3), right in the mean only
    """
    shape = tuple(new.log_prob.shape)
    if old.raw is None or new.raw is None:
        return bounds.sampled_kl((new.log_prob - old.log_prob).double().numpy())
    before, after = (each.cpu().double() for each in (old.raw, new.raw))
    if isinstance(distribution, DiagGaussianDistribution):
        stds = (each.log_std.cpu().double().numpy() for each in (old, new))  # type: ignore[union-attr]
        old_std, new_std = stds
        return bounds.gaussian_kl(before.numpy(), old_std, after.numpy(), new_std).reshape(shape)
    sizes = [before.shape[-1]]
    if isinstance(distribution, MultiCategoricalDistribution):
        sizes = list(distribution.action_dims)
    elif not isinstance(distribution, CategoricalDistribution):
        return agent_kls(distribution, old._replace(raw=None), new)
    pairs = zip(before.split(sizes, -1), after.split(sizes, -1), strict=True)
    log_probs = ((th.log_softmax(each, -1).numpy() for each in pair) for pair in pairs)
    kls = [bounds.categorical_kl(*pair) for pair in log_probs]
    return np.sum(kls, axis=0).reshape(shape)


def _log_prob(
    policy: TeamPolicy,
    buffer: TeamRolloutBuffer,
    rows: th.Tensor | None,
    sequences: Sequences | None,
) -> th.Tensor:
    """Log-probabilities of the actions taken, shape (B·N,); evaluates the actor only."""
    observations, actions, _ = buffer._network_inputs()
    if rows is not None:
        rows = rows.to(observations.device)
        observations, actions = observations[rows], actions[rows]
    features, _ = policy._slot_features(observations)
    distribution = policy._get_action_dist_from_latent(policy._actor_latent(features, sequences))
    return distribution.log_prob(policy._flatten_actions(actions))


def _log_std(policy: TeamPolicy) -> th.Tensor | None:
    log_std = getattr(policy, "log_std", None)
    return None if log_std is None else log_std.detach().clone()


@contextmanager
def _evaluating(policy: TeamPolicy) -> Iterator[None]:
    """Switch off what behaves differently in training, for a while."""
    training = policy.training
    policy.set_training_mode(False)
    try:
        yield
    finally:
        policy.set_training_mode(training)


def _key(name: str, what: str) -> str:
    return f"{name}_{what}" if name else what


def _check_amount(name: str, number: Any, most: float = math.inf) -> None:
    if number is None:
        return
    is_number = isinstance(number, Real) and not isinstance(number, bool)
    if not (is_number and 0 <= number <= most) or number == math.inf:
        highest = "" if most == math.inf else f" and at most {most:g}"
        raise ValueError(f"{name} is {number!r}; expected a number of at least 0{highest}")
