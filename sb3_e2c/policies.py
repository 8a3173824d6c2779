"""Networks of a team: one shared actor on local observations, critics that see all of them.

Centralized training, decentralized execution (Sec. 2.1): ``predict`` needs one agent's observation
only. Shapes: B team steps, N agents, S = B·N slots, D observation size, G size of the critics'
extra state, K constrained parties (1 or N), M constraints.
"""

from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch as th
from stable_baselines3.common.distributions import (
    CategoricalDistribution,
    DiagGaussianDistribution,
)
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.torch_layers import create_mlp
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from torch import nn
from torch.distributions import Categorical, Normal

from sb3_e2c.sequences import Memory, Sequences


class StepEvaluation(NamedTuple):
    """What the networks say about B team steps; each field has the shape behind it."""

    log_prob: th.Tensor  # (B, N)
    entropy: th.Tensor  # (B, N)
    values: th.Tensor  # (B, N), in units of the value normalizer
    cost_values: th.Tensor  # (B, K, M), in units of the cost value normalizer
    value_latent: th.Tensor  # (B, 1, H), last hidden layer of the reward critic
    cost_latent: th.Tensor  # (B, K', H), of the cost critics


class RunningNorm(nn.Module):
    """Mean and variance of all targets seen so far, to give critics targets of unit size.

    Until the first update it is the identity.

    :param size: How many signals have a mean and a variance of their own
    """

    mean: th.Tensor
    var: th.Tensor
    count: th.Tensor

    def __init__(self, size: int):
        super().__init__()
        self.register_buffer("mean", th.zeros(size))
        self.register_buffer("var", th.ones(size))
        self.register_buffer("count", th.zeros(()))

    def update(self, targets: th.Tensor) -> None:
        """Take the targets of a rollout into account (Chan et al.'s parallel variance).

        :param targets: Shape (..., size)
        :raises ValueError: if their squares are beyond float32; nothing has changed then
        """
        if not targets.numel():
            return
        targets = targets.reshape(-1, len(self.mean)).to(self.mean)
        n, total = len(targets), len(targets) + self.count
        delta = targets.mean(dim=0) - self.mean
        var = targets.var(dim=0, unbiased=False)
        spread = delta**2 * (self.count * n / total)
        var = (self.var * self.count + var * n + spread) / total
        if not th.isfinite(var).all():
            raise ValueError(
                f"the critics' targets reach {targets.abs().max().item():g}, and their variance is "
                f"{var.max().item()}; training stops before the networks learn from them. Scale "
                "rewards and costs down, for example by reward_scale"
            )
        self.var.copy_(var)
        self.mean.add_(delta * (n / total))
        self.count.copy_(total)

    @property
    def _sd(self) -> th.Tensor:
        return self.var.sqrt().clamp(min=1e-6)

    def normalize(self, targets: th.Tensor) -> th.Tensor:
        """(x − mean) / sd, shape (..., size)."""
        return (targets - self.mean) / self._sd

    def denormalize(self, values: th.Tensor) -> th.Tensor:
        """The inverse of :meth:`normalize`, shape (..., size)."""
        return values * self._sd + self.mean


class TeamMlpExtractor(nn.Module):
    """Hidden layers of the actor (local features) and of the reward critic (joint features).

    The counterpart of Stable-Baselines3's ``MlpExtractor``, with an input of its own for each.

    :param features_dim: Size of one agent's features
    :param joint_dim: Size of the features of all agents, with the critics' extra state
    :param net_arch: Hidden sizes, ``{"pi": [...], "vf": [...]}``
    :param activation_fn: Activation after each layer
    """

    def __init__(
        self,
        features_dim: int,
        joint_dim: int,
        net_arch: dict[str, list[int]],
        activation_fn: type[nn.Module],
    ):
        super().__init__()
        self.policy_net, self.latent_dim_pi = mlp(features_dim, net_arch["pi"], activation_fn)
        self.value_net, self.latent_dim_vf = mlp(joint_dim, net_arch["vf"], activation_fn)

    def forward_actor(self, features: th.Tensor) -> th.Tensor:
        """Local features (S, F) to the actor's last hidden layer."""
        return self.policy_net(features)

    def forward_critic(self, features: th.Tensor) -> th.Tensor:
        """Joint features (B, joint_dim) to the critic's last hidden layer."""
        return self.value_net(features)


