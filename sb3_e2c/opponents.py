"""Who acts for the opponents of a team: nobody in particular, a trained model, or one that learns.

Shapes: W worlds, n opponents in each, S = W·n slots, D observation size.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from gymnasium.vector.utils import batch_space
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.type_aliases import PolicyPredictor
from typing_extensions import override

from sb3_e2c.checks import check_finite
from sb3_e2c.sides import Side, Sides
from sb3_e2c.worlds import Infos, Step, Worlds, close_episodes

Opponent = PolicyPredictor | Literal["random"]

LOG_PREFIX = "adversary"


def adversary_path(path: str | Path) -> Path:
    """Where the opponents' model lies beside a team's: ``team.zip``, ``team.adversary.zip``.

    :param path: The team's model, with or without ".zip"
    """
    path = Path(path)
    stem = path.with_suffix("") if path.suffix == ".zip" else path
    return stem.with_name(f"{stem.name}.adversary.zip")


def check_fits(model: Any, side: Side) -> None:
    """Refuse a model that was made for other spaces.

    :param model: Shall act for the opponents
    :param side: The opponents
    """
    for name in ("observation_space", "action_space"):
        found, expected = getattr(model, name, None), getattr(side, name)
        if found is not None and found != expected:
            raise ValueError(
                f"the {name} of the opponents' model is {found}, but the opponents "
                f"{side.agents} have {expected}; use a model that was trained as their adversary"
            )


def check_learns(model: Any, side: Side, n_worlds: int) -> None:
    """Refuse a model that cannot learn from the steps of these opponents.

    :param model: Shall learn beside the team
    :param side: The opponents
    :param n_worlds: W
    """
    check_fits(model, side)
    expected = (side.agents, n_worlds * len(side.agents))
    if not hasattr(model, "start_episodes"):
        raise TypeError(
            f"a model of type {type(model).__name__} cannot learn beside the team; expected what "
            "MAPPO.new_opponent(env) returns. With learning=False it acts as it is"
        )
    if (model.agents, model.n_envs) != expected:
        raise ValueError(
            f"the opponents' model learns from {model.n_envs} slots of {model.agents}, but here "
            f"are {expected[1]} of {expected[0]}; make one with MAPPO.new_opponent(env)"
        )


def load_learner(model: Any, path: Path) -> None:
    """Go on with an adversary that was saved beside a team.

    :param model: Made by ``MAPPO.new_opponent``
    :param path: See :func:`adversary_path`
    :raises FileNotFoundError: if there is no such file
    """
    if not path.exists():
        raise FileNotFoundError(
            f"there is no adversary beside the team: {path}. Without it the task is another one; "
            "choose who acts before loading: env.set_opponent(model), or "
            "env.set_opponent('random')"
        )
    data, weights, _ = load_from_zip_file(path, device=model.device)
    model.set_parameters(weights, device=model.device)
    assert data is not None
    model._n_updates, model.num_timesteps = data["_n_updates"], data["num_timesteps"]


class Opponents(ABC):
    """Acts in all opponents' slots.

    :param side: The opponents
    :param n_worlds: W
    """

    def __init__(self, side: Side, n_worlds: int):
        self.side, self.n_worlds = side, n_worlds

    @abstractmethod
    def start(self, observations: np.ndarray, seed: int | None) -> None:
        """Begin anew after a reset of all worlds.

        :param observations: Shape (S, D)
        :param seed: The first world's
        """

    @abstractmethod
    def act(self) -> np.ndarray:
        """Choose actions on the last observations, shape (S, ...)."""

    @abstractmethod
    def observe(self, step: Step) -> None:
        """Take note of what came of them."""


class RandomOpponents(Opponents):
    """Uniformly random actions; the first world's seed decides which."""

    def __init__(self, side: Side, n_worlds: int):
        super().__init__(side, n_worlds)
        self._actions = batch_space(side.action_space, n_worlds * len(side.agents))

    @override
    def start(self, observations: np.ndarray, seed: int | None) -> None:
        if seed is not None:  # a stream of its own: the first world draws from that of the seed
            stream = np.random.SeedSequence(seed, spawn_key=(1,))
            self._actions.seed(int(stream.generate_state(1)[0]))

    @override
    def act(self) -> np.ndarray:
        return self._actions.sample()

    @override
    def observe(self, step: Step) -> None:
        pass


class TrainedOpponents(Opponents):
    """A model that does not learn any more.

    :param model: Anything with Stable-Baselines3's ``predict``
    :param deterministic: Whether it takes the most likely actions
    """

    def __init__(self, side: Side, n_worlds: int, model: PolicyPredictor, deterministic: bool):
        super().__init__(side, n_worlds)
        self.model, self.deterministic = model, deterministic

    @override
    def start(self, observations: np.ndarray, seed: int | None) -> None:
        check_finite(self.side.agents, "after a reset", observation=observations)
        self._observations = observations
        self._state: tuple[np.ndarray, ...] | None = None
        self._starts = np.ones(len(observations), bool)

    @override
    def act(self) -> np.ndarray:
        actions, self._state = self.model.predict(
            self._observations, self._state, self._starts, self.deterministic
        )
        return actions

    @override
    def observe(self, step: Step) -> None:
        check_finite(self.side.agents, "after a step", observation=step.observations)
        self._observations, self._starts = step.observations, step.terminated | step.truncated


