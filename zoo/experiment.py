"""RL-Zoo's ``ExperimentManager`` for teams: worlds instead of environments, episodes of worlds."""

import contextlib
import os
import shlex
import signal
import warnings
from argparse import Namespace
from collections.abc import Mapping
from copy import deepcopy
from pathlib import Path
from pprint import pprint
from typing import Any

import gymnasium as gym
import yaml
from rl_zoo3.exp_manager import ExperimentManager
from rl_zoo3.utils import ALGOS
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CheckpointCallback,
    ProgressBarCallback,
)
from stable_baselines3.common.logger import KVWriter, Logger, make_output_format
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_e2c import MAPPO, TeamEvalCallback
from sb3_e2c.constraints import check_n_costs, read_costs
from sb3_e2c.envs import ENV_IDS
from sb3_e2c.monitor import TeamMonitor
from sb3_e2c.vec_env import opponent_env
from sb3_e2c.zoo.build import (
    build_model,
    check_finite,
    check_networks,
    constructor_arguments,
    go_on_from,
    load_opponent,
    make_worlds,
    own_callbacks,
    refusals_of,
)
from sb3_e2c.zoo.configuration import (
    ALGORITHMS,
    ZOO_KEYS,
    check,
    merge,
    parse_presets,
    read_yaml,
    resolve,
)
from sb3_e2c.zoo.console import UserError, brief, write_whole
from sb3_e2c.zoo.normalization import load_statistics, save_statistics, statistics_path
from sb3_e2c.zoo.resume import KeepPoints, Resumable, ignore_stop_signals, tensorboard_format
from sb3_e2c.zoo.runs import latest_run_id

# What a continued run may change: numbers that a loaded model reads anew in each rollout.
_CHANGEABLE = (
    *("learning_rate", "critic_learning_rate", "clip_range", "clip_range_vf"),
    *("ent_coef", "vf_coef", "max_grad_norm", "n_steps"),
    *("batch_size", "n_epochs", "gamma", "gae_lambda", "target_kl", "reward_scale"),
    "update_threads",
)


def _no_single_agent(**_: Any) -> gym.Env:
    raise TypeError("this id names a PettingZoo environment; see sb3_e2c.envs.ENV_IDS")


def register() -> None:
    """Tell RL-Zoo the names of our algorithms and environments."""
    ALGOS.update(ALGORITHMS)
    for env_id in ENV_IDS:
        if env_id not in gym.registry:
            gym.register(env_id, entry_point=_no_single_agent)


def configure(args: Namespace) -> dict[str, Any]:
    """The configuration that a ``train`` command line asks for.

    :param args: Parsed flags of ``train``
    :raises UserError: for anything in it that cannot be meant
    """
    if args.resume:
        config = read_yaml(Path(args.resume) / args.env / "config.yml")
        check(args.algo, config)
        return config
    overrides = merge(
        _conf_file(args), {"env_kwargs": args.env_kwargs or {}}, args.hyperparams or {}
    )
    base = _continued_configuration(args)
    if base is not None and not args.trust:
        base = _without_callback(base, overrides)
    config = resolve(args.algo, args.env, parse_presets(args.preset), overrides, base)
    if base is not None:
        _check_changes(base, config)
    return config


def _conf_file(args: Namespace) -> dict[str, Any]:
    if args.conf_file is None:
        return {}
    content = read_yaml(args.conf_file)
    entry = content.get(args.env, content.get("default"))
    if not isinstance(entry, dict):
        raise UserError(f"{args.conf_file} has neither an entry {args.env} nor 'default'")
    return entry


def _continued_configuration(args: Namespace) -> dict[str, Any] | None:
    """What the run to be continued was trained with, if it lies where ``train`` puts it."""
    saved = Path(args.trained_agent).parent / args.env
    if not (args.trained_agent and (saved / "config.yml").is_file()):
        return None
    algo = read_yaml(saved / "args.yml").get("algo")
    if algo != args.algo:
        raise UserError(f"-i {args.trained_agent} was trained with --algo {algo}, not {args.algo}")
    return read_yaml(saved / "config.yml")


