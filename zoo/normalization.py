"""Statistics of ``VecNormalize`` as plain numbers, since Stable-Baselines3 saves a pickle."""

import io
from pathlib import Path

import numpy as np
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_e2c.zoo.archives import check_archive
from sb3_e2c.zoo.console import UserError, brief, write_whole

_SETTINGS = ("norm_obs", "norm_reward", "clip_obs", "clip_reward", "gamma", "epsilon")
_MOMENTS = ("mean", "var", "count")
_LARGEST = 2**26  # bytes, of a million observed numbers


def statistics_path(model_path: str | Path) -> Path:
    """Where the statistics of a saved model lie: beside it.

    :param model_path: The model's zip file
    """
    return Path(model_path).with_suffix(".vecnormalize.npz")


def save_statistics(env: VecNormalize, path: str | Path) -> None:
    """Write settings and running moments.

    :param env: The normalizing environment
    :param path: A file name that ends in .npz
    """
    numbers = {name: np.asarray(getattr(env, name)) for name in _SETTINGS}
    for rms in ("obs_rms", "ret_rms"):
        for moment in _MOMENTS if hasattr(env, rms) else ():
            numbers[f"{rms}.{moment}"] = np.asarray(getattr(getattr(env, rms), moment))
    file = io.BytesIO()
    np.savez(file, **numbers)  # type: ignore[arg-type]
    write_whole(path, file.getvalue())


def load_statistics(env: VecEnv, path: str | Path) -> VecNormalize:
    """Wrap an environment, with the statistics of :func:`save_statistics`.

    :param env: The environment to wrap
    :param path: The file
    :raises UserError: if the file is missing, broken, or belongs to other observations
    """
    try:
        check_archive(path, _LARGEST)
        with np.load(path, allow_pickle=False) as file:
            numbers = {name: _plain(name, file[name]) for name in file.files}
        wrapped = VecNormalize(env, **{name: numbers[name].item() for name in _SETTINGS})
        for rms in ("obs_rms", "ret_rms"):
            for moment in _MOMENTS if hasattr(wrapped, rms) else ():
                current = getattr(getattr(wrapped, rms), moment)
                setattr(getattr(wrapped, rms), moment, numbers[f"{rms}.{moment}"])
                if np.shape(current) != numbers[f"{rms}.{moment}"].shape:
                    raise ValueError(f"{rms} has another shape than the environment's")
    except Exception as error:  # whatever numpy raises for broken content
        raise UserError(f"cannot read the observation statistics {path}: {brief(error)}") from error
    return wrapped


def _plain(name: str, array: np.ndarray) -> np.ndarray:
    if array.dtype.kind not in "biuf" or np.isnan(array).any():
        raise ValueError(f"{name} holds something else than numbers")
    return array
