"""Observation-entropy rewards for any on-policy algorithm (Alg. 1 l. 11-17, Alg. 2 l. 10)."""

import math
from collections.abc import Sequence
from numbers import Real
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.common.vec_env import VecNormalize

from sb3_e2c.entropy import EntropyEstimator, NearestNeighbor, VisitCount

ESTIMATORS: dict[str, type[VisitCount] | type[NearestNeighbor]] = {
    "visit_count": VisitCount,
    "nearest_neighbor": NearestNeighbor,
}


class OEMRewardCallback(BaseCallback):
    """Reward every slot for observations that are new in its episode (Algorithm 1).

    Without ``psi``: r <- beta bonus ("pure"). With it: r <- r_ex + psi beta bonus ("mix"), where
    r_ex is the reward that the algorithm would learn from (MAPPO has applied ``reward_scale``).

    Works with every on-policy algorithm of Stable-Baselines3 and edits rewards before time-outs
    are bootstrapped and before they are stored; monitors have already counted the extrinsic ones.
    Put it first in a list of callbacks, so that the others see the rewards that are learned from.

    What an environment may put into its infos, for every slot and step:

    - ``novelty_observation``: 1-D array to score instead of the observation; the last step's
      describes the terminal observation.
    - ``beta``: relevance beta(o) of what is scored; the factor is 1 if missing, None or 0.

    Under ``VecNormalize`` raw observations are scored, so that distances do not drift with its
    statistics; wrap it last. It keeps terminal observations normalized only: what it clipped
    there stays clipped. Extrinsic rewards are mixed in as it normalizes them, the bonus is not.

    :param estimator: "visit_count", "nearest_neighbor", or an object with the methods of
        :class:`sb3_e2c.entropy.EntropyEstimator`
    :param estimator_kwargs: arguments of an estimator given by name
    :param psi: weight of the bonus beside the extrinsic reward (the paper's robots: 0.3), also as a
        schedule of the remaining progress, which changes between rollouts; None replaces the
        extrinsic reward
    :param verbose: 1 says at the start which bonus is given
    """

    def __init__(
        self,
        estimator: EntropyEstimator | str,
        estimator_kwargs: dict[str, Any] | None = None,
        psi: float | Schedule | None = None,
        verbose: int = 0,
    ) -> None:
        super().__init__(verbose=verbose)
        self.estimator = _make_estimator(estimator, estimator_kwargs)
        self.psi = psi if psi is None or callable(psi) else _check_psi(psi)
        self.episode_bonuses = np.zeros(0)
        self._finished: list[float] = []

    def _init_callback(self) -> None:
        if not isinstance(self.model, OnPolicyAlgorithm):
            raise TypeError(
                f"{type(self.model).__name__} is not an on-policy algorithm: its replay buffer "
                "would mix rewards from before and after an edit. Use OEMRewardCallback with an "
                "OnPolicyAlgorithm such as MAPPO, PPO or A2C."
            )

    def _on_training_start(self) -> None:
        """Begin with empty memories, unless ``learn`` continues running episodes."""
        # Stable-Baselines3 marks every slot here when it has just reset the environment (counters
        # reset, new environment, loaded model), or when all episodes happened to end together.
        starts = np.asarray(self.model._last_episode_starts, dtype=bool)
        if starts.all() or len(starts) != len(self.episode_bonuses):
            self.estimator.reset(len(starts))
            self.episode_bonuses = np.zeros(len(starts))
        if self.verbose > 0:
            psi = self._current_psi()
            mode = "in place of" if psi is None else f"times {psi:g} beside"
            print(f"Learning from the {type(self.estimator).__name__} bonus {mode} the reward")

    def _on_rollout_start(self) -> None:
        self._finished = []

    def _on_step(self) -> bool:
        infos, dones = self.locals["infos"], np.asarray(self.locals["dones"], dtype=bool)
        rewards = _editable_rewards(self.locals)
        observations = self._observations(infos, dones)
        bonuses = _relevance(infos) * self.estimator.score(observations)
        _check_bonuses(bonuses, observations, type(self.estimator).__name__)
        # A hidden channel: the algorithm goes on to learn from this very array, so it must be
        # edited in place; a new array in its locals would go unnoticed.
        psi = self._current_psi()
        if psi is None:
            rewards[:] = bonuses
        else:
            rewards += psi * bonuses
        self.episode_bonuses += bonuses
        self._end_episodes(dones)
        return True

    def _on_rollout_end(self) -> None:
        if self._finished:
            self.logger.record("rollout/ep_oem_mean", float(np.mean(self._finished)))
        if callable(self.psi):
            self.logger.record("rollout/oem_psi", self._current_psi())

    def _current_psi(self) -> float | None:
        if not callable(self.psi):
            return self.psi
        return _check_psi(self.psi(self.model._current_progress_remaining))

    def _end_episodes(self, dones: np.ndarray) -> None:
        if dones.any():
            self._finished.extend(self.episode_bonuses[dones])
            self.episode_bonuses[dones] = 0.0
            self.estimator.forget(dones)

    def _observations(self, infos: Sequence[dict[str, Any]], dones: np.ndarray) -> np.ndarray:
        """What to score: o_{t+1} of the episode that made the step, also in its last step.

        :param infos: one per slot
        :param dones: shape (S,)
        :return: raw observations, shape (S, D)
        """
        if any("novelty_observation" in info for info in infos):
            return np.stack(_from_infos("novelty_observation", infos, range(len(infos))))
        observations = self._raw_observations()
        # where an episode has ended, these are already the first ones of the next episode
        ended = np.flatnonzero(dones)
        if len(ended) > 0:
            last = np.stack(_from_infos("terminal_observation", infos, ended))
            normalize = self.model.get_vec_normalize_env()
            observations[ended] = last if normalize is None else _undo(normalize, last)
        return observations.reshape(len(observations), -1)

    def _raw_observations(self) -> np.ndarray:
        new_obs = self.locals["new_obs"]
        if isinstance(new_obs, dict):
            raise TypeError(
                "The observations are dictionaries, but bonuses need one array per slot: let the "
                'environment put one into infos["novelty_observation"].'
            )
        normalize = self.model.get_vec_normalize_env()
        raw = new_obs if normalize is None else np.asarray(normalize.get_original_obs())
        if raw.shape != new_obs.shape:
            raise ValueError(
                f"The algorithm sees observations of shape {new_obs.shape} and VecNormalize's have "
                f"shape {raw.shape}: wrap with VecNormalize last."
            )
        return np.array(raw, dtype=np.float32)


