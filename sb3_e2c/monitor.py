"""Statistics of whole teams: one record for each world's episode, not one for each agent's."""

import os
import time
from typing import Any

import numpy as np
from stable_baselines3.common.monitor import Monitor, ResultsWriter
from stable_baselines3.common.vec_env import (
    VecEnv,
    VecMonitor,
    is_vecenv_wrapped,
    unwrap_vec_normalize,
)
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from sb3_e2c.constraints import read_costs, team_costs
from sb3_e2c.vec_env import MultiAgentVecEnv


class TeamMonitor(VecMonitor):
    """``VecMonitor`` for teams: return, length and cost of every world's episode.

    When a world's episode ends, the infos of its slots get
    ``info["episode"] = {"r": team return, "l": steps, "t": seconds, "cost": team cost}``, with
    ``cost_0, cost_1, ...`` if there are several costs and no cost where none is reported. What
    the team's return and cost are is said by ``env.team_return`` and ``env.team_cost``.

    :param venv: made by ``share_parameters``, perhaps wrapped; rewards that a ``VecNormalize``
        below has scaled are counted unscaled
    :param filename: csv file with one row for each record, begun at the first one
    :param info_keywords: further keys of the first slot's last info to record
    :param override_existing: whether to begin the file anew, or to append to what it holds
    """

    episode_costs: np.ndarray | None  # shape (W, M), None before the first infos tell M

    def __init__(
        self,
        venv: VecEnv,
        filename: str | None = None,
        info_keywords: tuple[str, ...] = (),
        override_existing: bool = True,
    ):
        self._team = unwrap_team(venv, "TeamMonitor")
        # The columns depend on the number of costs, which the first infos tell.
        super().__init__(venv, None, info_keywords)
        self._filename = None if filename is None else _csv_path(filename)
        self._override_existing = override_existing
        self._start_episodes()

    def reset(self) -> VecEnvObs:
        """Reset the worlds and forget their unfinished episodes."""
        self._start_episodes()
        return self.venv.reset()

    def step_wait(self) -> VecEnvStepReturn:
        """Finish the step and add the records of the episodes that ended with it."""
        observations, rewards, dones, infos = self.venv.step_wait()
        costs = team_costs(read_costs(infos, self._team.agents), self._team.team_cost)
        self.episode_returns += team_rewards(raw_rewards(self.venv, rewards), self._team)
        self.episode_lengths += 1
        self.episode_costs = add_costs(self.episode_costs, costs)
        n_agents = self._team.n_agents
        for world in np.flatnonzero(dones[::n_agents]).tolist():
            record = self._finish(world, infos[world * n_agents])
            # in every slot: SB3's evaluate_policy waits for one from each row
            for info in infos[world * n_agents : (world + 1) * n_agents]:
                info["episode"] = record
        return observations, rewards, dones, infos

    def _start_episodes(self) -> None:
        self.episode_returns = np.zeros(self._team.n_worlds)  # type: ignore[assignment]  # float64
        self.episode_lengths = np.zeros(self._team.n_worlds, dtype=np.int32)
        self.episode_costs = None

    def _finish(self, world: int, info: dict[str, Any]) -> dict[str, float]:
        """Record of a world's episode; begins the next one."""
        assert self.episode_costs is not None
        record = {
            "r": float(self.episode_returns[world]),
            "l": int(self.episode_lengths[world]),
            "t": round(time.time() - self.t_start, 6),
            **named_costs(self.episode_costs[world].tolist()),
            **{key: info[key] for key in self.info_keywords},
        }
        self._write(record)
        self.episode_count += 1
        for sums in (self.episode_returns, self.episode_lengths, self.episode_costs):
            sums[world] = 0
        return record

    def _write(self, record: dict[str, float]) -> None:
        if self._filename is not None and self.results_writer is None:
            name = str(self._team.metadata.get("name"))
            header: dict[str, float | str] = {"t_start": self.t_start, "env_id": name}
            anew = self._override_existing or not os.path.exists(self._filename)
            self.results_writer = ResultsWriter(
                self._filename,
                header=header,
                extra_keys=tuple(record)[3:],
                override_existing=anew,
            )
        if self.results_writer is not None:
            self.results_writer.write_row(record)


