"""Forward and backward passes of a policy's networks over a part of a minibatch.

:class:`Passes` leaves both to the policy and to torch, whatever the policy is. :class:`MlpPasses`
does them by hand for the networks of :class:`TeamPolicy`: the same operations, in arrays that stay
from one minibatch to the next, without what recording and replaying costs (a third of it all).

Shapes: B team steps, N agents, P numbers in all parameters.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch as th
from numba import njit
from stable_baselines3.common.distributions import (
    CategoricalDistribution,
    DiagGaussianDistribution,
)
from stable_baselines3.common.torch_layers import FlattenExtractor
from torch import nn

from sb3_e2c.buffers import TeamSamples
from sb3_e2c.objective import Outputs
from sb3_e2c.policies import TeamPolicy
from sb3_e2c.ratings import CategoricalRating, GaussianRating, Rating
from sb3_e2c.sequences import Sequences

# Actions that TeamPolicy rates without keeping anything in the distribution object
STATELESS = (DiagGaussianDistribution, CategoricalDistribution)


class Passes:
    """Passes of any policy, with automatic differentiation.

    :param policy: The networks
    :param parameters: What learns
    """

    def __init__(self, policy: TeamPolicy, parameters: Sequence[nn.Parameter]):
        self.policy = policy
        self.parameters = parameters
        sizes = [parameter.numel() for parameter in parameters]
        like = parameters[0]
        self.gradient = th.zeros(sum(sizes), device=like.device, dtype=like.dtype)  # (P,)
        pairs = zip(self.gradient.split(sizes), parameters, strict=True)
        # The gradient of each parameter, a piece of all; None: the objective does not depend on it
        self._all_pieces = [piece.view(p.shape) for piece, p in pairs]
        self.pieces: list[th.Tensor | None] = list(self._all_pieces)

    def forward(self, batch: TeamSamples, sequences: Sequences | None) -> Outputs:
        """Evaluate the networks.

        :param batch: B team steps
        :param sequences: How they follow each other, for recurrent policies
        """
        inputs = (batch.observations, batch.actions, batch.critic_states)
        with th.enable_grad():
            evaluation = self.policy.evaluate_steps(*inputs, sequences)
        self._outputs = Outputs(*evaluation[:4])
        return Outputs(*(each.detach() for each in self._outputs))

    def backward(self, gradients: Outputs) -> None:
        """Fill :attr:`gradient` and :attr:`pieces`.

        :param gradients: Of the objective, at what the last forward pass returned
        """
        pairs = zip(self._outputs, gradients, strict=True)
        outputs, known = zip(*(pair for pair in pairs if pair[0].requires_grad), strict=True)
        found = th.autograd.grad(outputs, self.parameters, known, allow_unused=True)
        self.pieces = []
        for piece, gradient in zip(self._all_pieces, found, strict=True):
            if gradient is None:
                piece.zero_()
            else:
                piece.copy_(gradient)
            self.pieces.append(None if gradient is None else piece)
        del self._outputs


class MlpPasses(Passes):
    """Passes of a :class:`TeamPolicy` as it is, for Gaussian or categorical actions, on a CPU.

    :param policy: See :meth:`is_for`
    :param parameters: All that the policy has
    """

    def __init__(self, policy: TeamPolicy, parameters: Sequence[nn.Parameter]):
        super().__init__(policy, parameters)
        pieces: Any = dict(zip(parameters, self._all_pieces, strict=True))
        networks = [_Network([*hidden, last], pieces) for hidden, last in _networks(policy)]
        self._actor, self._value, *self._cost = networks
        self._ratings: GaussianRating | CategoricalRating = CategoricalRating()
        if isinstance(policy.action_dist, DiagGaussianDistribution):
            self._ratings = GaussianRating(policy.log_std, pieces[policy.log_std])

    @staticmethod
    def is_for(policy: TeamPolicy, parameters: Sequence[nn.Parameter]) -> bool:
        """Whether the policy is one that can be computed so."""
        return (
            type(policy) is TeamPolicy
            and not any(hasattr(TeamPolicy, name) for name in vars(policy))  # a method replaced
            and type(policy.action_dist) in STATELESS
            and type(policy.pi_features_extractor) is FlattenExtractor
            and type(policy.vf_features_extractor) is FlattenExtractor
            and all(_is_mlp(*parts) for parts in _networks(policy))
            and not any(_is_watched(module) for module in policy.modules())
            and not any(parameter._backward_hooks for parameter in parameters)
            and len(parameters) == len(list(policy.parameters()))
            and all(p.device.type == "cpu" and p.dtype == th.float32 for p in parameters)
        )

    def forward(self, batch: TeamSamples, sequences: Sequences | None) -> Outputs:  # noqa: ARG002
        """See :meth:`Passes.forward`."""
        policy, shape = self.policy, batch.advantages.shape
        with th.no_grad():
            own, features = policy._slot_features(batch.observations)
            joint = policy._joint_features(features, batch.critic_states)
            values = self._value.forward(joint)
            cost_values = batch.cost_returns
            for network in self._cost:
                seen = joint if policy.n_parties == 1 else features
                cost_values = network.forward(seen).view(batch.cost_returns.shape)
            actions = policy._flatten_actions(batch.actions)
            rating = self._ratings.rate(self._actor.forward(own), actions)
        log_prob, entropy = (each.view(shape) for each in rating)
        return Outputs(log_prob, entropy, values, cost_values)

    def backward(self, gradients: Outputs) -> None:
        """See :meth:`Passes.backward`."""
        known = Rating(gradients.log_prob.view(-1), gradients.entropy.view(-1))
        self._actor.backward(self._ratings.gradient(known))
        self._value.backward(gradients.values)
        for network in self._cost:
            network.backward(gradients.cost_values.flatten(0, 1))


def _networks(policy: TeamPolicy) -> list[tuple[Any, nn.Module]]:
    """Hidden layers and the last one of the actor, the reward critic and the cost critics."""
    extractor = policy.mlp_extractor
    networks: list[tuple[Any, nn.Module]] = [
        (extractor.policy_net, policy.action_net),
        (extractor.value_net, policy.value_net),
    ]
    return networks + [(policy.cost_extractor, policy.cost_net)] * bool(policy.n_constraints)


def _is_mlp(hidden: Any, last: nn.Module) -> bool:
    """Whether it is linear layers with one kind of activation behind each but the last."""
    if type(hidden) is not nn.Sequential:
        return False
    kinds = [type(layer) for layer in hidden]
    linear, activations = [*kinds[::2], type(last)], kinds[1::2]
    return (
        len(kinds) % 2 == 0
        and set(linear) == {nn.Linear}
        and set(activations) in ({nn.Tanh}, {nn.ReLU}, set())
        and all(each.bias is not None for each in [*list(hidden)[::2], last])
    )


def _is_watched(module: nn.Module) -> bool:
    """Whether hooks of a module may change, or see, what it computes."""
    return bool(
        module._forward_pre_hooks
        or module._forward_hooks
        or module._backward_pre_hooks
        or module._backward_hooks
    )


class _Network:
    """Linear layers with one activation between them.

    :param layers: Linear layers, each but the last followed by its activation
    :param pieces: Where the gradients of the parameters belong
    """

    def __init__(self, layers: Sequence[nn.Module], pieces: Any):
        linear = [each for each in layers if isinstance(each, nn.Linear)]
        self._weights = [each.weight.detach() for each in linear]
        self._biases = [each.bias.detach() for each in linear]
        self._gradients = [(pieces[each.weight], pieces[each.bias]) for each in linear]
        self._is_tanh = any(isinstance(each, nn.Tanh) for each in layers)
        self._arrays: dict[int, tuple[list[th.Tensor], list[th.Tensor]]] = {}

    def _arrays_for(self, rows: int) -> tuple[list[th.Tensor], list[th.Tensor]]:
        """Outputs of all layers, and gradients at all but the last; minibatches have two sizes."""
        if rows not in self._arrays:
            outputs, gradients = (
                [th.empty(rows, len(bias)) for bias in biases]
                for biases in (self._biases, self._biases[:-1])
            )
            self._arrays[rows] = (outputs, gradients)
        return self._arrays[rows]

    def forward(self, inputs: th.Tensor) -> th.Tensor:
        """Outputs of the last layer, shape (rows, outputs); the next call overwrites them."""
        outputs, _ = self._arrays_for(len(inputs))
        activate = th.tanh_ if self._is_tanh else th.relu_
        self._inputs, before = inputs, inputs
        for weight, bias, output in zip(self._weights, self._biases, outputs, strict=True):
            th.addmm(bias, before, weight.t(), out=output)
            if output is not outputs[-1]:
                activate(output)
            before = output
        return before.detach()

    def backward(self, gradient: th.Tensor) -> None:
        """Fill the pieces.

        :param gradient: At the outputs of the last layer, shape (rows, outputs)
        """
        outputs, gradients = self._arrays_for(len(gradient))
        hidden = [self._inputs, *outputs]
        for i in reversed(range(len(self._weights))):
            of_weight, of_bias = self._gradients[i]
            th.mm(gradient.t(), hidden[i], out=of_weight)
            th.sum(gradient, 0, out=of_bias)
            if i:
                th.mm(gradient, self._weights[i], out=gradients[i - 1])
                gradient = gradients[i - 1]
                _through(gradient.numpy(), hidden[i].numpy(), self._is_tanh)


@njit(cache=True, error_model="numpy", nogil=True)
def _through(gradient, outputs, is_tanh):
    """Gradient before an activation from that behind it, in place: · (1 − y²), or · [y > 0].

    :param gradient: shape (rows, H)
    :param outputs: y, shape (rows, H)
    :param is_tanh: else ReLU
    """
    one, zero = np.float32(1.0), np.float32(0.0)
    for i in range(len(gradient)):
        g, y = gradient[i], outputs[i]
        if is_tanh:
            for j in range(len(g)):
                g[j] *= one - y[j] * y[j]
        else:
            for j in range(len(g)):
                g[j] *= one if y[j] > zero else zero
