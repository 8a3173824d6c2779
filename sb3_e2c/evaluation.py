"""Evaluation of whole teams: world episodes, with their returns and costs."""

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import CallbackList, EvalCallback, EventCallback
from stable_baselines3.common.type_aliases import MaybeCallback, PolicyPredictor
from stable_baselines3.common.vec_env import (
    VecEnv,
    VecMonitor,
    is_vecenv_wrapped,
    sync_envs_normalization,
)

from sb3_e2c.checks import check_costs, check_finite
from sb3_e2c.constraints import parse_cost_limits, read_costs, team_costs
from sb3_e2c.monitor import (
    TeamMonitor,
    add_costs,
    monitored,
    named_costs,
    raw_rewards,
    team_rewards,
    unwrap_team,
)
from sb3_e2c.saving import atomic_write
from sb3_e2c.vec_env import opponent_env


def standard_error(samples: np.ndarray) -> np.ndarray:
    """Standard error of the mean over the first axis; 0 for a single sample.

    :param samples: Shape (E, ...)
    :return: Shape (...)
    """
    if len(samples) < 2:
        return np.zeros(samples.shape[1:])
    return samples.std(axis=0, ddof=1) / np.sqrt(len(samples))


@dataclass(frozen=True)
class TeamEvaluation:
    """Results of E world episodes of N agents with M costs, in the order of their ends.

    All are undiscounted sums over an episode. M is 0 where the environment reports no costs.
    """

    returns: np.ndarray
    """Return of the team, shape (E,)"""
    agent_returns: np.ndarray
    """Shape (E, N)"""
    costs: np.ndarray
    """Costs of the team, shape (E, M); "sum" or "max" over the agents of every step"""
    agent_costs: np.ndarray
    """Shape (E, N, M)"""
    lengths: np.ndarray
    """Steps, shape (E,)"""

    def __str__(self) -> str:
        error = standard_error(self.returns)
        costs = ", ".join(f"{cost:.2f}" for cost in self.mean_costs)
        return (
            f"{len(self.returns)} episodes: return {self.mean_return:.2f} ± {error:.2f}"
            f"{f', cost {costs}' if costs else ''}"
        )

    @property
    def mean_return(self) -> float:
        """Mean return of the team."""
        return float(self.returns.mean())

    @property
    def mean_costs(self) -> np.ndarray:
        """Mean costs of the team, shape (M,)."""
        return self.costs.mean(axis=0)

    def violation_rate(self, cost_limits: float | Sequence[float] | np.ndarray) -> float:
        """Share of the episodes in which the team exceeds any of its limits.

        :param cost_limits: shape (M,)
        :return: between 0 and 1
        """
        return float((self.costs > self._limits(cost_limits)).any(axis=1).mean())

    def violation(self, cost_limits: float | Sequence[float] | np.ndarray) -> float:
        """How far the mean costs exceed the limits, Σ_j max(0, J_j − l_j).

        :param cost_limits: shape (M,)
        :return: 0 if all limits are kept
        """
        return float(np.maximum(0.0, self.mean_costs - self._limits(cost_limits)).sum())

    def _limits(self, cost_limits: float | Sequence[float] | np.ndarray) -> np.ndarray:
        limits = parse_cost_limits(cost_limits)
        if len(limits) != self.costs.shape[1]:
            raise ValueError(
                f"there are {len(limits)} cost limits, but the environment reports "
                f"{self.costs.shape[1]} costs in info['cost']; expected one limit for each cost"
            )
        return limits


