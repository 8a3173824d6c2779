"""MAPPO with optional cost constraints (Alg. 2).

    env.step ─► o' (S, D), r (S,), infos["cost"]       Alg. 2 l. 5-7
      callbacks may edit r in place                    Alg. 1 (OEMRewardCallback)
      Collector ─► TeamRolloutBuffer                   critics, GAE for r and every cost, l. 12
    train:  λ ← multipliers.update(J − l)              l. 11, Eq. 7
            Ã = A_r − Σ λⱼ A_cⱼ, clipped surrogate     l. 13, Eq. 8
            regression of all critics                  l. 14, 16

Shapes: T steps, W worlds, N agents, S = W·N slots (slot = world·N + agent), D observation size,
K constrained parties (1: the team, N: each agent), M constraints.
"""

import math
import pathlib
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from itertools import chain
from typing import Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from pettingzoo import AECEnv, ParallelEnv
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.utils import FloatSchedule, explained_variance, safe_mean
from stable_baselines3.common.vec_env import VecEnv

from sb3_e2c.arguments import checked, making, settle
from sb3_e2c.buffers import TeamRolloutBuffer, TeamSamples
from sb3_e2c.collector import Collector
from sb3_e2c.constraints import (
    CostScope,
    check_cost_scope,
    n_parties,
    parse_cost_limits,
    party_limits,
    violation,
)
from sb3_e2c.descent import Descent, update_threads
from sb3_e2c.evaluation import evaluations_in
from sb3_e2c.losses import normalize
from sb3_e2c.monitor import monitored, named_costs
from sb3_e2c.multipliers import GradientMultipliers, Multipliers
from sb3_e2c.objective import Weights
from sb3_e2c.opponents import adversary_path, load_learner
from sb3_e2c.policies import TeamPolicy
from sb3_e2c.recorder import TeamRecorder
from sb3_e2c.recurrent import GruPolicy
from sb3_e2c.saving import atomic_write
from sb3_e2c.teams import (
    check_batch,
    check_env,
    check_policy,
    check_spaces,
    check_subclass,
    check_team,
    team_of,
)
from sb3_e2c.vec_env import OpponentVecEnv, opponent_env, share_parameters

_ADVICE = "Lower learning_rate or reward_scale, or use normalize_values=True"


