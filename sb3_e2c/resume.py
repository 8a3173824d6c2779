"""The whole state of a training between two rollouts, so that another process goes on with it.

    state = training_state(model, callback)        in the _on_rollout_start of the last callback
    file.write(state)                              ... another process builds the same run ...
    load_training_state(model, callback, state)    in the same place: from here on, bit for bit

Between two rollouts no rollout has to be kept. What is built from settings (networks, worlds,
callbacks) is not kept either, only what has changed in it since. The state is a pickle: loading one
executes what it holds, so load your own only.
"""

import functools
import inspect
import io
import pickle
import random
import time
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecNormalize

from sb3_e2c.callbacks import OEMRewardCallback
from sb3_e2c.collector import Collector
from sb3_e2c.entropy import EntropyEstimator
from sb3_e2c.mappo import MAPPO
from sb3_e2c.monitor import TeamMonitor
from sb3_e2c.opponents import (
    LearningOpponents,
    OpponentWorlds,
    RandomOpponents,
    TrainedOpponents,
)
from sb3_e2c.recorder import TeamRecorder
from sb3_e2c.sequences import Memory
from sb3_e2c.sides import BatchedSides
from sb3_e2c.trust_region import TrustRegionMonitor
from sb3_e2c.vec_env import MultiAgentVecEnv, opponent_env
from sb3_e2c.worlds import BatchedWorlds

State = dict[str, Any]


class _Changing(NamedTuple):
    """Attributes of a class that change while it trains."""

    always: tuple[str, ...] = ()
    episodes: tuple[str, ...] = ()  # about running episodes: useless where worlds begin new ones


_CHANGING: dict[type, _Changing] = {
    MAPPO: _Changing(
        always=(
            *("num_timesteps", "_num_timesteps_at_start", "_n_updates", "_episode_num"),
            *("_current_progress_remaining", "ep_info_buffer", "ep_success_buffer", "start_time"),
        ),
        episodes=("_last_obs", "_last_original_obs", "_last_episode_starts"),
    ),
    Collector: _Changing(episodes=("observations", "episode_starts", "memory")),
    TeamRecorder: _Changing(episodes=("episode_costs", "critic_states")),
    TeamMonitor: _Changing(
        always=("episode_count", "t_start"),
        episodes=("episode_returns", "episode_lengths", "episode_costs"),
    ),
    VecNormalize: _Changing(
        always=("obs_rms", "ret_rms"), episodes=("returns", "old_obs", "old_reward")
    ),
    MultiAgentVecEnv: _Changing(episodes=("reset_infos", "_seeds", "_options")),
    BatchedWorlds: _Changing(episodes=("sim",)),
    BatchedSides: _Changing(episodes=("sim",)),
    OpponentWorlds: _Changing(episodes=("_observations", "_seed")),
    RandomOpponents: _Changing(episodes=("_actions",)),
    TrainedOpponents: _Changing(episodes=("_observations", "_state", "_starts")),
    LearningOpponents: _Changing(episodes=("_returns",)),
    # Of callbacks, all is kept that is neither a setting nor a link; see _own_attributes.
    OEMRewardCallback: _Changing(episodes=("episode_bonuses",)),
    TrustRegionMonitor: _Changing(episodes=("_ages", "_first_ages", "_ends")),
}

# What the next row of the log will hold
_PENDING = ("name_to_value", "name_to_count", "name_to_excluded")
# Links from callbacks to what is not theirs
_LINKS = {"model", "parent", "locals", "globals"}
_NOT_OWNED = (BaseAlgorithm, VecEnv, BaseCallback, Logger)


def keeps_episodes(env: VecEnv | None) -> bool:
    """Whether the running episodes of an environment can be continued in another process.

    :param env: With all its wrappers
    :return: True for batched simulators; worlds through SuperSuit have to begin new episodes, and
        of wrappers that are not known here nobody knows the state
    """
    while isinstance(env, (TeamMonitor, VecNormalize)):
        env = env.venv
    worlds = env.worlds if isinstance(env, MultiAgentVecEnv) else None
    if isinstance(worlds, OpponentWorlds):
        return isinstance(worlds.sides, BatchedSides)
    return isinstance(worlds, BatchedWorlds)


