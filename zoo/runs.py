"""Find a run of ``train`` and bring its model back, for ``enjoy``, the demo and plots."""

import contextlib
import io
from argparse import Namespace
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import imageio
import numpy as np
from huggingface_sb3 import EnvironmentName
from rl_zoo3.utils import get_model_path
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_e2c import MAPPO
from sb3_e2c.zoo.build import build_model, check_finite, load_weights, make_worlds
from sb3_e2c.zoo.configuration import ALGORITHMS, check, check_algo, check_env, merge, read_yaml
from sb3_e2c.zoo.console import UserError, brief, write_whole
from sb3_e2c.zoo.normalization import load_statistics, statistics_path


@dataclass(frozen=True)
class Run:
    """A trained team on disk.

    :param algo: Its algorithm
    :param env_id: Its environment
    :param folder: The run's folder
    :param model_path: The model's zip file
    :param config: What it was trained with, see :func:`sb3_e2c.zoo.configuration.resolve`
    """

    algo: str
    env_id: str
    folder: Path
    model_path: Path
    config: dict[str, Any]


def find_run(args: Namespace) -> Run:
    """The run that the flags of ``enjoy`` name.

    :param args: ``algo, env, folder, exp_id, load_best, load_checkpoint, load_last_checkpoint``
    :raises UserError: if there is no such run or model, or it belongs to something else
    """
    check_algo(args.algo)
    check_env(args.env)
    which = (args.load_best, args.load_checkpoint, args.load_last_checkpoint)
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # it reports what enjoy reports better
            _, model_path, folder = get_model_path(
                args.exp_id, args.folder, args.algo, EnvironmentName(args.env), *which
            )
    except (AssertionError, ValueError, OSError) as error:
        hint = f"train one with: sb3-e2c train --algo {args.algo} --env {args.env}"
        raise UserError(f"{error}; {hint}") from None
    return open_run(Path(folder), args.algo, args.env, Path(model_path))


def open_run(folder: Path, algo: str, env_id: str, model_path: Path | None = None) -> Run:
    """Read a run's configuration.

    :param folder: The run's folder
    :param algo: What it was trained with
    :param env_id: What it was trained on
    :param model_path: One of its models; default: the last
    :raises UserError: if it belongs to something else, or its files are broken
    """
    config = read_yaml(folder / env_id / "config.yml")
    trained_with = read_yaml(folder / env_id / "args.yml")
    for name, asked in (("algo", algo), ("env", env_id)):
        if trained_with.get(name) != asked:
            raise UserError(
                f"{folder} was trained with --{name} {trained_with.get(name)}, not {asked}"
            )
    check(algo, config)
    return Run(algo, env_id, folder, model_path or folder / f"{env_id}.zip", config)


def make_env(
    run: Run,
    n_worlds: int,
    seed: int,
    env_kwargs: dict[str, Any] | None = None,
    trust: bool = False,
) -> VecEnv:
    """The run's environment, for evaluation.

    :param run: The run
    :param n_worlds: W
    :param seed: World w gets seed + w
    :param env_kwargs: Changes to the arguments that it was trained with
    :param trust: Whether statistics may be unpickled if there are no plain ones
    """
    kwargs = merge(run.config.get("env_kwargs") or {}, env_kwargs or {})
    env: VecEnv = make_worlds(run.env_id, kwargs, n_worlds, seed)
    if run.config.get("normalize"):
        plain, pickled = statistics_path(run.model_path), run.folder / run.env_id
        if trust and not plain.exists():
            env = VecNormalize.load(str(pickled / "vecnormalize.pkl"), env)
        else:
            env = load_statistics(env, plain)
        env.training = env.norm_reward = False
    return env


def load_model(
    run: Run, env: VecEnv, seed: int | None = None, device: str = "auto", trust: bool = False
) -> MAPPO:
    """The run's model, rebuilt from config.yml; from the zip it takes weights only.

    :param run: The run
    :param env: Its environment
    :param seed: For sampled actions
    :param device: Where its networks shall be
    :param trust: Unpickle the zip instead, which can execute what its author put there
    """
    if not trust:
        model = build_model(run.algo, run.config, env, seed=seed, device=device)
        load_weights(model, run.model_path)
    else:
        model = _unpickle(run, env, seed=seed, device=device)
    check_finite(model, run.model_path)
    return model


def _unpickle(run: Run, env: VecEnv, **flags: Any) -> MAPPO:
    try:
        return ALGORITHMS[run.algo].load(run.model_path, env=env, **flags)
    except Exception as error:  # whatever a broken or foreign pickle may raise
        raise UserError(f"cannot load {run.model_path}: {brief(error)}") from error


def record_episode(model: MAPPO, env: VecEnv, path: Path, deterministic: bool) -> None:
    """Film one episode of the first world.

    :param model: The team
    :param env: Worlds with ``render_mode="rgb_array"``
    :param path: A name that ends in .gif or .mp4
    :param deterministic: Whether it takes the most likely actions
    """
    observations: Any = env.reset()
    state = None
    starts = np.ones(env.num_envs, dtype=bool)
    frames = [env.get_images()[0]]
    while True:
        actions, state = model.predict(observations, state, starts, deterministic)
        observations, _, starts, _ = env.step(actions)
        if starts[0]:  # the worlds show their next episode already
            break
        frames.append(env.get_images()[0])
    if any(frame is None for frame in frames):
        raise UserError("this environment cannot be filmed: it has no rgb_array rendering")
    _write_video(frames, path, fps=env.get_attr("metadata")[0].get("render_fps", 10))


def _write_video(frames: list[Any], path: Path, fps: float) -> None:
    # By default imageio stretches films to multiples of 16 pixels.
    film = {"fps": fps, "macro_block_size": 2}
    options: Any = {"duration": 1000 / fps, "loop": 0} if path.suffix == ".gif" else film
    write_whole(path, imageio.mimwrite("<bytes>", frames, format=path.suffix, **options))