def monitored(env: VecEnv) -> VecEnv:
    """Add a monitor to an environment of teams that has none.

    It comes below all wrappers, so that environments that were wrapped alike stay alike; wrappers
    get it as their new ``venv``. Only above Stable-Baselines3's own monitor, which would replace
    its records.

    :param env: Perhaps wrapped
    :return: The environment, with a monitor if it consists of teams
    """
    team = env.unwrapped
    if not isinstance(team, MultiAgentVecEnv) or is_vecenv_wrapped(env, TeamMonitor):
        return env
    if env is team or is_vecenv_wrapped(env, VecMonitor):
        return TeamMonitor(env)
    monitor = TeamMonitor(team)
    lowest: Any = env
    while lowest.venv is not team:
        lowest = lowest.venv
    lowest.venv = monitor
    return env


def _csv_path(filename: str) -> str:
    """The file that SB3's ``ResultsWriter`` makes of a name."""
    if filename.endswith(Monitor.EXT):
        return filename
    return (
        os.path.join(filename, Monitor.EXT)
        if os.path.isdir(filename)
        else f"{filename}.{Monitor.EXT}"
    )


def unwrap_team(env: Any, user: str) -> MultiAgentVecEnv:
    """The environment below all wrappers, if it knows its teams.

    :param env: given by the user
    :param user: who needs it, for the error message
    :return: a ``MultiAgentVecEnv``, or another ``VecEnv`` with the same attributes
    :raises TypeError: if the environment does not know its teams
    """
    flat = env.unwrapped if isinstance(env, VecEnv) else env
    names = ("n_worlds", "n_agents", "agents", "team_return", "team_cost")
    if not isinstance(flat, VecEnv) or not all(hasattr(flat, name) for name in names):
        raise TypeError(
            f"{user} was given an environment of type {type(flat).__name__}, which does not say "
            "which slots form a team; expected one made by share_parameters(make_env), perhaps "
            "wrapped"
        )
    return flat  # type: ignore[return-value]  # known by its attributes


def raw_rewards(env: VecEnv, rewards: np.ndarray) -> np.ndarray:
    """Rewards in the environment's own unit, before any ``VecNormalize``.

    :param env: where the rewards come from, just stepped
    :param rewards: shape (S,)
    :return: shape (S,)
    """
    normalize = unwrap_vec_normalize(env)
    return rewards if normalize is None else normalize.get_original_reward()


def team_rewards(rewards: np.ndarray, team: MultiAgentVecEnv) -> np.ndarray:
    """Reward of each world's team: the sum over agents, or the one that they share.

    :param rewards: shape (S,)
    :param team: says which
    :return: shape (W,), float64
    """
    by_agent = rewards.reshape(team.n_worlds, team.n_agents).astype(np.float64)
    return by_agent[:, 0] if team.team_return == "shared" else by_agent.sum(axis=1)


def add_costs(sums: np.ndarray | None, costs: np.ndarray) -> np.ndarray:
    """Sums of costs after another step.

    :param sums: shape (W, ..., M), None at the first step
    :param costs: shape (W, ..., M)
    :return: shape (W, ..., M)
    :raises ValueError: if the number of costs has changed
    """
    if sums is not None and sums.shape != costs.shape:
        raise ValueError(
            f"the agents report {costs.shape[-1]} costs in info['cost'] now and reported "
            f"{sums.shape[-1]} before; expected equally many at every step, zeros included"
        )
    return costs.copy() if sums is None else sums + costs


def named_costs(costs: list[float], name: str = "cost") -> dict[str, float]:
    """One cost by the plain name, several by ``name_0``, ``name_1``, ...

    :param costs: shape (M,)
    :param name: the plain name
    :return: a key for each cost
    """
    if len(costs) == 1:
        return {name: costs[0]}
    return {f"{name}_{j}": cost for j, cost in enumerate(costs)}
