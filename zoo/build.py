"""From names and numbers to objects: worlds, models, and their weights."""

import contextlib
import itertools
import json
import math
import os
import pickle
import zipfile
from collections.abc import Iterator, Mapping
from copy import deepcopy
from functools import partial
from pathlib import Path
from typing import Any

import torch as th
from gymnasium import spaces
from rl_zoo3.utils import get_callback_list
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnv

from sb3_e2c import MAPPO, share_parameters
from sb3_e2c.envs import ENV_IDS
from sb3_e2c.opponents import adversary_path
from sb3_e2c.vec_env import MultiAgentVecEnv, OpponentVecEnv
from sb3_e2c.zoo.archives import check_archive
from sb3_e2c.zoo.configuration import ALGORITHMS, ZOO_KEYS
from sb3_e2c.zoo.console import UserError, brief
from sb3_e2c.zoo.parts import CLASSES, class_named
from sb3_e2c.zoo.signatures import numbers_in, schedule_start

_KEPT_NAMES = ("policy", "estimator")  # the library looks them up itself
# What constructors raise for arguments that they cannot take
_REFUSALS = (TypeError, ValueError, AssertionError, RuntimeError, MemoryError, OverflowError)


@contextlib.contextmanager
def refusals_of(name: str) -> Iterator[None]:
    """Turn what a constructor refuses into a :class:`UserError`.

    :param name: What is made
    """
    try:
        yield
    except UserError:
        raise
    except _REFUSALS as error:
        raise UserError(f"{name}: {brief(error)}") from error


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
    with refusals_of(env_id):
        with contextlib.closing(make_env()) as env:
            agents = env.possible_agents
            size = len(agents) * spaces.flatdim(env.observation_space(agents[0]))
        _check_memory(f"{n_worlds} worlds", n_worlds * size)
        return share_parameters(make_env, n_worlds, n_processes, seed=seed)


def own_callbacks(config: Mapping[str, Any]) -> list[BaseCallback]:
    """New callbacks, as a configuration names them.

    :param config: The configuration
    :raises UserError: if there are no such callbacks
    """
    try:
        callbacks = get_callback_list(deepcopy(dict(config)))
    except (ImportError, AttributeError, TypeError, ValueError, AssertionError) as error:
        raise UserError(f"callback {config['callback']!r}: {error}") from error
    for each in callbacks:
        if not isinstance(each, BaseCallback):
            raise UserError(
                f"callback {config['callback']!r}: it made {brief(repr(each))}; expected callbacks "
                "of Stable-Baselines3"
            )
    return callbacks


def _check_memory(what: str, n_floats: int) -> None:
    """Refuse what cannot fit, since asking for too much memory can end the whole process."""
    needed, memory = 4 * n_floats, _memory()
    if needed > memory:
        raise UserError(
            f"{what} would take at least {needed / 2**30:.4g} GiB, more than this machine's memory "
            f"of {memory / 2**30:.4g} GiB; choose fewer"
        )


def _memory() -> float:
    """Bytes of memory of this machine, infinite where it does not tell."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError):
        return math.inf


def constructor_arguments(config: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments of the algorithm in a configuration, names replaced by what they name.

    :param config: See :func:`sb3_e2c.zoo.configuration.resolve`
    :raises UserError: for a name without a meaning
    """
    return _with_classes({key: value for key, value in config.items() if key not in ZOO_KEYS})


def _with_classes(values: Mapping[str, Any]) -> dict[str, Any]:
    """A mapping with classes and schedules instead of their names, however deep."""
    result = dict(values)
    for key, value in values.items():
        start = schedule_start(value)
        if start is not None:
            result[key] = LinearSchedule(start, 0.0, 1.0)
        elif isinstance(value, Mapping):
            result[key] = _with_classes(value)
        elif key in CLASSES and key not in _KEPT_NAMES:
            result[key] = class_named(key, value)
    return result


def build_model(algo: str, config: Mapping[str, Any], env: VecEnv, **flags: Any) -> MAPPO:
    """An untrained model.

    :param algo: A key of ``ALGORITHMS``
    :param config: See :func:`sb3_e2c.zoo.configuration.resolve`
    :param env: Its environment
    :param flags: ``seed``, ``device``, ``verbose``, ``tensorboard_log``
    :raises UserError: for values that the algorithm refuses
    """
    arguments = constructor_arguments(config)
    row = spaces.flatdim(env.observation_space) + spaces.flatdim(env.action_space)
    n_steps = arguments["n_steps"]
    _check_memory(f"{n_steps} steps of {env.num_envs} agents", n_steps * env.num_envs * row)
    with refusals_of(algo):
        return ALGORITHMS[algo](env=env, **arguments, **flags)


def check_networks(config: Mapping[str, Any], path: str | Path) -> None:
    """Refuse a configuration whose networks the files cannot hold, before they take any memory.

    :param config: See :func:`sb3_e2c.zoo.configuration.resolve`
    :param path: The model's zip file; an adversary's may lie beside it
    :raises UserError: if they are larger
    """
    team = config.get("policy_kwargs") or {}
    others = (config.get("opponent_kwargs") or {}).get("policy_kwargs", team) or {}
    for kwargs, file in ((team, path), (others, adversary_path(path))):
        least = _fewest_weights(kwargs)
        found = os.path.getsize(file) if os.path.exists(file) else math.inf
        if 0 < found < least:  # a weight has four bytes, and hardly compresses
            raise UserError(
                f"{file} has {found:,} bytes, but the networks in config.yml {least:,} weights; "
                "does it belong to this run?"
            )