def evaluate_team(
    model: PolicyPredictor,
    env: VecEnv,
    n_episodes: int = 10,
    deterministic: bool = False,
    render: bool = False,
    callback: Callable[[dict[str, Any], dict[str, Any]], None] | None = None,
) -> TeamEvaluation:
    """Run a policy for a number of world episodes.

    The episodes are divided among the worlds beforehand, as in SB3's ``evaluate_policy``, so that
    short ones do not count more. Rewards are those of the environment itself, also below a
    ``VecNormalize``. Every slot keeps its recurrent state until its own episode ends.

    :param model: anything with SB3's ``predict``, such as any SB3 algorithm or policy
    :param env: made by ``share_parameters``, perhaps wrapped
    :param n_episodes: E
    :param deterministic: whether to take the most likely actions; sampled ones are the default,
        because rewards were learned and costs limited for the sampled policy
    :param render: whether to render after every step
    :param callback: called after each step for each world whose episodes are still wanted, with
        ``locals()`` and ``globals()``; ``world``, ``info`` (its first slot's) and ``done`` are
        meant for it
    :return: the results of all episodes
    """
    tally = _Tally(env, n_episodes)
    observations, states = env.reset(), None
    tally.check(observations)
    episode_starts = np.ones(env.num_envs, dtype=bool)
    while tally.wanted.any():
        actions, states = model.predict(
            observations,  # type: ignore[arg-type]
            state=states,
            episode_start=episode_starts,
            deterministic=deterministic,
        )
        observations, rewards, episode_starts, infos = env.step(actions)
        if callback is not None:
            for world in np.flatnonzero(tally.wanted).tolist():
                slot = world * tally.team.n_agents
                info, done = infos[slot], bool(episode_starts[slot])
                callback(locals() | {"info": info, "done": done}, globals())
        tally.add(rewards, episode_starts, infos)
        tally.check(observations)
        if render:
            env.render()
    return tally.results()


class _Tally:
    """Sums of the running episodes, and the results of those that were wanted."""

    def __init__(self, env: VecEnv, n_episodes: int):
        if n_episodes < 1:
            raise ValueError(f"n_episodes is {n_episodes}; expected at least 1 world episode")
        self.env, self.team = env, unwrap_team(env, "evaluate_team")
        n_worlds, n_agents = self.team.n_worlds, self.team.n_agents
        self.n_steps = 0
        self._missing = (n_episodes + np.arange(n_worlds)) // n_worlds
        self._returns, self._agent_returns = np.zeros(n_worlds), np.zeros((n_worlds, n_agents))
        self._lengths = np.zeros(n_worlds, dtype=np.int64)
        self._costs: np.ndarray | None = None
        self._agent_costs: np.ndarray | None = None
        self._finished: list[tuple[np.ndarray, ...]] = []

    @property
    def wanted(self) -> np.ndarray:
        """Worlds with episodes still to count, shape (W,)."""
        return self._missing > 0

    @property
    def _when(self) -> str:
        return f"at step {self.n_steps} of the evaluation"

    def check(self, observations: Any) -> None:
        """Stop before a policy is asked about observations that are not finite.

        :param observations: shape (S, ...); dictionaries of them are left to the policy
        """
        if isinstance(observations, np.ndarray):
            check_finite(self.team.agents, self._when, observation=observations)

    def add(self, rewards: np.ndarray, dones: np.ndarray, infos: Sequence[dict[str, Any]]) -> None:
        """Count a step of all worlds.

        :param rewards: shape (S,)
        :param dones: shape (S,)
        :param infos: one for each slot
        """
        rewards = raw_rewards(self.env, rewards)
        costs = read_costs(infos, self.team.agents)
        self.n_steps += 1
        check_finite(self.team.agents, self._when, reward=rewards)
        check_costs(self.team.agents, self._when, costs, limited=False)
        self._returns += team_rewards(rewards, self.team)
        self._agent_returns += rewards.reshape(self._agent_returns.shape)
        self._costs = add_costs(self._costs, team_costs(costs, self.team.team_cost))
        self._agent_costs = add_costs(self._agent_costs, costs)
        self._lengths += 1
        self._finish(np.flatnonzero(dones[:: self.team.n_agents]))

    def _finish(self, worlds: np.ndarray) -> None:
        sums = (self._returns, self._agent_returns, self._costs, self._agent_costs, self._lengths)
        for world in worlds:
            if self._missing[world] > 0:
                self._missing[world] -= 1
                self._finished.append(tuple(np.copy(array[world]) for array in sums))  # type: ignore[index]
            for array in sums:
                array[world] = 0  # type: ignore[index]

    def results(self) -> TeamEvaluation:
        """All that was wanted."""
        return TeamEvaluation(*(np.stack(column) for column in zip(*self._finished, strict=True)))


