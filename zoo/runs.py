"""Find a run of ``train`` and bring its model back, for every command that uses one."""

import re
import shlex
from argparse import ArgumentParser, Namespace
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_e2c import MAPPO
from sb3_e2c.opponents import adversary_path
from sb3_e2c.vec_env import opponent_env
from sb3_e2c.zoo.build import (
    build_model,
    check_finite,
    check_networks,
    load_opponent,
    load_weights,
    make_worlds,
)
from sb3_e2c.zoo.configuration import ALGORITHMS, check, check_algo, check_env, merge, read_yaml
from sb3_e2c.zoo.console import UserError, brief
from sb3_e2c.zoo.normalization import load_statistics, statistics_path
from sb3_e2c.zoo.resume import how_to_go_on

EVALUATION_SEED = 1_000_000  # worlds that runs with smaller seeds have not trained in


@dataclass(frozen=True)
class Run:
    """A trained team on disk.

    :param algo: Its algorithm
    :param env_id: Its environment
    :param folder: The run's folder
    :param model_path: The model's zip file
    :param config: What it was trained with, see :func:`sb3_e2c.zoo.configuration.resolve`
    :param flags: Of the command that trained it
    """

    algo: str
    env_id: str
    folder: Path
    model_path: Path
    config: dict[str, Any]
    flags: Mapping[str, Any] = field(default_factory=dict)


def add_run_flags(parser: ArgumentParser) -> None:
    """RL-Zoo's flags that say which model of which run: what :func:`find_run` reads.

    :param parser: Gets the flags
    """
    add, switch = parser.add_argument, "store_true"
    add("--algo", default="e2c_t", help=f"{', '.join(ALGORITHMS)} (default: e2c_t)")
    add("--env", default="MultiRover-6-3-v0", help="environment ID")
    add("-f", "--folder", default="logs", help="log folder (default: logs)")
    add("--exp-id", type=int, default=0, help="number of the run (default: the latest)")
    which = parser.add_mutually_exclusive_group().add_argument
    which("--load-best", action=switch, help="load the best model instead of the last")
    which("--load-checkpoint", type=int, metavar="STEPS", help="load the checkpoint of this step")
    which("--load-last-checkpoint", action=switch, help="load the last checkpoint")


def add_seed_flag(parser: ArgumentParser) -> None:
    """``--seed`` of an evaluation.

    :param parser: Gets the flag
    """
    parser.add_argument(
        "--seed",
        type=int,
        default=EVALUATION_SEED,
        help=f"of worlds and sampled actions (default: {EVALUATION_SEED}, worlds that are new to "
        "runs with smaller seeds)",
    )


def check_seed(seed: int) -> None:
    """Raise :class:`UserError` for a number that numpy does not take as a seed.

    :param seed: What ``--seed`` says
    """
    if not 0 <= seed < 2**32:
        raise UserError(f"--seed is {seed}; expected a number from 0 to 2**32 - 1")


def find_run(args: Namespace) -> Run:
    """The run that the flags of :func:`add_run_flags` name.

    :param args: The parsed flags
    :raises UserError: if there is no such run or model, or it belongs to something else
    """
    check_algo(args.algo)
    check_env(args.env)
    logs = Path(args.folder, args.algo)
    number = args.exp_id or latest_run_id(logs, args.env)
    folder = logs / f"{args.env}_{number}" if number > 0 else logs
    if not folder.is_dir():
        numbers = run_ids(logs, args.env)
        there = f"there are --exp-id {brief(', '.join(map(str, numbers)))}; " if numbers else ""
        raise UserError(
            f"{folder} was not found; {there}train one with: sb3-e2c train --algo {args.algo} "
            f"--env {args.env} -f {shlex.quote(args.folder)}"
        )
    model_path = folder / _model_name(args, folder)
    if not model_path.is_file():
        raise UserError(f"{model_path} was not found; {_what_else(args, folder)}")
    return open_run(folder, args.algo, args.env, model_path)


def latest_run_id(logs: Path, env_id: str) -> int:
    """Number of the latest run; 0 if there is none.

    :param logs: The folder of an algorithm's runs
    :param env_id: The environment
    """
    return max(run_ids(logs, env_id), default=0)


def run_ids(logs: Path, env_id: str) -> list[int]:
    """Numbers of the runs of an environment, in order.

    Not RL-Zoo's function, which finds nothing in folders whose names have brackets.

    :param logs: The folder of an algorithm's runs
    :param env_id: The environment
    """
    found = (re.fullmatch(rf"{re.escape(env_id)}_(\d+)", path.name) for path in logs.glob("*"))
    return sorted(int(match[1]) for match in found if match)


def checkpoint_steps(folder: Path) -> list[int]:
    """Steps at which a run saved checkpoints, in order.

    :param folder: The run's folder
    """
    names = (path.name for path in folder.glob("rl_model_*_steps.zip"))
    found = (re.fullmatch(r"rl_model_(\d+)_steps\.zip", name) for name in names)
    return sorted(int(match[1]) for match in found if match)


def checkpoint_name(steps: int) -> str:
    """The file of a checkpoint.

    :param steps: When it was saved
    """
    return f"rl_model_{steps}_steps.zip"