def _fewest_weights(policy_kwargs: Mapping[str, Any]) -> int:
    """Networks of these sizes have at least as many."""
    layers = policy_kwargs.get("net_arch") or []
    chains = list(layers.values()) if isinstance(layers, Mapping) else [layers]
    least = 3 * policy_kwargs.get("gru_hidden_size", 0) ** 2
    least += sum(a * b for chain in chains for a, b in itertools.pairwise(chain))
    least += sum(sum(chain) for chain in chains)  # biases
    extractor = numbers_in(policy_kwargs.get("features_extractor_kwargs"))
    return least + sum(width for width in extractor if width > 0)  # each may be a layer's


def load_weights(model: MAPPO, path: str | Path) -> None:
    """Give a model the weights in a file, without executing anything that the file holds.

    :param model: A model of the same algorithm, networks and team
    :param path: What ``model.save`` wrote
    :raises UserError: if the file is broken, or belongs to another kind of model
    """
    try:
        check_archive(path, _largest_file(model))
        _, weights, _ = load_from_zip_file(path, load_data=False, device=model.device)
        _check_compact(weights)
    except pickle.UnpicklingError as error:  # torch's advice would be to execute it
        raise UserError(
            f"{path} is no readable model: it holds something else than numbers, or is damaged"
        ) from error
    except Exception as error:  # whatever zip files and torch raise for broken content
        raise UserError(f"{path} is no readable model: {brief(error)}") from error
    try:
        model.set_parameters(weights, exact_match=True, device=model.device)
    except Exception as error:  # a state dictionary may hold anything
        raise UserError(
            f"{path} does not fit; was it trained with another algorithm or environment? "
            f"{brief(error)}"
        ) from error


def go_on_from(model: MAPPO, path: str | Path) -> None:
    """Give a model, and the adversary that learns beside it, what ``model.save`` wrote.

    Like ``MAPPO.load``, but only numbers are read: nothing that the file holds is executed.

    :param model: An untrained model of the same algorithm, networks and team
    :param path: Its zip file
    :raises UserError: if a file is missing, broken, or belongs to another kind of model
    """
    beside = adversary_path(path)
    _continue(model, path)
    model._adversary_file = beside  # saved again with the team, if somebody else acts now
    if model.opponent is not None:
        _continue(model.opponent, beside)


def _continue(model: MAPPO, path: str | Path) -> None:
    load_weights(model, path)
    check_finite(model, path)
    try:
        with zipfile.ZipFile(path) as archive:
            data = json.loads(archive.read("data"))
        counters = {name: data[name] for name in ("num_timesteps", "_n_updates")}
    except Exception as error:  # whatever broken content makes its readers raise
        raise UserError(f"{path} does not say how far it was trained: {brief(error)}") from error
    for name, number in counters.items():
        if type(number) is not int or not 0 <= number < 2**63:
            raise UserError(f"{path}: {name} is {brief(number)}; expected a number of steps")
        setattr(model, name, number)


def _largest_file(model: MAPPO) -> int:
    """Most bytes that a file with the weights and the optimizer's moments of a model may have."""
    weights = [*model.policy.state_dict().values(), model.multipliers.values]
    return 2**24 + 8 * sum(tensor.numel() * tensor.element_size() for tensor in weights)


def _check_compact(tree: Any) -> None:
    """Refuse arrays that repeat a few numbers without end: a copy of one would need any memory."""
    waiting, seen = [tree], set()  # what a file holds may refer to itself
    while waiting:
        found = waiting.pop()
        if isinstance(found, th.Tensor):
            held = found.untyped_storage().nbytes() if found.layout == th.strided else -1
            if found.numel() * found.element_size() > held:
                raise ValueError("it has arrays that claim more numbers than they hold")
        elif isinstance(found, Mapping | list | tuple | set) and id(found) not in seen:
            seen.add(id(found))
            waiting += found.values() if isinstance(found, Mapping) else found


def load_opponent(model: MAPPO, env: OpponentVecEnv, path: str | Path) -> MAPPO:
    """An adversary with the networks that the team's settings give it, and weights from a file.

    :param model: The team
    :param env: Where both act
    :param path: What was saved beside a team
    :raises UserError: if the file is broken, or belongs to another kind of model
    """
    opponent = model.new_opponent(env)
    load_weights(opponent, path)
    check_finite(opponent, path)
    return opponent


def check_finite(model: MAPPO, path: str | Path) -> None:
    """Refuse weights that are no numbers.

    :param model: A loaded model
    :param path: Where it comes from
    :raises UserError: naming the first array with an infinite number or NaN
    """
    weights = {**model.policy.state_dict(), "multipliers.values": model.multipliers.values}
    for name, tensor in weights.items():
        if not th.isfinite(tensor).all():
            raise UserError(f"{path} is spoiled: {name} has numbers that are infinite or NaN")
