"""Other libraries, ready to train on our tasks, for ``sb3-e2c speed``.

Nothing of theirs is contained here. Libraries must be installed; research repositories have no
packages, so that the user points at a checkout. Of a repository we call what its own training
loop calls, without its evaluation, its logging and its files.

Shapes: W worlds, N agents, D observation size, A action size.
"""

import contextlib
import importlib
import importlib.util
import io
import sys
import tempfile
from argparse import Namespace
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import supersuit as ss
import torch as th
from gymnasium import spaces
from pettingzoo import ParallelEnv
from pettingzoo.utils import BaseParallelWrapper
from sb3_contrib import RecurrentPPO
from stable_baselines3 import PPO
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from sb3_e2c.zoo.configuration import read_yaml
from sb3_e2c.zoo.console import UserError, brief

WIDTH = 128

# What to measure the share of: its name, the object, the name of its method
Hook = tuple[str, Any, str]


@dataclass(frozen=True)
class Plan:
    """What every contender trains on, and how much."""

    make_env: Callable[[], ParallelEnv]  # a world in which only the team acts
    episode: int  # steps
    policy: str  # "mlp" or "gru"
    rollout: int  # steps of each world
    n_worlds: int
    n_epochs: int
    n_minibatches: int
    n_agents: int

    @property
    def rows(self) -> int:
        """Agent steps of a rollout."""
        return self.rollout * self.n_worlds * self.n_agents

    @property
    def recurrent(self) -> bool:
        """Whether networks have a memory."""
        return self.policy == "gru"

    def sb3_settings(self) -> dict[str, Any]:
        """The plan in Stable-Baselines3's words."""
        return {
            "n_steps": self.rollout,
            "batch_size": self.rows // self.n_minibatches,
            "n_epochs": self.n_epochs,
            "device": "cpu",
        }


@dataclass
class Learner:
    """A library that has not trained yet.

    :param name: For the table
    :param iterate: One rollout and one update; returns the agent steps
    :param hooks: Methods whose share of the time is measured
    """

    name: str
    iterate: Callable[[], int]
    hooks: list[Hook]


# ------------------------------------------------------------------ installed libraries


def sb3_iteration(model: OnPolicyAlgorithm, callback: Any = None) -> Callable[[], int]:
    """One rollout and one update of an algorithm of Stable-Baselines3.

    :param model: The algorithm
    :param callback: See ``learn``
    """

    def iterate() -> int:
        before = model.num_timesteps
        model.learn(1, callback=callback, reset_num_timesteps=False, log_interval=10**9)
        return model.num_timesteps - before

    return iterate


def sb3(plan: Plan) -> Learner:
    """Stable-Baselines3's PPO, or sb3-contrib's RecurrentPPO, on slots as SuperSuit makes them.

    :param plan: What to train
    """
    rows = ss.pettingzoo_env_to_vec_env_v1(plan.make_env())
    env = ss.concat_vec_envs_v1(rows, plan.n_worlds, num_cpus=1, base_class="stable_baselines3")
    settings = plan.sb3_settings()
    model: OnPolicyAlgorithm
    if plan.recurrent:
        name = "sb3-contrib RecurrentPPO + SuperSuit"
        kwargs: dict[str, Any] = {"net_arch": [WIDTH], "lstm_hidden_size": WIDTH}
        model = RecurrentPPO("MlpLstmPolicy", env, policy_kwargs=kwargs, **settings)
    else:
        name = "SB3 PPO + SuperSuit"
        kwargs = {"net_arch": [WIDTH, WIDTH]}
        model = PPO("MlpPolicy", env, policy_kwargs=kwargs, **settings)
    hooks = [
        ("environment", model.env, "step"),
        ("inference", model.policy, "forward"),
        ("values", model.rollout_buffer, "compute_returns_and_advantage"),
        ("update", model, "train"),
    ]
    return Learner(name, sb3_iteration(model), hooks)


def is_installed(module: str) -> bool:
    """Whether a module could be imported."""
    return importlib.util.find_spec(module) is not None