def mlp(input_dim: int, sizes: list[int], activation_fn: type[nn.Module]) -> tuple[nn.Module, int]:
    """Hidden layers only.

    :param input_dim: Size of the input
    :param sizes: Sizes of the layers; empty gives the identity
    :param activation_fn: Activation after each layer
    :return: The network and the size of its output
    """
    layers = create_mlp(input_dim, -1, sizes, activation_fn)
    return nn.Sequential(*layers), sizes[-1] if sizes else input_dim


class TeamPolicy(ActorCriticPolicy):
    """Shared actor, joint reward critic with N outputs, cost critics ("MlpPolicy" of MAPPO).

    :param n_agents: N
    :param n_constraints: M
    :param n_parties: K; 1: a team cost critic on the joint observation, N: individual cost critics
        on local observations (Sec. 4.1)
    :param critic_state_dim: G, size of the extra global features that critics see
    :param net_arch: ``{"pi": [...], "vf": [...], "cvf": [...]}`` or one list for all; "cvf", the
        cost critics, defaults to "vf"
    :param critic_lr_schedule: Learning rate of the critics; None: that of the actor
    :param kwargs: Arguments of Stable-Baselines3's ``ActorCriticPolicy``
    """

    recurrent = False

    def __init__(
        self,
        observation_space: Any,
        action_space: Any,
        lr_schedule: Schedule,
        n_agents: int = 1,
        n_constraints: int = 0,
        n_parties: int = 1,
        critic_state_dim: int = 0,
        net_arch: list[int] | dict[str, list[int]] | None = None,
        critic_lr_schedule: Schedule | None = None,
        **kwargs: Any,
    ):
        self.n_agents = n_agents
        self.n_constraints = n_constraints
        self.n_parties = n_parties
        self.critic_state_dim = critic_state_dim
        self.critic_lr_schedule = critic_lr_schedule or lr_schedule
        arch = parse_net_arch(net_arch)
        super().__init__(observation_space, action_space, lr_schedule, net_arch=arch, **kwargs)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        data.update(
            n_agents=self.n_agents,
            n_constraints=self.n_constraints,
            n_parties=self.n_parties,
            critic_state_dim=self.critic_state_dim,
        )
        return data

    @property
    def joint_dim(self) -> int:
        """Size of the joint critics' input."""
        return self.n_agents * self.features_dim + self.critic_state_dim

    def _build_mlp_extractor(self) -> None:
        assert isinstance(self.net_arch, dict)
        self.mlp_extractor = TeamMlpExtractor(  # type: ignore[assignment]
            self.features_dim, self.joint_dim, self.net_arch, self.activation_fn
        )

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        if self.n_agents > 1:
            self.value_net = nn.Linear(self.mlp_extractor.latent_dim_vf, self.n_agents)
            self._init_orthogonal(self.value_net, gain=1.0)
        self.value_norm = RunningNorm(1)
        self.cost_value_norm = RunningNorm(self.n_constraints)
        with th.random.fork_rng(devices=[]):  # a constraint leaves the other random numbers alone
            self._build_cost_critic()
        kwargs = dict(self.optimizer_kwargs)
        if self.optimizer_class is th.optim.Adam and "foreach" not in kwargs:
            kwargs.setdefault("fused", True)  # one call for all parameters; a fifth of an update
        self.optimizer = self.optimizer_class(self._parameter_groups(lr_schedule), **kwargs)

    def _build_cost_critic(self) -> None:
        if not self.n_constraints:
            self.cost_extractor: nn.Module = nn.Identity()
            self.cost_net: nn.Module = nn.Identity()
            return
        assert isinstance(self.net_arch, dict)
        input_dim = self.joint_dim if self.n_parties == 1 else self.features_dim
        self.cost_extractor, latent_dim = mlp(input_dim, self.net_arch["cvf"], self.activation_fn)
        self.cost_net = nn.Linear(latent_dim, self.n_constraints)
        self._init_orthogonal(self.cost_extractor, gain=np.sqrt(2))
        self._init_orthogonal(self.cost_net, gain=1.0)

    def _init_orthogonal(self, module: nn.Module, gain: float) -> None:
        if self.ortho_init:
            module.apply(partial(self.init_weights, gain=gain))

    def _parameter_groups(self, lr_schedule: Schedule) -> list[dict[str, Any]]:
        critics = [*self._critic_modules(), *self._cost_modules()]
        critic_params = [p for module in critics for p in module.parameters()]
        critic_ids = {id(p) for p in critic_params}
        actor_params = [p for p in self.parameters() if id(p) not in critic_ids]
        return [
            {"params": actor_params, "lr": lr_schedule(1)},
            {"params": critic_params, "lr": self.critic_lr_schedule(1)},
        ]

    def clipped_together(self) -> tuple[list[nn.Parameter], list[nn.Parameter]]:
        """Parameters whose gradients are clipped together: all but the cost critics', and those."""
        cost = [p for module in self._cost_modules() for p in module.parameters()]
        cost_ids = {id(p) for p in cost}
        return [p for p in self.parameters() if id(p) not in cost_ids], cost

    def _critic_modules(self) -> list[nn.Module]:
        own_features = [] if self.share_features_extractor else [self.vf_features_extractor]
        return [*own_features, self.mlp_extractor.value_net, self.value_net]

    def _cost_modules(self) -> list[nn.Module]:
        return [self.cost_extractor, self.cost_net]

    def evaluate_steps(
        self,
        observations: th.Tensor,
        actions: th.Tensor,
        critic_states: th.Tensor,
        sequences: Sequences | None = None,
    ) -> StepEvaluation:
        """Evaluate all networks on whole team steps.

        :param observations: Shape (B, N, D)
        :param actions: Shape (B, N, A)
        :param critic_states: Shape (B, G)
        :param sequences: How the steps follow each other, for recurrent policies
        :return: Log-probabilities and entropies of the actions, values, cost values
        """
        n_steps = len(observations)
        pi_features, vf_features = self._slot_features(observations)
        latent_pi = self._actor_latent(pi_features, sequences)
        log_prob, entropy = self._rate(latent_pi, self._flatten_actions(actions))
        shape = (n_steps, self.n_agents)
        critics = self._critics(vf_features, critic_states, sequences)
        return StepEvaluation(log_prob.view(shape), entropy.view(shape), *critics)

    def _rate(self, latent_pi: th.Tensor, actions: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Log-probabilities of actions, and entropies.

        The same numbers as from Stable-Baselines3's distributions, without torch's checks of their
        arguments, which take as long; a loss that is not finite stops the training anyway.

        :param latent_pi: Last hidden layer of the actor, shape (S, H)
        :param actions: Shape (S, A), or (S,) if discrete
        :return: Shape (S,) each
        """
        if isinstance(self.action_dist, DiagGaussianDistribution):
            mean = self.action_net(latent_pi)
            normal = Normal(mean, th.ones_like(mean) * self.log_std.exp(), validate_args=False)
            return normal.log_prob(actions).sum(dim=1), normal.entropy().sum(dim=1)
        if isinstance(self.action_dist, CategoricalDistribution):
            categorical = Categorical(logits=self.action_net(latent_pi), validate_args=False)
            return categorical.log_prob(actions), categorical.entropy()
        distribution = self._get_action_dist_from_latent(latent_pi)
        log_prob, entropy = distribution.log_prob(actions), distribution.entropy()
        # without an analytical form it is estimated from the actions taken
        return log_prob, -log_prob if entropy is None else entropy

    def team_values(
        self,
        observations: th.Tensor,
        critic_states: th.Tensor,
        sequences: Sequences | None = None,
    ) -> tuple[th.Tensor, th.Tensor]:
        """Evaluate the critics only, in the units of the rewards and of the costs.

        :param observations: Shape (B, N, D)
        :param critic_states: Shape (B, G)
        :param sequences: See :meth:`evaluate_steps`
        :return: Values (B, N), cost values (B, K, M)
        """
        features = self._slot_features(observations)[1]
        return self.denormalize(*self._critics(features, critic_states, sequences)[:2])

    def denormalize(self, values: th.Tensor, cost_values: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """From the critics' own units to those of the rewards and costs; shapes stay."""
        return self.value_norm.denormalize(values), self.cost_value_norm.denormalize(cost_values)

    def _slot_features(self, observations: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Features of each slot for the actor and for the critics, shape (B·N, F) each."""
        features = self.extract_features(observations.flatten(0, 1))
        return features if isinstance(features, tuple) else (features, features)

    def _critics(
        self, features: th.Tensor, critic_states: th.Tensor, sequences: Sequences | None
    ) -> tuple[th.Tensor, th.Tensor, th.Tensor, th.Tensor]:
        """Values (B, N), cost values (B, K, M), and the last hidden layers of both critics."""
        joint = self._joint_features(features, critic_states)
        value_latent = self._value_latent(joint, sequences)
        values = self.value_net(value_latent)
        by_step = (len(joint), self.n_parties, -1)
        if not self.n_constraints:
            nothing = values.new_zeros(len(joint), self.n_parties, 0)
            return values, nothing, value_latent[:, None], nothing
        cost_latent = self._cost_latent(joint if self.n_parties == 1 else features, sequences)
        cost_values = self.cost_net(cost_latent)
        return values, cost_values.view(by_step), value_latent[:, None], cost_latent.view(by_step)

    def _joint_features(self, features: th.Tensor, critic_states: th.Tensor) -> th.Tensor:
        """What joint critics see, shape (B, joint_dim), from the features (B·N, F)."""
        joint = features.reshape(len(critic_states), -1)
        return th.cat([joint, critic_states], dim=1) if self.critic_state_dim else joint

    def _actor_latent(self, features: th.Tensor, sequences: Sequences | None) -> th.Tensor:  # noqa: ARG002
        """Last hidden layer of the actor, from local features (B·N, F)."""
        return self.mlp_extractor.forward_actor(features)

    def _value_latent(self, features: th.Tensor, sequences: Sequences | None) -> th.Tensor:  # noqa: ARG002
        """Last hidden layer of the reward critic, from joint features (B, F)."""
        return self.mlp_extractor.forward_critic(features)

    def _cost_latent(self, features: th.Tensor, sequences: Sequences | None) -> th.Tensor:  # noqa: ARG002
        """Last hidden layer of the cost critics, from the features (B·K, F) that they see."""
        return self.cost_extractor(features)

    def empty_memory(self, n_worlds: int) -> Memory:
        """Hidden states at the start of an episode; of no size where there is no recurrence.

        :param n_worlds: W
        """
        nothing = th.zeros(n_worlds, 1, 0, device=self.device)
        return Memory(nothing.expand(-1, self.n_agents, -1), nothing, nothing)

    def act(self, obs: th.Tensor, states: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Sample actions.

        :param obs: Observations of any slots, shape (S, D)
        :param states: Hidden states of the actor, shape (S, H)
        :return: Actions (S, ...), and the next hidden states
        """
        # ActorCriticPolicy's own would also run the critics' extractor, if they have one.
        features = BasePolicy.extract_features(self, obs, self.pi_features_extractor)
        return self._sample(self.mlp_extractor.forward_actor(features)), states

    def _sample(self, latent_pi: th.Tensor) -> th.Tensor:
        """Actions from the actor's last hidden layer.

        The same numbers as from torch's distribution, whose checks take longer than the network.

        :param latent_pi: Shape (S, H)
        """
        if isinstance(self.action_dist, DiagGaussianDistribution):
            mean = self.action_net(latent_pi)
            return mean + th.randn_like(mean) * self.log_std.exp()
        distribution = self._get_action_dist_from_latent(latent_pi)
        return distribution.get_actions(deterministic=False)

    def _flatten_actions(self, actions: th.Tensor) -> th.Tensor:
        """Actions (B, N, A) as SB3's distributions want them: (B·N, A), or (B·N,) if discrete."""
        if len(self.action_space.shape or ()) == 0:
            return actions.reshape(-1).long()
        return actions.flatten(0, 1)

    def forward(
        self, obs: th.Tensor, deterministic: bool = False
    ) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """Actions, values and log-probabilities of slots in world order.

        Stable-Baselines3's interface, which knows of no other steps: with GRUs these begin an
        episode.

        :param obs: Observations of whole teams, shape (B·N, D)
        :param deterministic: Whether to take the most likely action
        :return: Actions (B·N, ...), values (B·N, 1), log-probabilities (B·N,)
        :raises ValueError: If critics see more than the observations
        """
        distribution = self.get_distribution(obs)
        actions = distribution.get_actions(deterministic=deterministic)
        log_prob = distribution.log_prob(actions)
        return actions.reshape(-1, *self.action_space.shape), self.predict_values(obs), log_prob  # type: ignore[misc]

    def evaluate_actions(  # type: ignore[override]
        self, obs: th.Tensor, actions: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """Values, log-probabilities and entropies of slots in world order; see :meth:`forward`."""
        teams = obs.unflatten(0, (-1, self.n_agents))
        joint_actions = actions.reshape(*teams.shape[:2], -1)
        evaluation = self.evaluate_steps(teams, joint_actions, self._no_critic_state(len(teams)))
        values, _ = self.denormalize(evaluation.values, evaluation.cost_values)
        return values.reshape(-1, 1), evaluation.log_prob.flatten(), evaluation.entropy.flatten()

    def predict_values(self, obs: PyTorchObs) -> th.Tensor:
        """Values of slots in world order, shape (B·N, 1); see :meth:`forward`."""
        assert isinstance(obs, th.Tensor)
        teams = obs.unflatten(0, (-1, self.n_agents))
        return self.team_values(teams, self._no_critic_state(len(teams)))[0].reshape(-1, 1)

    def _no_critic_state(self, n_steps: int) -> th.Tensor:
        if self.critic_state_dim:
            raise ValueError(
                f"these critics see {self.critic_state_dim} numbers of info['critic_state'] beside "
                "the observations; give them to team_values() or evaluate_steps()"
            )
        return th.zeros(n_steps, self.critic_state_dim, device=self.device)


def parse_net_arch(net_arch: list[int] | dict[str, list[int]] | None) -> dict[str, list[int]]:
    """Hidden sizes of the actor, the reward critic and the cost critics.

    :param net_arch: One list for all, or a dict with "pi", "vf" and, if it differs, "cvf"
    :return: A dict with the three keys; [64, 64] each by default, as in Stable-Baselines3
    """
    if net_arch is None:
        net_arch = [64, 64]
    if not isinstance(net_arch, dict):
        net_arch = {"pi": net_arch, "vf": net_arch}
    unknown = set(net_arch) - {"pi", "vf", "cvf"}
    if unknown:
        raise ValueError(
            f"net_arch has the keys {sorted(net_arch)}; expected 'pi', 'vf' and optionally 'cvf'"
        )
    vf = net_arch.get("vf", [])
    parsed = {"pi": net_arch.get("pi", []), "vf": vf, "cvf": net_arch.get("cvf", vf)}
    for name, sizes in parsed.items():
        if not isinstance(sizes, (list, tuple)) or not all(_is_size(size) for size in sizes):
            raise ValueError(
                f"net_arch has {sizes!r} for {name!r}; expected a list of layer sizes, such as "
                "[128, 128]"
            )
    return {name: list(sizes) for name, sizes in parsed.items()}


def _is_size(size: object) -> bool:
    return isinstance(size, int) and not isinstance(size, bool) and size > 0
