"""From names and numbers to objects: worlds, models, and their weights."""

import pickle
import zipfile
import zlib
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import torch as th
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnv

from sb3_e2c import MAPPO, GradientMultipliers, PIDMultipliers, share_parameters
from sb3_e2c.envs import ENV_IDS
from sb3_e2c.vec_env import MultiAgentVecEnv
from sb3_e2c.zoo.console import UserError, unknown
from sb3_e2c.zoo.hyperparams import ALGORITHMS, ZOO_KEYS

_MULTIPLIERS = {each.__name__: each for each in (GradientMultipliers, PIDMultipliers)}
_NETWORK_NAMES = {  # key of policy_kwargs: where its name is looked up, what it must be
    "activation_fn": (th.nn, th.nn.Module),
    "optimizer_class": (th.optim, th.optim.Optimizer),
}
_BROKEN_FILE = (
    ValueError,
    RuntimeError,
    KeyError,
    EOFError,
    OSError,
    zipfile.BadZipFile,
    zlib.error,
    pickle.UnpicklingError,
)


def make_worlds(
    env_id: str,
    env_kwargs: Mapping[str, Any] | None,
    n_worlds: int,
    seed: int | None,
    n_processes: int = 1,
) -> MultiAgentVecEnv:
    """Copies of a task, flattened to one row for each agent.

    :param env_id: A key of ``ENV_IDS``
    :param env_kwargs: Arguments of its factory
    :param n_worlds: W
    :param seed: World w gets seed + w
    :param n_processes: More than one: worlds run in worker processes (SuperSuit's)
    :raises UserError: for arguments that the environment refuses
    """
    make_env = partial(ENV_IDS[env_id], **(env_kwargs or {}))
    try:
        return share_parameters(make_env, n_worlds, n_processes, seed=seed)
    except (TypeError, ValueError) as error:
        raise UserError(f"{env_id}: {error}") from error


def constructor_arguments(config: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments of the algorithm in a configuration, names replaced by what they name.

    :param config: See :func:`sb3_e2c.zoo.hyperparams.resolve`
    :raises UserError: for a name without a meaning
    """
    arguments = {key: value for key, value in config.items() if key not in ZOO_KEYS}
    for key, value in arguments.items():
        if isinstance(value, str) and value.startswith("lin_"):
            arguments[key] = LinearSchedule(float(value.removeprefix("lin_")), 0.0, 1.0)
    if "policy_kwargs" in arguments:
        arguments["policy_kwargs"] = _named_parts(arguments["policy_kwargs"] or {})
    name = arguments.get("multipliers_class")
    if name is not None:
        if name not in _MULTIPLIERS:
            raise unknown("multipliers_class", name, _MULTIPLIERS)
        arguments["multipliers_class"] = _MULTIPLIERS[name]
    return arguments


def _named_parts(policy_kwargs: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments of the policy with ``ReLU`` and ``Adam`` looked up in torch, and nowhere else."""
    result = dict(policy_kwargs)
    for key, (module, kind) in _NETWORK_NAMES.items():
        if key in result:
            found = getattr(module, str(result[key]), None)
            if not (isinstance(found, type) and issubclass(found, kind)):
                raise unknown(f"policy_kwargs.{key}", result[key], dir(module))
            result[key] = found
    return result


def build_model(algo: str, config: Mapping[str, Any], env: VecEnv, **flags: Any) -> MAPPO:
    """An untrained model.

    :param algo: A key of ``ALGORITHMS``
    :param config: See :func:`sb3_e2c.zoo.hyperparams.resolve`
    :param env: Its environment
    :param flags: ``seed``, ``device``, ``verbose``, ``tensorboard_log``
    :raises UserError: for values that the algorithm refuses
    """
    arguments = constructor_arguments(config)
    if arguments["policy"] not in ALGORITHMS[algo].policy_aliases:
        raise unknown("policy", arguments["policy"], ALGORITHMS[algo].policy_aliases)
    try:
        return ALGORITHMS[algo](env=env, **arguments, **flags)
    except (TypeError, ValueError, AssertionError) as error:
        raise UserError(f"{algo}: {error}") from error


def load_weights(model: MAPPO, path: str | Path) -> None:
    """Give a model the weights in a file, without executing anything that the file holds.

    :param model: A model of the same algorithm, networks and team
    :param path: What ``model.save`` wrote
    :raises UserError: if the file is broken, or belongs to another kind of model
    """
    try:
        _, weights, _ = load_from_zip_file(path, load_data=False, device=model.device)
    except _BROKEN_FILE as error:
        raise UserError(f"{path} is no readable model: {error}") from error
    try:
        model.set_parameters(weights, exact_match=True, device=model.device)
    except _BROKEN_FILE as error:
        raise UserError(
            f"{path} does not fit; was it trained with another algorithm or environment? {error}"
        ) from error