class LearningOpponents(Opponents):
    """A model that learns from the same steps as the team, at the end of the team's rollouts.

    :param model: Made by ``MAPPO.new_opponent``
    """

    def __init__(self, side: Side, n_worlds: int, model: Any):
        super().__init__(side, n_worlds)
        self.model = model
        self._collecting = False

    @override
    def start(self, observations: np.ndarray, seed: int | None) -> None:
        self.collector = self.model.start_episodes(observations, [{}] * len(observations))
        self._returns = np.zeros(self.n_worlds)
        self._finished: list[float] = []

    def begin_rollout(self, n_steps: int) -> None:
        """Collect from here on.

        :param n_steps: Of each world, T
        """
        if n_steps != self.model.n_steps:
            raise ValueError(
                f"the opponents' model has n_steps={self.model.n_steps} and the team {n_steps}; "
                "expected equal ones, because both learn from the same rollouts"
            )
        self.collector.begin_rollout()
        self._collecting = True
        self._finished.clear()

    @override
    def act(self) -> np.ndarray:
        with self.model.explained_divergence():
            self._actions, clipped = self.collector.act()
        return clipped

    @override
    def observe(self, step: Step) -> None:
        dones = close_episodes(step)
        self._count(step.rewards, dones)
        model, observations = self.model, step.observations
        if not self._collecting:  # somebody evaluates, or trains by an algorithm of their own
            check_finite(self.side.agents, "after a step", observation=observations)
            self.collector.follow(observations, dones)
            return
        model.num_timesteps += len(dones)
        rewards = model.reward_scale * step.rewards
        self.collector.check(observations, rewards, infos=())
        self.collector.record(self._actions, rewards, observations, dones, step.infos, step.infos)
        self._collecting = not model.rollout_buffer.full

    def _count(self, rewards: np.ndarray, dones: np.ndarray) -> None:
        """Sum up the rewards of all opponents of a world."""
        self._returns += rewards.reshape(self.n_worlds, -1).sum(axis=1)
        ended = dones[:: len(self.side.agents)]
        self._finished.extend(self._returns[ended])
        self._returns[ended] = 0.0

    def stop_rollout(self) -> None:
        """Collect no more: what has been collected is given up."""
        self._collecting = False

    def finish_rollout(self, logger: Logger) -> None:
        """Compute the advantages of a whole rollout.

        :param logger: The team's; our keys get a prefix
        """
        self.model.set_logger(_PrefixLogger(logger))
        self.collector.finish_rollout()
        if self._finished:
            self.model.logger.record("rollout/ep_rew_mean", float(np.mean(self._finished)))

    def train(self, progress_remaining: float) -> None:
        """Update the model from the rollout.

        :param progress_remaining: Of the team's training, from 1 to 0
        """
        self.model._current_progress_remaining = progress_remaining
        self.model.train()


class _PrefixLogger(Logger):
    """Writes to another logger, under keys of its own."""

    def __init__(self, logger: Logger):
        super().__init__(folder=None, output_formats=[])
        self._logger = logger

    @override
    def record(self, key: str, value: Any, exclude: str | tuple[str, ...] | None = None) -> None:
        self._logger.record(f"{LOG_PREFIX}/{key}", value, exclude)

    def __reduce__(self) -> tuple[type[Logger], tuple[None, list[Any]]]:
        return Logger, (None, [])  # the team's has open files, which worlds that pickle must not


class OpponentWorlds(Worlds):
    """The team's slots of worlds in which opponents act, too.

    :param sides: The worlds
    """

    def __init__(self, sides: Sides):
        self.sides = sides
        self.n_worlds, self.agents = sides.n_worlds, sides.team.agents
        self.observation_space = sides.team.observation_space
        self.action_space = sides.team.action_space
        self.render_mode = sides.source.render_mode
        self.metadata = sides.source.metadata
        self.shared_owner = sides.shared_owner
        self.opponents: Opponents | None = None
        self._observations: np.ndarray | None = None  # the opponents' last ones
        self._seed: int | None = None  # the first world's last one

    @property
    def failed(self) -> bool:  # type: ignore[override]
        """Whether a worker process died."""
        return self.sides.failed

    def let_act(self, opponents: Opponents) -> None:
        """Let others act for the opponents, in running episodes, too, as if these began here.

        :param opponents: Who acts
        """
        self.opponents = opponents
        if self._observations is not None:
            opponents.start(self._observations, self._seed)

    @override
    def reset(self, seeds: Sequence[int | None], options: Infos) -> tuple[np.ndarray, Infos]:
        team, (self._observations, _) = self.sides.reset(seeds, options)
        self._seed = self._seed if seeds[0] is None else seeds[0]
        if self.opponents is not None:
            self.opponents.start(self._observations, seeds[0])
        return team

    @override
    def step_async(self, actions: np.ndarray) -> None:
        if self.opponents is None:
            raise RuntimeError(
                f"nobody acts for the opponents {self.sides.opponents.agents}; expected a choice "
                "before the first step: env.set_opponent(model), or env.set_opponent('random')"
            )
        self.sides.step_async(actions, self.opponents.act())

    @override
    def step_wait(self) -> Step:
        team, opponents = self.sides.step_wait()
        assert self.opponents is not None, "step_async() checks it"
        self.opponents.observe(opponents)
        self._observations = opponents.observations
        return team

    @override
    def images(self) -> list[Any]:
        return self.sides.images()

    @override
    def owner(self, world: int) -> Any:
        return self.sides.owner(world)

    @override
    def close(self) -> None:
        self.sides.close()