def training_state(model: MAPPO, callback: BaseCallback, episodes: bool = True) -> bytes:
    """Keep all that decides how a training goes on.

    Call it between two rollouts, after all other callbacks' ``_on_rollout_start``.

    :param model: What trains
    :param callback: The callback of its ``learn``, with all callbacks in it
    :param episodes: Whether to keep the running episodes, too; see :func:`keeps_episodes`
    :return: A pickle
    """
    state = {
        "parts": {name: _state(part, episodes) for name, part in _parts(model, callback, episodes)},
        "episodes": episodes,
        "log": {name: getattr(model.logger, name) for name in _PENDING},
        "random": _random_state(model.device),
        "time": time.time(),
    }
    file = io.BytesIO()
    _StatePickler(file, protocol=5).dump(state)
    return file.getvalue()


def load_training_state(model: MAPPO, callback: BaseCallback, pickled: bytes) -> None:
    """Go on where :func:`training_state` was called; call it in the same place.

    Without the running episodes of the state, those go on that have just begun.

    :param model: Built from the same settings
    :param callback: The same callbacks
    :param pickled: The state; it is unpickled, so it must come from somebody whom you trust
    :raises ValueError: if the state belongs to other settings
    """
    state = pickle.loads(pickled)
    parts = dict(_parts(model, callback, state["episodes"]))
    _check_same(parts.keys(), state["parts"].keys())
    away = time.time() - state["time"]  # clocks stand still between the two processes
    for name, values in state["parts"].items():
        _set_state(parts[name], values, away)
    for name, values in state["log"].items():
        pending = getattr(model.logger, name)
        pending.clear()
        pending.update(values)
    _collector(model).begin_rollout()
    opponents = opponent_env(model.env)
    if opponents is not None and opponents.learner is not None:
        opponents.learner.begin_rollout(model.n_steps)
    _set_random_state(state["random"], model.device)


def _check_same(found: Any, expected: Any) -> None:
    different = sorted(set(found) ^ set(expected))
    if different:
        raise ValueError(
            f"the training was kept with other parts than it has now: {', '.join(different)} "
            "exist in one of them only; go on with the same environment and callbacks"
        )


# ------------------------------------------------------------------ which objects have a state


def _parts(model: MAPPO, callback: BaseCallback, episodes: bool) -> Iterator[tuple[str, Any]]:
    """All objects that change while training, by names that are the same in every process."""
    assert model.env is not None
    yield from _model_parts("model", model)
    yield from _env_parts("env", model.env)
    yield from _callback_parts("callback", callback, model.env, episodes)


def _model_parts(name: str, model: MAPPO) -> Iterator[tuple[str, Any]]:
    yield name, model
    yield f"{name}.collector", _collector(model)
    yield f"{name}.recorder", _collector(model).recorder


def _collector(model: MAPPO) -> Collector:
    assert model._collector is not None, "learn() makes it"
    return model._collector


def _env_parts(name: str, env: VecEnv) -> Iterator[tuple[str, Any]]:
    while isinstance(env, VecEnvWrapper):
        name = f"{name}.{type(env).__name__}"
        yield name, env
        env = env.venv
    yield f"{name}.worlds", env
    worlds = getattr(env, "worlds", None)
    yield f"{name}.{type(worlds).__name__}", worlds
    if isinstance(worlds, OpponentWorlds):
        acting = worlds.opponents
        yield f"{name}.{type(worlds.sides).__name__}", worlds.sides
        yield f"{name}.{type(acting).__name__}", acting
        if isinstance(acting, LearningOpponents):
            yield from _model_parts(f"{name}.opponent", acting.model)