def evaluations_in(callback: MaybeCallback) -> Iterator[EvalCallback]:
    """Callbacks that evaluate, also those that others call.

    :param callback: What ``learn`` is given
    """
    if isinstance(callback, EvalCallback):
        yield callback
    children: Iterable[Any] = ()
    if isinstance(callback, (list, CallbackList)):
        children = callback if isinstance(callback, list) else callback.callbacks
    elif isinstance(callback, EventCallback):
        children = [callback.callback]
    for child in children:
        yield from evaluations_in(child)


class TeamEvalCallback(EvalCallback):
    """``EvalCallback`` for teams: counts world episodes and takes safety into account.

    The best model is, among evaluations whose mean costs keep all limits, the one with the
    highest mean return; as long as there is none, the one that exceeds them least. Thus
    ``best_mean_reward`` may fall when the first safe model is found. ``evaluations.npz`` has
    SB3's keys and ``costs``, shape (evaluations, E, M). Evaluating changes nothing in the training,
    also with sampled actions. They are the default, because they are what is limited.

    As in SB3, ``eval_freq`` counts calls of ``env.step``, each of which is one step of every slot:
    ``eval_freq=24_000 // env.num_envs`` evaluates every 24,000 agent steps.

    :param eval_env: made by ``share_parameters``, perhaps wrapped
    :param cost_limits: limits on the team's costs of an episode, shape (M,); None takes those of
        the model, if it has any
    :param deterministic: whether to take the most likely actions
    :param kwargs: of SB3's ``EvalCallback``
    """

    def __init__(
        self,
        eval_env: VecEnv,
        cost_limits: float | Sequence[float] | None = None,
        deterministic: bool = False,
        **kwargs: Any,
    ):
        unwrap_team(eval_env, "TeamEvalCallback")
        super().__init__(eval_env, deterministic=deterministic, **kwargs)
        self.cost_limits = None if cost_limits is None else parse_cost_limits(cost_limits)
        self.evaluations_costs: list[np.ndarray] = []
        self._best_score = (-np.inf, -np.inf)

    def _init_callback(self) -> None:
        # MAPPO gives a monitor to its environment by itself; the two have to be alike.
        if is_vecenv_wrapped(self.training_env, TeamMonitor) and not is_vecenv_wrapped(
            self.eval_env, VecMonitor
        ):
            self.eval_env = monitored(self.eval_env)
        _share_opponent(self.training_env, self.eval_env)
        if self.cost_limits is None:
            self.cost_limits = parse_cost_limits(getattr(self.model, "cost_limits", None))
        super()._init_callback()

    def _on_step(self) -> bool:
        if self.eval_freq <= 0 or self.n_calls % self.eval_freq != 0:
            return True
        evaluation = self._evaluate()
        if self.log_path is not None:
            self._keep(evaluation)
            self.write_evaluations()
        self._log(evaluation)
        continue_training = self._keep_best(evaluation)
        if self.callback is not None:
            continue_training = continue_training and self._on_event()
        return continue_training

    def _evaluate(self) -> TeamEvaluation:
        if self.model.get_vec_normalize_env() is not None:
            try:
                sync_envs_normalization(self.training_env, self.eval_env)
            except AttributeError as error:
                raise AssertionError(
                    "the training and the evaluation environment are not wrapped in the same way; "
                    "wrap both in VecNormalize, in the same place"
                ) from error
        self._is_success_buffer = []
        device = self.model.device
        gpus = [device] if device.type == "cuda" else []
        with th.random.fork_rng(gpus):  # the random numbers of the training stay as they are
            return evaluate_team(
                self.model,
                self.eval_env,
                n_episodes=self.n_eval_episodes,
                deterministic=self.deterministic,
                render=self.render,
                callback=self._log_success_callback,
            )

    def _keep(self, evaluation: TeamEvaluation) -> None:
        self.evaluations_timesteps.append(self.num_timesteps)
        self.evaluations_results.append(evaluation.returns.tolist())
        self.evaluations_length.append(evaluation.lengths.tolist())
        self.evaluations_costs.append(evaluation.costs)
        if self._is_success_buffer:
            self.evaluations_successes.append(self._is_success_buffer)

    def write_evaluations(self) -> None:
        """Write ``evaluations.npz`` from all evaluations so far; nothing without ``log_path``."""
        if self.log_path is None:
            return
        target = Path(f"{self.log_path}.npz")
        if not self.evaluations_timesteps:
            target.unlink(missing_ok=True)
            return
        successes = {}
        if self.evaluations_successes:
            successes = {"successes": self.evaluations_successes}
        with atomic_write(target) as file:
            np.savez(
                file,
                timesteps=self.evaluations_timesteps,
                results=self.evaluations_results,
                ep_lengths=self.evaluations_length,
                costs=self.evaluations_costs,
                **successes,  # type: ignore[arg-type]
            )

    def _log(self, evaluation: TeamEvaluation) -> None:
        self.last_mean_reward = evaluation.mean_return
        quantities = self._cost_quantities(evaluation)
        if self._is_success_buffer:
            quantities["success_rate"] = float(np.mean(self._is_success_buffer))
        if self.verbose >= 1:
            self._print(evaluation, quantities)
        self.logger.record("eval/mean_reward", evaluation.mean_return)
        self.logger.record("eval/mean_ep_length", float(evaluation.lengths.mean()))
        for name, value in quantities.items():
            self.logger.record(f"eval/{name}", value)
        # Written now, so that the evaluation stands at the right time step.
        self.logger.record("time/total_timesteps", self.num_timesteps, exclude="tensorboard")
        self.logger.dump(self.num_timesteps)

    def _print(self, evaluation: TeamEvaluation, quantities: dict[str, float]) -> None:
        returns, lengths = evaluation.returns, evaluation.lengths
        print(
            f"Eval num_timesteps={self.num_timesteps}, "
            f"episode_reward={returns.mean():.2f} +/- {returns.std():.2f}"
        )
        print(f"Episode length: {lengths.mean():.2f} +/- {lengths.std():.2f}")
        if quantities:
            print(", ".join(f"{name}={value:.2f}" for name, value in quantities.items()))

    def _cost_quantities(self, evaluation: TeamEvaluation) -> dict[str, float]:
        quantities = named_costs(evaluation.mean_costs.tolist(), "mean_cost")
        if self._has_limits():
            quantities["violation_rate"] = evaluation.violation_rate(self.cost_limits)  # type: ignore[arg-type]
        return quantities

    def _keep_best(self, evaluation: TeamEvaluation) -> bool:
        """Save the model if it is the best so far, and call ``callback_on_new_best``."""
        violation = evaluation.violation(self.cost_limits) if self._has_limits() else 0.0  # type: ignore[arg-type]
        score = (-violation, evaluation.mean_return)
        if not score > self._best_score:
            return True
        self._best_score = score
        self.best_mean_reward = evaluation.mean_return
        if self.verbose >= 1:
            print("New best model!" if self._has_limits() else "New best mean reward!")
        if self.best_model_save_path is not None:
            self.model.save(os.path.join(self.best_model_save_path, "best_model"))
        if self.callback_on_new_best is not None:
            return self.callback_on_new_best.on_step()
        return True

    def _has_limits(self) -> bool:
        return self.cost_limits is not None and len(self.cost_limits) > 0


def _share_opponent(training_env: VecEnv, eval_env: VecEnv) -> None:
    """Let who acts for the opponents in training act in evaluations, unless another was chosen."""
    source, target = opponent_env(training_env), opponent_env(eval_env)
    if source is None or target is None or target.chosen:
        return
    if source.opponent is not None:
        target.attach(source.opponent, deterministic=source.deterministic_opponent)