def _editable_rewards(variables: dict[str, Any]) -> np.ndarray:
    rewards = variables.get("rewards")
    if not isinstance(rewards, np.ndarray):
        raise TypeError(
            'The algorithm does not show its callbacks an array "rewards" while it collects '
            f"(found {type(rewards).__name__}), so a bonus cannot reach what it learns from."
        )
    if not np.issubdtype(rewards.dtype, np.floating) or not rewards.flags.writeable:
        raise TypeError(
            f"Bonuses are fractions and are written into the array of rewards, but that is "
            f"{rewards.dtype}{'' if rewards.flags.writeable else ', read-only'}: return float "
            "rewards from the environment, in a new array at every step."
        )
    return rewards


def _relevance(infos: Sequence[dict[str, Any]]) -> np.ndarray:
    """Factor beta(o) of each slot, 1 where it is missing, None or 0 (Alg. 1 l. 11-13).

    :param infos: one per slot
    :return: shape (S,)
    """
    return np.array([info.get("beta") or 1.0 for info in infos], dtype=np.float64)


def _check_bonuses(bonuses: np.ndarray, observations: np.ndarray, estimator: str) -> None:
    """Stop before a bonus that is not finite is learned from.

    :param bonuses: shape (S,)
    :param observations: what was scored, shape (S, D)
    :param estimator: its name
    """
    odd = np.flatnonzero(~np.isfinite(bonuses))
    if len(odd) > 0:
        scored = observations[odd[0]]
        raise ValueError(
            f"The {estimator} bonus of slot {odd[0]} is {bonuses[odd[0]]}, for an observation with "
            f"numbers from {scored.min():g} to {scored.max():g}: scale what is scored to ordinary "
            'numbers, for example with VecNormalize or infos["novelty_observation"], and give a '
            "finite beta."
        )


def _from_infos(key: str, infos: Sequence[dict[str, Any]], slots: Any) -> list[Any]:
    missing = [int(slot) for slot in slots if infos[slot].get(key) is None]
    if missing:
        raise ValueError(
            f'infos["{key}"] is missing for slots {missing[:5]} of {len(infos)}: the environment '
            "must give it for every slot"
            + (" whose episode ends." if key == "terminal_observation" else " at every step.")
        )
    return [infos[slot][key] for slot in slots]


def _undo(normalize: VecNormalize, observations: np.ndarray) -> np.ndarray:
    return np.asarray(normalize.unnormalize_obs(observations))


def _make_estimator(
    estimator: EntropyEstimator | str, kwargs: dict[str, Any] | None
) -> EntropyEstimator:
    if isinstance(estimator, str):
        if estimator not in ESTIMATORS:
            raise ValueError(
                f"Unknown estimator {estimator!r}: choose from {', '.join(ESTIMATORS)}, or pass an "
                "object with the methods reset, score and forget."
            )
        return ESTIMATORS[estimator](**(kwargs or {}))
    if isinstance(estimator, type) or not isinstance(estimator, EntropyEstimator):
        raise TypeError(
            f"Expected the name of an estimator ({', '.join(ESTIMATORS)}) or an object with the "
            f"methods reset, score and forget, got {estimator!r}."
        )
    if kwargs:
        raise ValueError(
            f"estimator_kwargs={kwargs!r} have no effect on the estimator object "
            f"{type(estimator).__name__}: pass them to its constructor."
        )
    return estimator


def _check_psi(psi: Any) -> float:
    if isinstance(psi, bool) or not isinstance(psi, Real) or not math.isfinite(psi):
        raise ValueError(
            f"psi must be a finite number (mix the bonus with the extrinsic reward), a schedule of "
            f"such numbers, or None (the bonus alone), got {psi!r}."
        )
    return float(psi)
