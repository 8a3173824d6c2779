"""The parts of a run that a configuration names, and whose arguments it may give."""

import inspect
from collections.abc import Mapping
from types import ModuleType
from typing import NamedTuple

import torch as th
from stable_baselines3.common import torch_layers
from stable_baselines3.common.vec_env import VecNormalize

from sb3_e2c import MAPPO, OEMRewardCallback, multipliers
from sb3_e2c.callbacks import ESTIMATORS
from sb3_e2c.zoo.console import unknown


def classes_in(module: ModuleType, base: type) -> dict[str, type]:
    """What a module exports of one kind.

    :param module: The module
    :param base: Their common base class; abstract classes are left out
    """
    found = {name: each for name, each in vars(module).items() if isinstance(each, type)}
    return {
        name: each
        for name, each in found.items()
        if issubclass(each, base) and not inspect.isabstract(each)
    }


# key: the classes that it may name. Names are looked up here and nowhere else.
CLASSES: dict[str, Mapping[str, type]] = {
    "policy": MAPPO.policy_aliases,
    "multipliers_class": classes_in(multipliers, multipliers.Multipliers),
    "estimator": ESTIMATORS,
    "activation_fn": classes_in(th.nn, th.nn.Module),
    "optimizer_class": classes_in(th.optim, th.optim.Optimizer),
    "features_extractor_class": classes_in(torch_layers, torch_layers.BaseFeaturesExtractor),
}


class Part(NamedTuple):
    """What may stand under a key that holds the arguments of a class.

    :param named_by: The key beside it that names the class, or the class if it is always the same
    :param implied: Arguments that cannot be chosen here, and what they follow from
    """

    named_by: str | type
    implied: Mapping[str, str] = {}


_SPACES = dict.fromkeys(("observation_space", "action_space"), "the environment")
_TEAM = {
    **dict.fromkeys(("n_agents", "critic_state_dim"), "the environment"),
    "n_constraints": "cost_limits",
    "n_parties": "cost_scope",
    "lr_schedule": "learning_rate",
    "critic_lr_schedule": "critic_learning_rate",
    **dict.fromkeys(("use_sde", "full_std", "use_expln", "squash_output"), "MAPPO without gSDE"),
}

_OPPONENTS = {
    name: "the team's"
    for name in inspect.signature(MAPPO).parameters
    if name not in MAPPO.opponent_arguments - {"policy", "policy_kwargs", "device"}
}

PARTS: dict[str, Part] = {
    "policy_kwargs": Part("policy", {**_SPACES, **_TEAM}),
    "optimizer_kwargs": Part(
        "optimizer_class", {"params": "the policy", "lr": "learning_rate, critic_learning_rate"}
    ),
    "features_extractor_kwargs": Part("features_extractor_class", _SPACES),
    "multipliers_kwargs": Part("multipliers_class", {"shape": "cost_limits and cost_scope"}),
    "opponent_kwargs": Part(MAPPO, _OPPONENTS),
    "oem_kwargs": Part(OEMRewardCallback),
    "estimator_kwargs": Part("estimator"),
    "normalize": Part(VecNormalize, {"venv": "the environment", "gamma": "gamma"}),
}


def class_named(key: str, name: str, where: str = "") -> type:
    """The class behind a name in a configuration.

    :param key: A key of ``CLASSES``
    :param name: What stands there
    :param where: What the key stands in, for instance "policy_kwargs."
    :raises UserError: for a name without a meaning
    """
    if name not in CLASSES[key]:
        raise unknown(where + key, name, CLASSES[key])
    return CLASSES[key][name]