class MAPPO(PPO):
    """Multi-agent PPO with parameter sharing, a centralized critic and optional cost constraints.

    Papers: Yu et al. 2022 (MAPPO); Aydeniz et al. 2025, "Safe Multiagent Coordination via Entropic
    Exploration" (constraints of a team or of its agents). Arguments that are not listed here are
    those of Stable-Baselines3's PPO; a step is one agent's step, as a row is in Stable-Baselines3.

    What an environment may put into its infos, for every agent:

    - ``cost``: a number, or M numbers, in the info of every step; needed with ``cost_limits``, and
      then at least 0.
    - ``critic_state``: a 1-D array, equal for all agents of a world, in the infos of every reset
      and step. Critics see it beside the joint observation, actors never do (docs/paper.md, D18).

    :param policy: "MlpPolicy", "GruPolicy", or a subclass of :class:`sb3_e2c.policies.TeamPolicy`
    :param env: What :func:`sb3_e2c.share_parameters` returns. A PettingZoo parallel environment
        becomes one world; a single-agent environment is a team of one
    :param learning_rate: Of the actor, and of the critics unless they have their own
    :param n_steps: Steps of each world in a rollout; a multiple of the episode length is best
    :param batch_size: Largest minibatch in agent steps; whole team steps are drawn, and minibatches
        of a rollout have nearly equal sizes. With GRUs whole sequences are, and it is approximate
    :param cost_limits: Limit(s) on the team's undiscounted cost of an episode, one for each cost
        that the environment reports in ``info["cost"]``; None or [] is plain MAPPO
    :param cost_scope: "team": one multiplier and a joint cost critic for each limit; "individual":
        every agent has its own, on local observations, with the limit divided by N (Sec. 4.1)
    :param cost_gamma: Discount of the costs; None: ``gamma``
    :param cost_margin: Share of every limit that the multipliers keep in reserve: they aim at
        (1 − cost_margin) l, because what is learned last is often a little above the limit
    :param multipliers_class: ``GradientMultipliers`` or ``PIDMultipliers``
    :param multipliers_kwargs: Its arguments, except the shape
    :param reward_scale: Factor on the environment's reward for learning; never on what is reported
    :param critic_learning_rate: Of all critics, also as a schedule; None: ``learning_rate``
    :param normalize_values: Standardize the targets of the critics by their running mean and
        standard deviation, for the reward and each cost separately
    :param opponent_kwargs: Arguments in which the opponents' model differs from the team's, in an
        :class:`sb3_e2c.OpponentVecEnv` whose opponents learn; it never has limits or a bonus
    :param update_threads: Threads that share the work of an update, 1 or 2, which changes the
        rounding. None: 2 if torch would use two (``torch.set_num_threads``), the process may use
        several cores, and it is nobody's worker
    :raises ValueError: for numbers that make no sense, or a batch smaller than a team
    :raises TypeError: for arguments of another kind
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": TeamPolicy,
        "GruPolicy": GruPolicy,
    }
    # What the model of opponents takes over from the team, unless opponent_kwargs say otherwise
    opponent_arguments: ClassVar[frozenset[str]] = frozenset(
        (
            *("policy", "policy_kwargs", "learning_rate", "critic_learning_rate", "batch_size"),
            *("n_epochs", "gamma", "gae_lambda", "clip_range", "clip_range_vf", "target_kl"),
            *("normalize_advantage", "normalize_values", "ent_coef", "vf_coef", "max_grad_norm"),
            *("reward_scale", "update_threads", "device"),
        )
    )
    policy: TeamPolicy
    rollout_buffer: TeamRolloutBuffer
    multipliers: Multipliers
    clip_range: FloatSchedule
    clip_range_vf: FloatSchedule | None
    # Asked after every epoch whether the update ends there; TrustRegionMonitor sets it.
    stop_epochs: Callable[[], bool] | None = None
    _log_interval = 1

    def __init__(
        self,
        policy: str | type[TeamPolicy],
        env: GymEnv | ParallelEnv | str | None,
        learning_rate: float | Schedule = 3e-4,
        n_steps: int = 2048,
        batch_size: int = 64,
        n_epochs: int = 10,
        gamma: float = 0.99,
        gae_lambda: float = 0.95,
        clip_range: float | Schedule = 0.2,
        clip_range_vf: float | Schedule | None = None,
        normalize_advantage: bool = True,
        ent_coef: float = 0.0,
        vf_coef: float = 0.5,
        max_grad_norm: float = 0.5,
        cost_limits: float | Sequence[float] | None = None,
        cost_scope: CostScope = "team",
        cost_gamma: float | None = None,
        cost_margin: float = 0.0,
        multipliers_class: type[Multipliers] = GradientMultipliers,
        multipliers_kwargs: dict[str, Any] | None = None,
        reward_scale: float = 1.0,
        critic_learning_rate: float | Schedule | None = None,
        normalize_values: bool = False,
        opponent_kwargs: dict[str, Any] | None = None,
        update_threads: int | None = None,
        target_kl: float | None = None,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
    ):
        check_policy(policy, self.policy_aliases)
        self.cost_limits = parse_cost_limits(cost_limits)
        self.cost_scope = cost_scope
        self.cost_gamma = cost_gamma
        self.cost_margin = cost_margin
        self.multipliers_class = multipliers_class
        self.multipliers_kwargs = {} if multipliers_kwargs is None else multipliers_kwargs
        self.reward_scale = reward_scale
        self.critic_learning_rate = critic_learning_rate
        self.normalize_values = normalize_values
        self.opponent_kwargs = {} if opponent_kwargs is None else opponent_kwargs
        self.update_threads = update_threads
        self.opponent: MAPPO | None = None  # the model of opponents that learn beside the team
        self._adversary_file: pathlib.Path | None = None  # where load() found it, not read yet
        # PPO's own constructor would only add checks on minibatches of rows, which are not ours.
        OnPolicyAlgorithm.__init__(
            self,
            policy,
            env,  # type: ignore[arg-type]
            learning_rate=learning_rate,
            n_steps=n_steps,
            gamma=gamma,
            gae_lambda=gae_lambda,
            ent_coef=ent_coef,
            vf_coef=vf_coef,
            max_grad_norm=max_grad_norm,
            use_sde=False,
            sde_sample_freq=-1,
            stats_window_size=checked("stats_window_size", stats_window_size),
            tensorboard_log=tensorboard_log,
            policy_kwargs=policy_kwargs,
            verbose=checked("verbose", verbose),
            device=checked("device", device),
            seed=seed,
            _init_setup_model=False,
            supported_action_spaces=(spaces.Box, spaces.Discrete, spaces.MultiDiscrete),
        )
        self.batch_size = batch_size
        self.n_epochs = n_epochs
        self.clip_range = clip_range  # type: ignore[assignment]  # until _setup_schedules()
        self.clip_range_vf = clip_range_vf  # type: ignore[assignment]
        self.normalize_advantage = normalize_advantage
        self.target_kl = target_kl
        self.agents, self.critic_state_dim = team_of(self.env)
        self._collector: Collector | None = None
        if _init_setup_model:
            self._setup_model()

    # ------------------------------------------------------------------ construction

    @staticmethod
    def _wrap_env(env: Any, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        if isinstance(env, (ParallelEnv, AECEnv)):
            world = env
            env = share_parameters(lambda: world, n_worlds=1)
        env = OnPolicyAlgorithm._wrap_env(env, verbose, monitor_wrapper)
        check_env(env)
        return monitored(env)

    @property
    def n_agents(self) -> int:
        """Number of agents N in a team."""
        return len(self.agents)

    def _setup_model(self) -> None:
        self.cost_limits = parse_cost_limits(self.cost_limits)  # load() may have replaced them
        check_cost_scope(self.cost_scope)
        self._check_setup()
        parties = n_parties(self.cost_scope, self.n_agents)
        sizes = {
            "n_agents": self.n_agents,
            "n_parties": parties,
            "n_constraints": len(self.cost_limits),
            "critic_state_dim": self.critic_state_dim,
        }
        self._setup_schedules()
        self.rollout_buffer_class = TeamRolloutBuffer
        self.rollout_buffer_kwargs = {
            **sizes,
            "cost_gamma": self.gamma if self.cost_gamma is None else self.cost_gamma,
        }
        user_kwargs = self.policy_kwargs
        self.policy_kwargs = {
            **user_kwargs,
            **sizes,
            "critic_lr_schedule": self.critic_lr_schedule,
        }
        with making(self, user_kwargs):
            OnPolicyAlgorithm._setup_model(self)
        self.policy_kwargs = user_kwargs
        shape = (parties, len(self.cost_limits))
        self.multipliers = self.multipliers_class(shape, **self.multipliers_kwargs).to(self.device)
        self._aims = party_limits((1 - self.cost_margin) * self.cost_limits, parties)
        self._attach_opponent()

    def _attach_opponent(self) -> None:
        """Let the opponents' model learn beside the team, if nobody was chosen to act for them."""
        env = opponent_env(self.env)
        if env is None or env.chosen:
            return
        if self.opponent is None:
            opponent = self.new_opponent(env)
            if self._adversary_file is not None:
                load_learner(opponent, self._adversary_file)
            self.opponent = opponent
        if env.opponent is not self.opponent:
            env.attach(self.opponent, learning=True)

    def new_opponent(self, env: OpponentVecEnv) -> "MAPPO":
        """An untrained model for the opponents: networks and settings of the team, but no limits.

        :param env: Where they act
        :return: A model with the team's arguments and ``opponent_kwargs``
        """
        own = self.opponent_arguments
        if not set(self.opponent_kwargs) <= own:
            raise ValueError(
                f"opponent_kwargs has {sorted(set(self.opponent_kwargs) - own)}; expected only "
                f"arguments in which opponents may differ from the team: {sorted(own)}"
            )
        kwargs = {name: getattr(self, name) for name in own - {"policy"}}
        kwargs = {"policy": self.policy_class, **kwargs, **self.opponent_kwargs}
        model = MAPPO(env=None, n_steps=self.n_steps, _init_setup_model=False, **kwargs)
        side = env.opponents
        model.observation_space, model.action_space = side.observation_space, side.action_space
        model.agents, model.n_envs = list(side.agents), env.n_worlds * len(side.agents)
        model._setup_model()
        return model

    def _setup_schedules(self) -> None:
        self.clip_range = FloatSchedule(self.clip_range)
        if self.clip_range_vf is not None:
            self.clip_range_vf = FloatSchedule(self.clip_range_vf)
        own = self.critic_learning_rate
        self.critic_lr_schedule: Schedule | None = None if own is None else FloatSchedule(own)

    def _check_setup(self) -> None:
        settle(self)
        check_batch(self.n_agents, self.batch_size)
        check_subclass("policy_class", self.policy_class, TeamPolicy)
        check_subclass("multipliers_class", self.multipliers_class, Multipliers)
        if self.env is not None:
            check_team(self.env, self.agents, self.critic_state_dim)
        elif not hasattr(self, "observation_space"):
            raise TypeError(
                "env is None; expected what share_parameters() returns, because it says how large "
                "the networks are; load() needs none"
            )
        check_spaces(self.observation_space, self.action_space)

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """Use another environment with the same team; see ``PPO.set_env``."""
        env = self._wrap_env(env, self.verbose)
        check_team(env, self.agents, self.critic_state_dim)
        super().set_env(env, force_reset)
        self._collector = None
        self._attach_opponent()

    def _setup_learn(self, total_timesteps: int, *args: Any, **kwargs: Any) -> Any:
        self.stop_epochs = None  # of a callback whose training was interrupted
        self._attach_opponent()
        last_obs = self._last_obs
        result = super()._setup_learn(total_timesteps, *args, **kwargs)
        if self._collector is None or self._last_obs is not last_obs:  # the environment was reset
            env = self.env
            assert env is not None
            assert self._last_obs is not None
            reset_infos = env.unwrapped.reset_infos
            team_cost = getattr(env, "team_cost", "sum")
            self.start_episodes(self._last_obs, reset_infos, team_cost)  # type: ignore[arg-type]
        if self.verbose >= 1:
            extra = f"and {self.critic_state_dim} numbers of info['critic_state']"
            print(f"Critics see the joint observation {extra if self.critic_state_dim else 'only'}")
        return result

    # ------------------------------------------------------------------ collecting

    def collect_rollouts(  # type: ignore[override]
        self,
        env: VecEnv,
        callback: BaseCallback,
        rollout_buffer: TeamRolloutBuffer,
        n_rollout_steps: int,
    ) -> bool:
        """Fill the rollout buffer with the current policy (Alg. 2 l. 3-8, 12).

        Keeps Stable-Baselines3's contract with callbacks, and states one more of it: ``rewards``
        in the locals is the array from which the learner learns; a callback may edit it in place
        in ``_on_step``. There are no ``values`` and ``log_probs`` in the locals: all networks but
        the actor are evaluated after the last step, in one batch.

        :param env: The training environment
        :param callback: Called at each step, and at the beginning and end of the rollout
        :param rollout_buffer: Buffer to fill
        :param n_rollout_steps: Steps of each world
        :return: False if a callback stopped the training
        """
        collector = self._collector
        assert collector is not None, "learn() makes it"
        collector.begin_rollout()
        opponents = opponent_env(env)
        learner = None if opponents is None else opponents.learner
        if learner is not None:
            learner.begin_rollout(n_rollout_steps)
        callback.on_rollout_start()
        for _ in range(n_rollout_steps):
            with self.explained_divergence():
                actions, clipped_actions = collector.act()
            new_obs, rewards, dones, infos = env.step(clipped_actions)
            assert isinstance(new_obs, np.ndarray)
            collector.check(new_obs, rewards, infos)
            rewards = self.reward_scale * rewards
            self.num_timesteps += env.num_envs
            callback.update_locals(locals())
            go_on = callback.on_step()
            self._update_info_buffer(infos, dones)
            collector.record(actions, rewards, new_obs, dones, infos, env.unwrapped.reset_infos)
            self._last_obs, self._last_episode_starts = new_obs, dones
            if not go_on:  # only now: a later learn() may continue the running episodes
                if learner is not None:
                    learner.stop_rollout()
                return False
        collector.finish_rollout()
        if learner is not None:
            learner.finish_rollout(self.logger)
        callback.update_locals(locals())
        callback.on_rollout_end()
        return True

    def start_episodes(
        self,
        observations: np.ndarray,
        reset_infos: Sequence[dict[str, Any]],
        team_cost: str = "sum",
    ) -> Collector:
        """Begin anew after a reset of all worlds.

        :param observations: Shape (S, D)
        :param reset_infos: One dict for each slot
        :param team_cost: How the costs of agents make the team's, "sum" or "max"
        :return: What acts and fills the rollout buffer from here on
        """
        recorder = TeamRecorder(
            self.agents,
            n_worlds=len(observations) // self.n_agents,
            n_constraints=len(self.cost_limits),
            cost_scope=self.cost_scope,
            team_cost=team_cost,
            critic_state_dim=self.critic_state_dim,
        )
        self._collector = Collector(
            self.policy, self.rollout_buffer, recorder, observations, reset_infos
        )
        return self._collector

    # ------------------------------------------------------------------ learning

    def train(self) -> None:
        """Update multipliers, policy and critics from the last rollout (Alg. 2 l. 11-16)."""
        self._train_opponent()
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        self._update_multipliers()  # l. 11
        samples = self.rollout_buffer.samples(
            self.policy, self.multipliers.values, self.normalize_values
        )
        with Descent(self.policy, update_threads(self.update_threads)) as descent:
            logs = self._train_epochs(samples, descent)
        self._check_learned()
        self._log_training(logs)

    def _train_epochs(self, samples: TeamSamples, descent: Descent) -> dict[str, list[float]]:
        """All passes over the rollout; returns the numbers to log, by name."""
        logs: dict[str, list[float]] = defaultdict(list)
        for epoch in range(self.n_epochs):
            logs["approx_kl"].clear()  # as in PPO, only the last epoch's
            within_kl = self._train_epoch(samples, descent, logs)
            self._n_updates += 1
            if not within_kl:
                if self.verbose >= 1:
                    print(f"Early stopping at epoch {epoch}: KL {logs['approx_kl'][-1]:.4f}")
                break
            if self.stop_epochs is not None and self.stop_epochs():
                break
        return logs

    def _train_opponent(self) -> None:
        env = opponent_env(self.env)
        if env is not None and env.learner is not None:
            env.learner.train(self._current_progress_remaining)

    def _train_epoch(
        self, samples: TeamSamples, descent: Descent, logs: dict[str, list[float]]
    ) -> bool:
        """One pass over the rollout (Alg. 2 l. 13-16).

        :return: False if the policy has moved further than ``target_kl`` allows
        """
        weights = self._weights()
        batches = self.rollout_buffer.minibatches(samples, self.batch_size // self.n_agents)
        for batch, sequences in batches:
            if self.normalize_advantage:
                batch = batch._replace(advantages=normalize(batch.advantages))
            with self.explained_divergence():
                terms = descent.gradient(batch, sequences, weights)
            loss = terms.loss(weights)
            for name, number in (*terms._asdict().items(), ("loss", loss)):
                logs[name].append(number)
            if self.target_kl is not None and terms.approx_kl > 1.5 * self.target_kl:
                return False
            self._gradient_step(descent, loss)
        return True

    def _weights(self) -> Weights:
        progress, clip_vf = self._current_progress_remaining, self.clip_range_vf
        return Weights(
            clip_range=self.clip_range(progress),
            clip_range_vf=None if clip_vf is None else clip_vf(progress),
            ent_coef=self.ent_coef,
            vf_coef=self.vf_coef,
        )

    def _gradient_step(self, descent: Descent, loss: float) -> None:
        """Follow the gradient that the parameters have."""
        if not math.isfinite(loss):
            raise self._divergence(f"the loss is {loss}")
        for norm in descent.clip(self.max_grad_norm):
            if not math.isfinite(norm):
                raise self._divergence(f"the size of the gradients is {norm}")
        self.policy.optimizer.step()

    def _check_learned(self) -> None:
        """Stop before parameters that are not finite act, or are saved."""
        learned = chain(self.policy.named_parameters(), self.policy.named_buffers())
        for name, tensor in learned:
            if not th.isfinite(tensor).all():
                raise ValueError(
                    f"{name} is not finite after {self.num_timesteps} agent steps; training stops, "
                    f"go on from a model that was saved before. {_ADVICE}"
                )

    def _divergence(self, found: str) -> ValueError:
        return ValueError(
            f"{found} after {self.num_timesteps} agent steps; training stops, the model keeps its "
            f"last finite parameters. {_ADVICE}"
        )

    @contextmanager
    def explained_divergence(self) -> Iterator[None]:
        """Say what it means when torch refuses the parameters of an action distribution."""
        try:
            yield
        except ValueError as error:
            raise ValueError(
                f"the networks have diverged after {self.num_timesteps} agent steps: the action "
                f"distribution is not valid any more. {_ADVICE}"
            ) from error

    def _update_multipliers(self) -> None:
        """One dual step from the episodes that finished in this rollout; none without episodes."""
        assert self._collector is not None, "learn() makes it"
        finished_costs = self._collector.finished_costs
        if finished_costs and len(self.cost_limits):
            excess = violation(np.array(finished_costs), self._aims)
            self.multipliers.update(th.as_tensor(excess, dtype=th.float32, device=self.device))
            if not th.isfinite(self.multipliers.values).all():
                raise ValueError(
                    f"the multipliers are {self.multipliers.values.tolist()} after costs of "
                    f"{np.mean(finished_costs, axis=0).tolist()}; training stops before it learns "
                    "from them. Scale the cost down, or limit them: multipliers_kwargs={'maximum'"
                    ": ...}"
                )

    def _update_learning_rate(self, optimizers: Any) -> None:
        super()._update_learning_rate(optimizers)
        if self.critic_lr_schedule is not None:
            rate = self.critic_lr_schedule(self._current_progress_remaining)
            self.policy.optimizer.param_groups[1]["lr"] = rate

    # ------------------------------------------------------------------ logging, saving

    def _log_training(self, logs: dict[str, list[float]]) -> None:
        if not len(self.cost_limits):
            del logs["cost_value_loss"]
        logs["loss"] = logs["loss"][-1:]
        for name, numbers in logs.items():
            self.logger.record(f"train/{name}", float(np.mean(numbers)))
        buffer = self.rollout_buffer
        explained = explained_variance(buffer.values.flatten(), buffer.returns.flatten())
        self.logger.record("train/explained_variance", explained)
        lambdas = named_costs(self.multipliers.values.mean(dim=0).tolist(), "lambda")
        for name, number in lambdas.items():
            self.logger.record(f"train/{name}", number)
        if hasattr(self.policy, "log_std"):
            self.logger.record("train/std", th.exp(self.policy.log_std).mean().item())
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        progress = self._current_progress_remaining
        self.logger.record("train/clip_range", self.clip_range(progress))
        if self.clip_range_vf is not None:
            self.logger.record("train/clip_range_vf", self.clip_range_vf(progress))

    def _update_info_buffer(
        self, infos: list[dict[str, Any]], dones: np.ndarray | None = None
    ) -> None:
        """Note one record for each world's episode, not for each agent's."""
        n = self.n_agents
        super()._update_info_buffer(infos[::n], None if dones is None else dones[::n])

    def dump_logs(self, iteration: int = 0) -> None:
        """Write the log; adds episode costs, their limits and the number of environment steps."""
        if iteration > 0:  # counted here, because a resumed run goes on counting
            done = self.num_timesteps - self._num_timesteps_at_start
            iteration = done // (self.n_steps * self.n_envs)
            if iteration % self._log_interval != 0:
                return
        assert self.ep_info_buffer is not None
        if self.ep_info_buffer:
            for key in [key for key in self.ep_info_buffer[0] if key.startswith("cost")]:
                mean = safe_mean([info[key] for info in self.ep_info_buffer])
                self.logger.record(f"rollout/ep_{key}_mean", mean)
        for name, limit in named_costs(self.cost_limits.tolist(), "cost_limit").items():
            self.logger.record(f"rollout/{name}", limit)  # beside the cost in a dashboard
        self.logger.record("time/env_steps", self.num_timesteps // self.n_agents)
        super().dump_logs(iteration)

    def learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 1,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> "MAPPO":
        """Train until that many agent steps are done; see ``PPO.learn``."""
        if self.env is None:
            raise ValueError("the model has no environment; give load() one, or call set_env()")
        name = tb_log_name or type(self).__name__
        self._log_interval = log_interval or 1
        every = None if log_interval is None else 1  # dump_logs() passes over the others
        return super().learn(
            total_timesteps,
            callback,
            every,
            name,
            reset_num_timesteps,
            progress_bar,
        )

    def _init_callback(self, callback: MaybeCallback, progress_bar: bool = False) -> BaseCallback:
        for evaluation in evaluations_in(callback):  # as the training's, see monitored()
            evaluation.eval_env = monitored(evaluation.eval_env)
        return super()._init_callback(callback, progress_bar)

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy", "policy.optimizer", "multipliers"], []

    def _excluded_save_params(self) -> list[str]:
        own = ("_collector", "stop_epochs", "opponent", "_adversary_file")
        return [*super()._excluded_save_params(), *own]

    def save(
        self,
        path: str | pathlib.Path | Any,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """Save everything that learns to a zip file, so that a crash never leaves half a file.

        The model that acts for opponents goes to a file beside it, "team.adversary.zip"; if random
        actions or a model of another kind act now, the one that has learned beside the team.

        :param path: Where to save; ".zip" is added if there is no suffix. Or an open file, which
            holds no adversary
        :param exclude: Names of parameters to leave out besides the default ones
        :param include: Names of parameters that the default would leave out
        """
        if not isinstance(path, (str, pathlib.Path)):
            super().save(path, exclude, include)
            return
        target = pathlib.Path(path)
        target = target if target.suffix else target.with_suffix(".zip")
        self._save_opponent(adversary_path(target))  # first: a team is never without it
        with atomic_write(target) as file:
            super().save(file, exclude, include)  # type: ignore[arg-type]

    def _save_opponent(self, path: pathlib.Path) -> None:
        """Save who acts for the opponents, else who has learned for them, if it is a model."""
        env, unread = opponent_env(self.env), self._adversary_file
        acting = None if env is None else env.opponent
        opponent = acting if isinstance(acting, MAPPO) else self.opponent
        if opponent is not None:
            opponent.save(path)
        elif unread is not None and unread.exists():
            content = unread.read_bytes()
            with atomic_write(path) as file:
                file.write(content)
        else:
            path.unlink(missing_ok=True)  # of another team, saved here before

    @classmethod
    def load(cls, path: str | pathlib.Path | Any, env: Any = None, **kwargs: Any) -> "MAPPO":  # type: ignore[override]
        """Load a model; see ``PPO.load``.

        In an :class:`sb3_e2c.OpponentVecEnv` for which nobody was chosen to act, the adversary
        that was saved beside the team goes on to learn beside it.

        :param path: What ``save`` was given
        :param env: Where to go on
        :param kwargs: Of ``PPO.load``
        :raises FileNotFoundError: If there is no adversary beside the model
        :raises ValueError: If other cost_limits or another cost_scope need other networks
        """
        try:
            model = super().load(path, env, **kwargs)
        except RuntimeError as error:
            changed = sorted({"cost_limits", "cost_scope"} & kwargs.keys())
            if not changed:
                raise
            raise ValueError(
                f"{' and '.join(changed)}: {path} has cost critics for other limits; expected as "
                "many limits as it was trained with, and its cost_scope. Make a new model instead, "
                "and give it the old actor: new.policy.load_state_dict(actor, strict=False), where "
                "actor is the part of old.policy.state_dict() whose names begin with "
                "mlp_extractor.policy_net, action_net, log_std or actor_gru"
            ) from error
        if hasattr(model, "oem_kwargs") and not hasattr(model, "_oem_callback"):
            raise ValueError(
                f"{path} holds a team that learns from an entropy bonus, which {cls.__name__} "
                "would leave out; load it with E2CMAPPO.load"
            )
        in_a_file = isinstance(path, (str, pathlib.Path))
        beside = adversary_path(path) if in_a_file else pathlib.Path("an open file")
        if model.opponent is not None:
            load_learner(model.opponent, beside)
        elif in_a_file:  # a later set_env() may need it
            model._adversary_file = beside
        return model
