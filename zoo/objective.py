"""One trial of ``sb3-e2c tune``: train a team, evaluate it, report return, costs and violation.

Not RL-Zoo's objective, which evaluates rows instead of teams, and before the last update.
"""

import argparse
import contextlib
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import optuna
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_e2c import TeamEvalCallback
from sb3_e2c.evaluation import TeamEvaluation, standard_error
from sb3_e2c.monitor import TeamMonitor
from sb3_e2c.zoo.build import build_model, make_worlds, own_callbacks, refusals_of
from sb3_e2c.zoo.console import brief
from sb3_e2c.zoo.runs import EVALUATION_SEED
from sb3_e2c.zoo.search_space import SearchSpace
from sb3_e2c.zoo.study import DIVERGED, violation_key

_BROKE_OFF = (ValueError, RuntimeError, MemoryError)  # what a training that blows up raises


class TrialEvaluation(TeamEvalCallback):
    """Evaluates a trial between rollouts, and stops it if the pruner says so.

    :param eval_env: Where
    :param trial: The trial
    :param n_timesteps: Agent steps of its training
    :param n_evaluations: Evaluations, the last of them after the training
    :param n_eval_episodes: E
    """

    def __init__(
        self,
        eval_env: VecEnv,
        trial: optuna.Trial,
        n_timesteps: int,
        n_evaluations: int,
        n_eval_episodes: int,
    ):
        super().__init__(eval_env, eval_freq=0, n_eval_episodes=n_eval_episodes)
        self.trial, self.n_timesteps, self.n_evaluations = trial, n_timesteps, n_evaluations
        self._step = 0

    def _on_rollout_start(self) -> None:
        step = self.model.num_timesteps * self.n_evaluations // self.n_timesteps
        if self._step < step < self.n_evaluations:
            self._step = step
            result = self._report(step)
            if self.trial.should_prune():
                self._keep_result(result)
                raise optuna.TrialPruned

    def _report(self, step: int) -> TeamEvaluation:
        result = self._evaluate()
        if not (np.isfinite(result.returns).all() and np.isfinite(result.costs).all()):
            raise ValueError("the evaluation gave returns or costs that are infinite or NaN")
        excess = result.violation(self._limits) if len(self._limits) else 0.0
        self.trial.set_user_attr(violation_key(step), excess)
        self.trial.report(result.mean_return, step)
        return result

    @property
    def _limits(self) -> np.ndarray:
        assert self.cost_limits is not None  # the model's, since training began
        return np.asarray(self.cost_limits)

    def _keep_result(self, result: TeamEvaluation) -> None:
        """What the trial's constraints and tables are made of."""
        for j, limit in enumerate(self._limits):
            self.trial.set_constraint(f"cost_{j}", result.mean_costs[j] - limit)
        self.trial.set_user_attr("return", result.mean_return)
        self.trial.set_user_attr("return_se", float(standard_error(result.returns)))
        self.trial.set_user_attr("costs", result.mean_costs.tolist())

    def final(self) -> float:
        """Evaluate the trained team."""
        result = self._report(self.n_evaluations)
        self._keep_result(result)
        return result.mean_return


class Objective:
    """Trains and evaluates one trial.

    :param args: The parsed flags
    :param space: What is searched
    :param worker: Name of this process among those that work on the study
    """

    def __init__(self, args: argparse.Namespace, space: SearchSpace, worker: str):
        self.args, self.space, self.worker = args, space, worker

    def __call__(self, trial: optuna.Trial) -> float:
        """The mean return of the trained team.

        :param trial: The trial; its config, costs and constraints are recorded
        """
        trial.set_user_attr("worker", self.worker)
        config = self.space.suggest(trial)
        trial.set_user_attr("config", config)
        try:
            return self._train(trial, config)
        except _BROKE_OFF as error:
            trial.set_user_attr("error", brief(error))
            trial.set_constraint("diverged", DIVERGED)
            raise optuna.TrialPruned from error

    def _train(self, trial: optuna.Trial, config: Mapping[str, Any]) -> float:
        args, seed = self.args, self.args.seed + trial.number
        with (
            worlds(args.env, config, config["n_envs"], seed) as env,
            _eval_worlds(args, config) as (eval_env),
        ):
            model = build_model(args.algo, config, env, seed=seed, device=args.device)
            model.set_logger(Logger(None, []))
            evaluation = TrialEvaluation(
                eval_env, trial, n_steps(args, config), args.n_evaluations, args.eval_episodes
            )
            callbacks = [*own_callbacks(config), evaluation]
            model.learn(n_steps(args, config), callback=callbacks, log_interval=None)  # type: ignore[arg-type]
            return evaluation.final()


def n_steps(args: argparse.Namespace, config: Mapping[str, Any]) -> int:
    """Agent steps of a trial.

    :param args: The parsed flags
    :param config: The configuration
    """
    return args.n_timesteps if args.n_timesteps > 0 else config["n_timesteps"]


@contextlib.contextmanager
def worlds(env_id: str, config: Mapping[str, Any], n_worlds: int, seed: int) -> Iterator[VecEnv]:
    """Worlds of a configuration, monitored and normalized.

    :param env_id: A key of ``ENV_IDS``
    :param config: The configuration
    :param n_worlds: W
    :param seed: World w gets seed + w
    """
    env: VecEnv = TeamMonitor(make_worlds(env_id, config.get("env_kwargs"), n_worlds, seed))
    normalize = config.get("normalize")
    with contextlib.closing(env):
        if normalize:
            kwargs = normalize if isinstance(normalize, Mapping) else {}
            with refusals_of("normalize"):
                env = VecNormalize(env, **{"gamma": config.get("gamma", 0.99), **kwargs})
        yield env


@contextlib.contextmanager
def _eval_worlds(args: argparse.Namespace, config: Mapping[str, Any]) -> Iterator[VecEnv]:
    """The same worlds for every trial."""
    seed = args.seed + EVALUATION_SEED
    with worlds(args.env, config, args.n_eval_envs, seed) as env:
        if isinstance(env, VecNormalize):
            env.training = env.norm_reward = False
        yield env