def _without_callback(old: dict[str, Any], overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Leave out code that a file from elsewhere may have named; the user's own takes its place.

    :raises UserError: if the user gave none
    """
    if old.get("callback") and "callback" not in overrides:
        raise UserError(
            f"-i: the run's config.yml names a callback, {brief(old['callback'])}, which is code; "
            "say --trust if you want it to run, or -params callback:null to do without"
        )
    return {key: value for key, value in old.items() if key != "callback"}


def _check_changes(old: dict[str, Any], new: dict[str, Any]) -> None:
    for key in sorted(set(new) - ZOO_KEYS.keys() - set(_CHANGEABLE)):
        if new[key] != old.get(key):
            raise UserError(
                f"{key} was {old.get(key)!r} in the run to be continued (-i) and cannot become "
                f"{new[key]!r}; start a new run"
            )


def _check_same_team(env: VecEnv, eval_env: VecEnv) -> None:
    """Refuse an evaluation of the team in an environment for another one."""
    for name in ("agents", "observation_space", "action_space"):
        found, expected = getattr(eval_env, name), getattr(env, name)
        if found != expected:
            raise UserError(
                f"--eval-env-kwargs: {name} of the evaluation would be {found}, but the team "
                f"trains with {expected}; change only what leaves them alike"
            )


class TeamExperimentManager(ExperimentManager):
    """Builds, trains and saves a team; see RL-Zoo for the arguments.

    :param args: As RL-Zoo's, the first being the parsed flags of ``train``
    :param command: How to run the same again
    :param kwargs: As RL-Zoo's
    """

    def __init__(self, *args: Any, command: list[str], **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.command = command
        self.deterministic_eval = False  # limits hold for the policy that is trained: the sampled
        self.env_id = self.args.env
        self.n_slots = 0
        if self.args.resume:
            self.save_path = str(Path(self.args.resume))
            self.params_path = os.path.join(self.save_path, self.env_id)
        self.points = self._resumable()
        self.stopped_by: int | None = None  # number of the signal

    def _resumable(self) -> Resumable:
        return Resumable(Path(self.save_path), self.args.resume_every, bool(self.args.resume))

    def setup_experiment(self) -> tuple[BaseAlgorithm, dict[str, Any]]:
        """Build everything; nothing is written before all of it has been built once.

        :return: The model, and the configuration of the run
        """
        config = configure(self.args)
        if self.args.resume:
            self.points.open(config, self.n_timesteps)
            self.n_timesteps = self.points.total
        self.n_envs = config["n_envs"]
        self.n_timesteps = self.n_timesteps if self.n_timesteps > 0 else config["n_timesteps"]
        self.env_kwargs = config.get("env_kwargs") or {}
        self._preprocess_normalization(deepcopy(config))
        self.callbacks = own_callbacks(config)
        self._rehearse(config)
        if self.verbose > 0:
            self._describe(config)
        self.create_log_folder()
        if self.args.resume:
            self.points.cut_logs()
        else:
            self.points.open(config)
        self.create_callbacks()
        model = self._make_model(config, self.create_envs(self.n_envs), self.verbose)
        if not self.args.resume:
            self._save_config(config)
        return model, config

    def create_log_folder(self) -> None:
        """Make the run's folder; another training may have taken its number in the meantime."""
        number = latest_run_id(Path(self.log_path), self.env_name)
        while not self.args.resume:
            try:
                os.makedirs(self.save_path)
                break
            except FileExistsError:
                number += 1
                self.save_path = os.path.join(self.log_path, f"{self.env_name}_{number}")
                self.params_path = os.path.join(self.save_path, self.env_name)
                self.points = self._resumable()
        super().create_log_folder()

    def _rehearse(self, config: dict[str, Any]) -> None:
        """Build worlds and model once without a trace, so that mistakes show before the run."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # they will be seen in earnest
            with contextlib.closing(self.create_envs(self.n_envs, no_log=True)) as env:
                with contextlib.closing(self.create_envs(self.n_eval_envs, True)) as eval_env:
                    eval_env.reset()
                    _check_same_team(env, eval_env)
                self.n_slots = env.num_envs
                self._step_once(self._make_model(config, env, verbose=0))

    def _step_once(self, model: MAPPO) -> None:
        """See whether the actor acts, and the environment reports the costs that are limited."""
        env = model.env
        assert env is not None
        with refusals_of(f"{self.algo} on {self.env_id}"):
            actions, _ = model.predict(env.reset())  # type: ignore[arg-type]
            infos = env.step(actions)[-1]
            if len(model.cost_limits):
                costs = read_costs(infos, model.agents)
                check_n_costs(costs, len(model.cost_limits), model.agents)

    def _make_model(self, config: dict[str, Any], env: VecEnv, verbose: int) -> MAPPO:
        flags: dict[str, Any] = {"seed": self.seed, "device": self.device, "verbose": verbose}
        against = opponent_env(env)
        own = self.args.opponent == "own"
        if against is not None and not own:
            against.set_opponent("random")
        elif not own:
            raise UserError(f"--opponent: nobody plays against a team in {self.env_id}")
        model = self._new_or_continued(config, env, flags)
        if against is not None and self.args.opponent not in ("own", "random"):
            against.set_opponent(load_opponent(model, against, self.args.opponent))
        env.seed(self.points.world_seed(self.seed))  # the model has seeded them with its own
        return model

    def _new_or_continued(self, config: dict[str, Any], env: VecEnv, flags: Any) -> MAPPO:
        if not self.continue_training:
            return build_model(self.algo, config, env, **flags)
        try:
            if self.args.trust:
                return self._trusted(config, env, flags)
            check_networks(config, self.trained_agent)
            model = build_model(self.algo, config, env, **flags)
            go_on_from(model, self.trained_agent)
        except UserError as error:
            raise UserError(f"cannot continue from {self.trained_agent}: {error}") from error
        return model

    def _trusted(self, config: dict[str, Any], env: VecEnv, flags: dict[str, Any]) -> MAPPO:
        """Stable-Baselines3's own loading, which executes what the file says."""
        changes = constructor_arguments({k: config[k] for k in _CHANGEABLE if k in config})
        try:
            model = ALGORITHMS[self.algo].load(self.trained_agent, env=env, **flags, **changes)
        except Exception as error:  # whatever a broken or foreign pickle may raise
            raise UserError(brief(error)) from error
        check_finite(model, self.trained_agent)
        return model

    def _describe(self, config: dict[str, Any]) -> None:
        n_agents = self.n_slots // self.n_envs
        print(f"{self.n_envs} worlds of {n_agents} agents: {self.n_slots} agent steps at a time")
        pprint(config)

    def create_envs(self, n_envs: int, eval_env: bool = False, no_log: bool = False) -> VecEnv:
        """Make worlds, with one monitor row for each of their episodes.

        :param n_envs: W
        :param eval_env: Whether it is for evaluation: seeds of its own, one process
        :param no_log: Whether not to write monitor.csv
        """
        parallel = not eval_env and self.args.vec_env == "subproc"
        env = make_worlds(
            self.env_id,
            merge(self.env_kwargs, self.args.eval_env_kwargs or {})
            if eval_env
            else self.env_kwargs,
            n_envs,
            seed=self.points.world_seed(self.seed) + (self.n_envs if eval_env else 0),
            n_processes=min(n_envs, os.cpu_count() or 1) if parallel else 1,
        )
        log = None if eval_env or no_log else os.path.join(self.save_path, "monitor.csv")
        monitored = TeamMonitor(env, log, override_existing=not self.args.resume)
        return self._maybe_normalize(monitored, eval_env)

    def _maybe_normalize(self, env: VecEnv, eval_env: bool) -> VecEnv:
        """Add ``normalize:``; a continued run goes on with its statistics."""
        if not self.normalize:
            return env
        if self.continue_training:
            env = load_statistics(env, statistics_path(self.trained_agent))
        else:
            with refusals_of("normalize"):
                env = VecNormalize(env, **self.normalize_kwargs)
        if eval_env:
            env.training = env.norm_reward = False
        return env

    def create_callbacks(self) -> None:
        """Progress bar, checkpoints and evaluation; frequencies count agent steps."""
        if self.show_progress:
            self.callbacks.append(ProgressBarCallback())
        if self.save_freq > 0:
            self.callbacks.append(
                _Checkpoint(self._calls(self.save_freq), self.save_path, save_vecnormalize=True)
            )
        if self.eval_freq > 0:
            best = Path(self.save_path) / "best_model.zip"
            self.callbacks.append(
                TeamEvalCallback(
                    self.create_envs(self.n_eval_envs, eval_env=True),
                    callback_on_new_best=_SaveStatistics(statistics_path(best)),
                    best_model_save_path=self.save_path,
                    n_eval_episodes=self.n_eval_episodes,
                    log_path=self.save_path,
                    eval_freq=self._calls(self.eval_freq),
                    deterministic=self.deterministic_eval,
                    verbose=self.verbose,
                )
            )
        self.callbacks.append(KeepPoints(self.points))

    def _calls(self, agent_steps: int) -> int:
        """How many calls of ``env.step`` make so many agent steps."""
        return max(agent_steps // self.n_slots, 1)

    def learn(self, model: BaseAlgorithm) -> None:
        """Train; a continued run keeps its step counter and ends ``n_timesteps`` later.

        :param model: What :meth:`setup_experiment` built
        :raises UserError: if it breaks off, for instance because its numbers blow up
        """
        model.set_logger(self._logger())
        log_interval = {-1: 1, -2: None}.get(self.log_interval, self.log_interval)
        assert model.env is not None
        evaluations = [each for each in self.callbacks if isinstance(each, TeamEvalCallback)]
        self.points.check_worlds(model.env, *(each.eval_env for each in evaluations))
        try:
            model.learn(
                self.n_timesteps,
                callback=self.callbacks,
                log_interval=log_interval,  # type: ignore[arg-type]
                reset_num_timesteps=not self.continue_training,
            )
        except KeyboardInterrupt as stop:
            ignore_stop_signals()
            self.stopped_by = getattr(stop, "number", signal.SIGINT)
            print(f"Interrupted at {model.num_timesteps:,} agent steps: saving")
        except (ValueError, RuntimeError, MemoryError, OSError) as error:
            with contextlib.suppress(OSError):  # the disk may be full
                self.points.write()
            there = os.path.exists(self.save_path)
            kept = f"; {self.save_path} keeps what was saved before" if there else ""
            raise UserError(f"training stopped: {brief(error)}{kept}") from error
        except Exception:  # of a callback, for instance: its traceback says what is wrong
            with contextlib.suppress(OSError):
                self.points.write()
            raise
        finally:
            ignore_stop_signals()
            self._release(model)

    def _release(self, model: BaseAlgorithm) -> None:
        """Write the log of the last update, then close logs, progress bar and worlds."""
        model.logger.record("time/total_timesteps", model.num_timesteps)
        try:
            model.logger.dump(model.num_timesteps)
            model.logger.close()
        except (OSError, ValueError) as error:  # perhaps the disk that has stopped the training
            print(f"The last row of the log is lost: {brief(error)}")
        for callback in self.callbacks:
            if isinstance(callback, ProgressBarCallback) and hasattr(callback, "pbar"):
                callback.pbar.close()
            if isinstance(callback, TeamEvalCallback):
                callback.eval_env.close()
        assert model.env is not None
        model.env.close()

    def _logger(self) -> Logger:
        """progress.csv in the run folder; tables with ``--verbose 1``; TensorBoard with ``-tb``."""
        formats: list[KVWriter] = [self.points.progress_file()]
        if self.verbose > 0:
            formats.append(make_output_format("stdout", self.save_path))
        if self.tensorboard_log is not None:
            if self.points.tensorboard is None:
                run = latest_run_id(Path(self.tensorboard_log), self.algo) + 1
                folder = os.path.join(self.tensorboard_log, f"{self.algo}_{run}")
                self.points.tensorboard = os.path.abspath(folder)
            formats.append(tensorboard_format(self.points.tensorboard, self.points.steps))
        return Logger(self.save_path, formats)

    def save_trained_model(self, model: BaseAlgorithm) -> None:
        """Save the model, and what ``normalize:`` has measured, as RL-Zoo names them.

        :param model: The trained model
        """
        path = Path(self.save_path) / f"{self.env_name}.zip"
        if self.verbose > 0:
            print(f"Saving to {self.save_path}")
        model.save(path)
        normalizer = model.get_vec_normalize_env()
        if normalizer is not None:
            normalizer.save(os.path.join(self.params_path, "vecnormalize.pkl"))
            save_statistics(normalizer, statistics_path(path))
        self.points.write()  # not before, so that a run whose last point is there has its model

    def _save_config(self, saved_hyperparams: dict[str, Any]) -> None:
        """Write config.yml, args.yml and command.txt as plain data."""
        folder = Path(self.params_path)
        write_whole(folder / "config.yml", yaml.safe_dump(saved_hyperparams))
        write_whole(folder / "args.yml", yaml.safe_dump(vars(self.args)))
        write_whole(folder / "command.txt", shlex.join(self.command) + "\n")
        if self.verbose > 0:
            print(f"Log path: {self.save_path}")


class _SaveStatistics(BaseCallback):
    """Write the statistics of ``normalize:``, if any, each time it is called.

    :param path: Where
    """

    def __init__(self, path: Path):
        super().__init__()
        self.path = path

    def _on_step(self) -> bool:
        normalizer = self.model.get_vec_normalize_env()
        if normalizer is not None:
            save_statistics(normalizer, self.path)
        return True


class _Checkpoint(CheckpointCallback):
    """Checkpoints, each with its own plain statistics of ``normalize:``."""

    def _on_step(self) -> bool:
        super()._on_step()
        normalizer = self.model.get_vec_normalize_env()
        if self.n_calls % self.save_freq == 0 and normalizer is not None:
            save_statistics(normalizer, statistics_path(self._checkpoint_path(extension="zip")))
        return True