def _callback_parts(
    name: str, callback: BaseCallback, training_env: VecEnv, episodes: bool
) -> Iterator[tuple[str, Any]]:
    yield name, callback
    for attribute, value in vars(callback).items():
        if attribute in _LINKS:
            continue
        inner = f"{name}.{attribute}"
        if isinstance(value, VecEnv) and value.unwrapped is not training_env.unwrapped:
            yield from _env_parts(inner, value)
        for number, child in enumerate(value if isinstance(value, (list, tuple)) else [value]):
            if isinstance(child, BaseCallback):
                kind = type(child).__name__
                child_name = f"{inner}.{number}.{kind}"
                yield from _callback_parts(child_name, child, training_env, episodes)
    if isinstance(callback, OEMRewardCallback) and episodes:
        yield f"{name}.{type(callback.estimator).__name__}", callback.estimator


# ------------------------------------------------------------------ what belongs to the state


def _state(part: Any, episodes: bool) -> State:
    """What changes in an object, by the names of its attributes."""
    known = [_CHANGING[cls] for cls in type(part).__mro__ if cls in _CHANGING]
    of_episodes = {name for changing in known for name in changing.episodes}
    names = {name for changing in known for name in changing.always} | of_episodes
    if isinstance(part, (BaseCallback, EntropyEstimator)):
        names = _own_attributes(part)
    if not episodes:
        names -= of_episodes
    state = {name: getattr(part, name) for name in sorted(names) if hasattr(part, name)}
    if isinstance(part, MAPPO):
        state["parameters"] = part.get_parameters()
    return state


def _own_attributes(part: Any) -> set[str]:
    """Attributes of a callback or an estimator that change: no setting, no link, no open file."""
    own = set(vars(part)) - _settings(type(part)) - _LINKS  # type: ignore[arg-type]  # mypy 9376
    if not isinstance(part, BaseCallback):  # an estimator is nothing but its memory
        return own
    return {name for name in own if _is_data(getattr(part, name))}


@functools.cache
def _settings(kind: type) -> frozenset[str]:
    """Names of the arguments of a class and its bases."""
    constructors = [vars(cls)["__init__"] for cls in kind.__mro__ if "__init__" in vars(cls)]
    return frozenset(name for each in constructors for name in inspect.signature(each).parameters)


class _StatePickler(pickle.Pickler):
    """Pickles tensors as arrays: several times faster, and a GPU is not needed to load them."""

    def reducer_override(self, found: Any) -> Any:
        if type(found) is not th.Tensor:
            return NotImplemented
        return _tensor, (found.detach().cpu().numpy(),)


def _tensor(array: np.ndarray) -> th.Tensor:
    return th.from_numpy(array).clone()


class _DataPickler(_StatePickler):
    """Refuses what would drag the whole training along."""

    def persistent_id(self, found: Any) -> None:
        if isinstance(found, _NOT_OWNED):
            raise pickle.PicklingError(f"{type(found).__name__} is kept on its own")


def _is_data(value: Any) -> bool:
    if isinstance(value, (int, float, str, type(None))):
        return True
    try:
        _DataPickler(io.BytesIO(), protocol=pickle.HIGHEST_PROTOCOL).dump(value)
    except Exception:  # objects may raise whatever they like when they cannot be pickled
        return False
    return True


def _set_state(part: Any, values: State, away: float) -> None:
    """Give an object what :func:`_state` has collected.

    :param part: The object
    :param values: By attribute
    :param away: Seconds since then
    """
    for name, value in values.items():
        if name == "parameters":
            part.set_parameters(value, exact_match=True, device=part.device)
        elif name == "start_time":
            part.start_time = value + int(away * 1e9)
        elif name == "t_start":
            part.t_start = value + away
        elif isinstance(value, Memory):
            setattr(part, name, Memory(*(states.to(part.device) for states in value)))
        else:
            setattr(part, name, value)


def _random_state(device: th.device) -> tuple[Any, ...]:
    on_gpu = th.cuda.get_rng_state(device) if device.type == "cuda" else None
    return random.getstate(), np.random.get_state(), th.get_rng_state(), on_gpu


def _set_random_state(state: tuple[Any, ...], device: th.device) -> None:
    of_python, of_numpy, of_torch, on_gpu = state
    random.setstate(of_python)
    np.random.set_state(of_numpy)
    th.set_rng_state(of_torch)
    if on_gpu is not None and device.type == "cuda":
        th.cuda.set_rng_state(on_gpu, device)