def benchmarl(plan: Plan) -> Learner:
    """BenchMARL's MAPPO on TorchRL's wrapper of PettingZoo, one world after the other.

    :param plan: What to train
    :raises UserError: if it is not installed
    """
    if not is_installed("benchmarl"):
        raise UserError("--peer benchmarl: BenchMARL is not installed; pip install benchmarl")
    if plan.recurrent:
        raise UserError("--peer benchmarl: its adapter has MLPs only; choose --policy mlp")
    with _usable("benchmarl", "its installed version (the adapter was made for 1.5.2)"):
        from benchmarl.algorithms import MappoConfig
        from benchmarl.experiment import Experiment
        from benchmarl.models.mlp import MlpConfig
    network = MlpConfig(
        num_cells=[WIDTH, WIDTH], activation_class=th.nn.ReLU, layer_class=th.nn.Linear
    )
    folder = tempfile.TemporaryDirectory()  # lives as long as the experiment
    experiment = Experiment(
        task=_benchmarl_task(plan),
        algorithm_config=MappoConfig.get_from_yaml(),
        model_config=network,
        critic_model_config=network,
        seed=0,
        config=_benchmarl_config(plan, folder.name),
    )
    experiment.folder = folder
    experiment.close = lambda: None  # its loop does so when it has done what it was asked for
    experiment.collector = _OneIterator(experiment.collector)

    def iterate() -> int:
        experiment.config.max_n_iters = experiment.n_iters_performed + 1
        with contextlib.redirect_stderr(io.StringIO()):  # a progress bar
            experiment._collection_loop()
        return plan.rows

    hooks = [
        ("environment and inference", experiment.collector, "collect"),
        ("update", experiment, "_optimizer_loop"),
    ]
    return Learner("BenchMARL MAPPO", iterate, hooks)


def _benchmarl_config(plan: Plan, folder: str) -> Any:
    from benchmarl.experiment import ExperimentConfig

    config = ExperimentConfig.get_from_yaml()
    frames = plan.rollout * plan.n_worlds  # of whole teams
    config.on_policy_collected_frames_per_batch = frames
    config.on_policy_n_envs_per_worker = plan.n_worlds
    config.on_policy_n_minibatch_iters = plan.n_epochs
    config.on_policy_minibatch_size = frames // plan.n_minibatches
    config.max_n_frames, config.max_n_iters = None, 10**6
    config.evaluation = config.render = config.create_json = False
    config.loggers, config.save_folder = [], folder
    return config


def _benchmarl_task(plan: Plan) -> Any:
    from benchmarl.environments.pettingzoo.common import PettingZooClass
    from torchrl.envs.libs.pettingzoo import PettingZooWrapper

    env = plan.make_env()
    continuous = isinstance(env.action_space(env.possible_agents[0]), spaces.Box)
    team = {"team": list(env.possible_agents)}

    class Task(PettingZooClass):
        """A world of ours in the place of one that TorchRL knows by name."""

        def get_env_fun(self, num_envs: int, continuous_actions: bool, seed: Any, device: Any):  # noqa: ARG002
            return lambda: PettingZooWrapper(
                env=_WithoutInfos(plan.make_env()),
                group_map=team,
                categorical_actions=True,
                device=device,
                seed=seed,
                return_state=False,
            )

        def supports_continuous_actions(self) -> bool:
            return continuous

        def supports_discrete_actions(self) -> bool:
            return not continuous

        def has_state(self) -> bool:
            return False

        def __reduce__(self) -> tuple[type, tuple[str]]:
            return str, (self.name,)  # written to a file that nobody reads

    return Task("ours", {"max_cycles": plan.episode})