def _model_name(args: Namespace, folder: Path) -> str:
    """Which file of a run the flags ask for."""
    if args.load_best:
        return "best_model.zip"
    if args.load_checkpoint is not None:
        return checkpoint_name(args.load_checkpoint)
    if args.load_last_checkpoint:
        steps = checkpoint_steps(folder)
        return checkpoint_name(steps[-1]) if steps else "rl_model_*_steps.zip"
    return f"{args.env}.zip"


def _what_else(args: Namespace, folder: Path) -> str:
    """Advice for somebody who asks for a model that a run does not have."""
    if args.load_checkpoint is not None or args.load_last_checkpoint:
        steps = checkpoint_steps(folder)
        return f"checkpoints there: {brief(', '.join(map(str, steps)) or 'none')}"
    if args.load_best:
        return "train with --eval-freq for a best model, or leave --load-best away for the last one"
    older = (path.parent.name for path in folder.parent.glob(f"{args.env}_*/{args.env}.zip"))
    numbers = sorted(int(n) for n in (name.rpartition("_")[2] for name in older) if n.isdigit())
    others = f", or choose another run: --exp-id {brief(', '.join(map(str, numbers)))}"
    return f"finish it with: {how_to_go_on(folder)}{others if numbers else ''}"


def open_run(folder: Path, algo: str, env_id: str, model_path: Path | None = None) -> Run:
    """Read a run's configuration.

    :param folder: The run's folder
    :param algo: What it was trained with
    :param env_id: What it was trained on
    :param model_path: One of its models; default: the last
    :raises UserError: if it belongs to something else, or its files are broken
    """
    config = read_yaml(folder / env_id / "config.yml")
    flags = read_yaml(folder / env_id / "args.yml")
    for name, asked in (("algo", algo), ("env", env_id)):
        if flags.get(name) != asked:
            raise UserError(f"{folder} was trained with --{name} {flags.get(name)}, not {asked}")
    check(algo, config)
    return Run(algo, env_id, folder, model_path or folder / f"{env_id}.zip", config, flags)


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
            env = _unpickle_statistics(pickled / "vecnormalize.pkl", env)
        else:
            env = load_statistics(env, plain)
        env.training = env.norm_reward = False
    return env


def load_model(
    run: Run,
    env: VecEnv,
    seed: int | None = None,
    device: str = "auto",
    trust: bool = False,
    opponent: str = "own",
) -> MAPPO:
    """The run's model, rebuilt from config.yml; from the zip it takes weights only.

    :param run: The run
    :param env: Its environment
    :param seed: For sampled actions
    :param device: Where its networks shall be
    :param trust: Unpickle the zip instead, which can execute what its author put there
    :param opponent: See :func:`choose_opponent`
    """
    against = opponent_env(env)
    if against is not None:
        against.set_opponent("random")  # for now, so that the model brings none of its own
    if not trust:
        check_networks(run.config, run.model_path)
        model = build_model(run.algo, run.config, env, seed=seed, device=device)
        load_weights(model, run.model_path)
    else:
        model = _unpickle(run, env, seed=seed, device=device)
    check_finite(model, run.model_path)
    choose_opponent(run, model, env, opponent)
    return model


def choose_opponent(
    run: Run, model: MAPPO, env: VecEnv, opponent: str, deterministic: bool = False
) -> None:
    """Let somebody act for the opponents in an environment, if there are any.

    :param run: The run
    :param model: Its model
    :param env: The environment
    :param opponent: "own": the adversary that was saved beside the model; "random"; or the zip
        file of another adversary
    :param deterministic: Whether the adversary takes the most likely actions
    :raises UserError: if there is no such adversary, or it does not fit
    """
    against = opponent_env(env)
    if against is None:
        if opponent != "own":
            raise UserError(f"--opponent {opponent}: nobody plays against a team in {run.env_id}")
    elif opponent == "random":
        against.set_opponent("random")
    else:
        adversary = load_opponent(model, against, _adversary_file(run, opponent))
        against.set_opponent(adversary, deterministic=deterministic)


def _adversary_file(run: Run, opponent: str) -> Path:
    path = adversary_path(run.model_path) if opponent == "own" else Path(opponent)
    if not path.is_file():
        why = "the team's own adversary" if opponent == "own" else "--opponent"
        raise UserError(
            f"{path} ({why}) does not exist, and without an adversary the task is another one; "
            "name a file like PredatorPrey-v0.adversary.zip, or say --opponent random"
        )
    return path


def _unpickle_statistics(path: Path, env: VecEnv) -> VecNormalize:
    try:
        return VecNormalize.load(str(path), env)
    except Exception as error:  # whatever a broken or foreign pickle may raise
        raise UserError(f"cannot load {path}: {brief(error)}") from error


def _unpickle(run: Run, env: VecEnv, **flags: Any) -> MAPPO:
    try:
        return ALGORITHMS[run.algo].load(run.model_path, env=env, **flags)
    except Exception as error:  # whatever a broken or foreign pickle may raise
        raise UserError(f"cannot load {run.model_path}: {brief(error)}") from error