class _WithoutInfos(BaseParallelWrapper):
    """TorchRL wants the infos of steps to be alike those of resets; it would not use ours."""

    def reset(
        self, seed: int | None = None, options: dict | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Reset."""
        observations, _ = self.env.reset(seed=seed, options=options)
        return observations, {agent: {} for agent in observations}

    def step(self, actions: dict[str, Any]) -> tuple[dict, dict, dict, dict, dict]:
        """Step."""
        observations, rewards, terminated, truncated, _ = self.env.step(actions)
        return observations, rewards, terminated, truncated, {agent: {} for agent in observations}


class _OneIterator:
    """A collector that goes on where it was when its caller begins another loop over it."""

    def __init__(self, collector: Any):
        self._collector, self._iterator = collector, iter(collector)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._collector, name)

    def __iter__(self) -> "_OneIterator":
        return self

    def __next__(self) -> Any:
        return self.collect()

    def collect(self) -> Any:
        """The next rollout."""
        return next(self._iterator)


# ------------------------------------------------------------------ research repositories

_COMMITS = {"on-policy": "de66d7a", "mappo-l": "b80a9f5", "safepo": "8d0fa76"}


def on_policy(plan: Plan, checkout: Path) -> Learner:
    """MAPPO, or R-MAPPO, of github.com/marlbenchmark/on-policy (Yu et al. 2022).

    :param plan: What to train
    :param checkout: The repository
    """
    with _repository("on-policy", checkout, ("wandb", "imageio", "tensorboardX")):
        config = importlib.import_module("onpolicy.config")
        vectors = importlib.import_module("onpolicy.envs.env_wrappers")
        theirs = importlib.import_module("onpolicy.runner.shared.mpe_runner").MPERunner
        algorithm = "rmappo" if plan.recurrent else "mappo"
        args = _research_args(config.get_config(), plan, algorithm_name=algorithm)
        envs = vectors.DummyVecEnv([lambda: _SharedWorld(plan.make_env())] * plan.n_worlds)
        runner = _raw_actions(theirs)(_research_config(args, envs, plan.n_agents))
    name = f"on-policy {'R-MAPPO' if plan.recurrent else 'MAPPO'}"
    return _research_learner(name, runner, plan, lambda chosen, answers: (*answers[:4], *chosen))


def mappo_l(plan: Plan, checkout: Path) -> Learner:
    """MAPPO-Lagrangian of github.com/chauncygu/Multi-Agent-Constrained-Policy-Optimisation.

    :param plan: What to train
    :param checkout: The repository
    """
    inner = checkout / "MAPPO-Lagrangian"
    inner = inner if inner.is_dir() else checkout
    with _repository("mappo-l", inner, ("wandb", "imageio", "tensorboardX")):
        config = importlib.import_module("mappo_lagrangian.config")
        vectors = importlib.import_module("mappo_lagrangian.envs.env_wrappers")
        folder = "mappo_lagrangian.runner.separated"
        theirs = importlib.import_module(f"{folder}.mujoco_runner_mappo_lagr").MujocoRunner
        args = _research_args(config.get_config(), plan, algorithm_name="mappo_lagr")
        envs = vectors.ShareDummyVecEnv([lambda: _CostWorld(plan.make_env())] * plan.n_worlds)
        runner = theirs(_research_config(args, envs, plan.n_agents))
    name = f"MAPPO-L ({plan.policy})"
    return _research_learner(name, runner, plan, lambda chosen, answers: (*answers[:6], *chosen))


def safepo(plan: Plan, checkout: Path) -> Learner:
    """MAPPO-Lagrangian of github.com/PKU-Alignment/Safe-Policy-Optimization.

    :param plan: What to train
    :param checkout: The repository
    """
    world = _TensorWorld(plan.make_env())
    if plan.recurrent or not isinstance(world.action_space[0], spaces.Box):
        raise UserError(
            "--peer safepo: its MAPPO-L has MLPs and continuous actions only; choose --policy mlp "
            "--env rover"
        )
    absent = ("safepo.common.env", "safepo.common.logger", "safety_gymnasium", "isaacgym")
    with _repository("safepo", checkout, (*absent, "gymnasium.wrappers.normalize")):
        theirs = importlib.import_module("safepo.multi_agent.mappolag").Runner
        vectors = importlib.import_module("safepo.common.wrappers")
        with tempfile.TemporaryDirectory() as folder:  # for models, which are never saved
            config = _safepo_config(plan, checkout, folder)
            envs = vectors.ShareDummyVecEnv([lambda: _TensorWorld(plan.make_env())] * plan.n_worlds)
            runner = theirs(envs, None, config)
    th.autograd.set_detect_anomaly(False)  # its runner has changed that for everybody
    no_cost = th.zeros(())
    learner = _research_learner(
        "SafePO MAPPO-L",
        runner,
        plan,
        lambda chosen, answers: (*answers[:6], *chosen, no_cost),
    )
    iterate = learner.iterate

    def as_shipped() -> int:
        with th.autograd.set_detect_anomaly(True, check_nan=True):
            return iterate()

    learner.iterate = as_shipped
    return learner


def _safepo_config(plan: Plan, checkout: Path, folder: str) -> dict[str, Any]:
    file = checkout / "safepo" / "multi_agent" / "marl_cfg" / "mappolag" / "config.yaml"
    config = read_yaml(file)
    config |= config.pop("mamujoco")
    return config | {
        "episode_length": plan.rollout,
        "n_rollout_threads": plan.n_worlds,
        "learning_iters": plan.n_epochs,
        "num_mini_batch": plan.n_minibatches,
        "hidden_size": WIDTH,
        "layer_N": 1,
        "log_dir": folder,
        "device": "cpu",
    }


def _research_learner(
    name: str, runner: Any, plan: Plan, join: Callable[[Any, Any], tuple[Any, ...]]
) -> Learner:
    """The training loop that these repositories have in common.

    :param name: For the table
    :param runner: Of the repository
    :param plan: What to train
    :param join: What the networks chose, and what the worlds answered, to what is stored
    """
    runner.warmup()

    def iterate() -> int:
        for step in range(plan.rollout):
            chosen = runner.collect(step)
            answers = runner.envs.step(chosen[1])
            runner.insert(join(chosen, answers))
        runner.compute()
        runner.train()
        return plan.rows

    hooks = [
        ("environment", runner.envs, "step"),
        ("inference", runner, "collect"),
        ("values", runner, "compute"),
        ("update", runner, "train"),
    ]
    return Learner(name, iterate, hooks)


def _research_args(parser: Any, plan: Plan, algorithm_name: str) -> Namespace:
    """Settings of on-policy and its descendants; all others stay as shipped.

    Their networks are an MLP, then a GRU if they are recurrent, as ours.
    """
    args = parser.parse_args([])
    args.algorithm_name, args.env_name = algorithm_name, "MPE"
    args.episode_length, args.n_rollout_threads = plan.rollout, plan.n_worlds
    args.ppo_epoch, args.num_mini_batch = plan.n_epochs, plan.n_minibatches
    args.use_recurrent_policy, args.use_naive_recurrent_policy = plan.recurrent, False
    args.data_chunk_length = plan.episode  # whole episodes, as ours
    args.hidden_size, args.layer_N = WIDTH, 0 if plan.recurrent else 1
    args.use_wandb = args.use_eval = args.use_render = args.use_single_network = False
    return args


def _research_config(args: Namespace, envs: Any, n_agents: int) -> dict[str, Any]:
    return {
        "all_args": args,
        "envs": envs,
        "eval_envs": None,
        "num_agents": n_agents,
        "device": th.device("cpu"),
        "run_dir": _NoFolder(),
    }


class _NoFolder:
    """A folder that exists, in which nothing will be written."""

    def __truediv__(self, name: str) -> str:
        return tempfile.gettempdir()


def _raw_actions(runner_class: type) -> type:
    """on-policy's runner, without its translation of discrete actions to one-hot vectors.

    :param runner_class: Which knows no continuous actions
    """

    class Runner(runner_class):
        """Hands actions on as the networks chose them, shape (W, N, A)."""

        @th.no_grad()
        def collect(self, step: int) -> list[np.ndarray]:
            """Act on the observations of a step."""
            self.trainer.prep_rollout()
            names = ("share_obs", "obs", "rnn_states", "rnn_states_critic", "masks")
            inputs = (np.concatenate(getattr(self.buffer, name)[step]) for name in names)
            outputs = self.trainer.policy.get_actions(*inputs)
            return [np.array(np.split(each.numpy(), self.n_rollout_threads)) for each in outputs]

    return Runner


class _World:
    """A PettingZoo world whose agents are numbers.

    :param env: The world
    """

    def __init__(self, env: ParallelEnv):
        self.env, self.agents = env, list(env.possible_agents)
        self.num_agents = len(self.agents)
        self.observation_space = [env.observation_space(agent) for agent in self.agents]
        self.action_space = [env.action_space(agent) for agent in self.agents]
        joint = sum(spaces.flatdim(space) for space in self.observation_space)
        self.share_observation_space = [spaces.Box(-np.inf, np.inf, (joint,))] * self.num_agents

    def begin(self) -> np.ndarray:
        """Reset; returns the observations, shape (N, D)."""
        return self._rows(self.env.reset()[0])

    def play(self, actions: Any) -> tuple[np.ndarray, ...]:
        """Step.

        :param actions: Shape (N, A)
        :return: Observations (N, D), rewards (N, 1), costs (N, 1), dones (N,), infos (N,)
        """
        chosen = map(_action, self.action_space, np.asarray(actions))
        observations, rewards, terminated, truncated, infos = self.env.step(
            dict(zip(self.agents, chosen, strict=True))
        )
        costs = {agent: info.get("cost", 0.0) for agent, info in infos.items()}
        dones = [terminated[agent] or truncated[agent] for agent in self.agents]
        return (
            self._rows(observations),
            self._rows(rewards)[:, None],
            self._rows(costs)[:, None],
            np.array(dones),
            np.array([infos[agent] for agent in self.agents]),
        )

    def _rows(self, by_agent: dict[str, Any]) -> np.ndarray:
        return np.array([by_agent[agent] for agent in self.agents], np.float32)

    def joint(self, observations: np.ndarray) -> np.ndarray:
        """The joint observation for each agent, shape (N, N·D)."""
        return np.tile(observations.ravel(), (self.num_agents, 1))

    def close(self) -> None:
        """Close the world."""
        self.env.close()


def _action(space: spaces.Space, action: np.ndarray) -> Any:
    if isinstance(space, spaces.Box):
        return np.clip(action, space.low, space.high)
    return int(action[0])


class _SharedWorld(_World):
    """A world as on-policy's vectors want it."""

    def reset(self) -> np.ndarray:
        """See :meth:`begin`."""
        return self.begin()

    def step(self, actions: Any) -> tuple[np.ndarray, ...]:
        """See :meth:`play`; no costs."""
        observations, rewards, _, dones, infos = self.play(actions)
        return observations, rewards, dones, infos


class _CostWorld(_World):
    """A world as MAPPO-L's vectors want it."""

    def reset(self) -> tuple[np.ndarray, ...]:
        """Observations, joint observations, and that all actions are allowed."""
        observations = self.begin()
        return observations, self.joint(observations), np.ones((self.num_agents, 1))

    def step(self, actions: Any) -> tuple[np.ndarray, ...]:
        """See :meth:`play` and :meth:`reset`."""
        observations, *others = self.play(actions)
        return observations, self.joint(observations), *others, np.ones((self.num_agents, 1))


class _TensorWorld(_CostWorld):
    """A world as SafePO's vectors want it."""

    def __init__(self, env: ParallelEnv):
        super().__init__(env)
        self.observation_spaces = self._by_agent(self.observation_space)
        self.share_observation_spaces = self._by_agent(self.share_observation_space)
        self.action_spaces = self._by_agent(self.action_space)

    def _by_agent(self, each: Sequence[Any]) -> dict[str, Any]:
        return dict(zip(self.agents, each, strict=True))


# ------------------------------------------------------------------ importing what is not ours


@contextlib.contextmanager
def _usable(name: str, where: str) -> Iterator[None]:
    """Say in one line what is missing, or has changed."""
    try:
        yield
    except (ImportError, AttributeError, TypeError) as error:
        raise UserError(f"--peer {name}: {where} cannot be used: {brief(error)}") from error


@contextlib.contextmanager
def _repository(name: str, checkout: Path, unneeded: Sequence[str]) -> Iterator[None]:
    """Import from a checkout, without the packages that only its logs and pictures need.

    :param name: As in ``--peer``
    :param checkout: The repository
    :param unneeded: Modules that it imports, but that training does not use
    """
    if not checkout.is_dir():
        raise UserError(f"--peer {name}: {checkout} is no folder; expected a checkout")
    finder = _StandIns(unneeded)
    sys.meta_path.insert(0, finder)
    sys.path.insert(0, str(checkout))
    try:
        where = f"{checkout} (the adapter was made for commit {_COMMITS[name]})"
        with _usable(name, where), contextlib.redirect_stdout(io.StringIO()):
            yield
    finally:
        sys.path.remove(str(checkout))
        sys.meta_path.remove(finder)
        finder.forget()


class _Anything:
    """Stands in for a class; does nothing, whatever it is asked."""

    def __init__(self, *_: Any, **__: Any):
        pass

    def __getattr__(self, name: str) -> Callable[..., None]:
        return lambda *_, **__: None


class _StandIn(ModuleType):
    """A module in which every name is :class:`_Anything`."""

    def __getattr__(self, name: str) -> type[_Anything]:
        if name.startswith("__"):
            raise AttributeError(name)
        return _Anything


class _StandIns(MetaPathFinder, Loader):
    """Answers imports of some modules with empty ones.

    :param names: The modules, with all that is inside of them
    """

    def __init__(self, names: Sequence[str]):
        self.names = tuple(names)
        self._hidden = {name: sys.modules.pop(name) for name in list(sys.modules) if self._is(name)}

    def _is(self, module: str) -> bool:
        return any(f"{module}.".startswith(f"{name}.") for name in self.names)

    def find_spec(self, name: str, path: Any, target: Any = None) -> ModuleSpec | None:  # noqa: ARG002
        """Answer for our modules."""
        return ModuleSpec(name, self, is_package=True) if self._is(name) else None

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        """An empty module."""
        return _StandIn(spec.name)

    def exec_module(self, module: ModuleType) -> None:
        """Nothing happens."""

    def forget(self) -> None:
        """Leave no trace for those who import the real ones."""
        for name in list(sys.modules):
            if self._is(name):
                del sys.modules[name]
        sys.modules.update(self._hidden)


INSTALLED: dict[str, Callable[[Plan], Learner]] = {"benchmarl": benchmarl}
REPOSITORIES: dict[str, Callable[[Plan, Path], Learner]] = {
    "on-policy": on_policy,
    "mappo-l": mappo_l,
    "safepo": safepo,
}
