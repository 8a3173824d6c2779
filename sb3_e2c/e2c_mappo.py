"""E2C-MAPPO: MAPPO with the entropy reward of Algorithm 1 (Alg. 2 l. 10)."""

from collections.abc import Iterable
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback, CallbackList, ConvertCallback
from stable_baselines3.common.type_aliases import MaybeCallback

from sb3_e2c.arguments import checked
from sb3_e2c.callbacks import OEMRewardCallback
from sb3_e2c.mappo import MAPPO

_NEAREST_NEIGHBOR = {"estimator": "nearest_neighbor", "estimator_kwargs": {"k": 5}}


class E2CMAPPO(MAPPO):
    """MAPPO that explores by observation entropy.

    The same as :class:`MAPPO` with an :class:`sb3_e2c.OEMRewardCallback` as the first callback of
    every ``learn``, unless the caller passes one.

    :param args: See :class:`MAPPO`
    :param oem_kwargs: Arguments of the callback. Without an ``estimator`` the bonus is that of the
        5th nearest neighbor, as the paper has it for the particle tasks; without ``psi`` it takes
        the place of the environment's reward ("pure")
    :param kwargs: See :class:`MAPPO`
    """

    def __init__(self, *args: Any, oem_kwargs: dict[str, Any] | None = None, **kwargs: Any):
        self.oem_kwargs = checked("oem_kwargs", oem_kwargs)
        if "estimator" not in self.oem_kwargs:
            self.oem_kwargs = {**_NEAREST_NEIGHBOR, **self.oem_kwargs}
        super().__init__(*args, **kwargs)

    def _setup_model(self) -> None:
        self.oem_kwargs = checked("oem_kwargs", self.oem_kwargs)
        super()._setup_model()
        try:
            self._oem_callback = OEMRewardCallback(**{"verbose": self.verbose, **self.oem_kwargs})
        except TypeError as error:
            raise TypeError(f"oem_kwargs is {self.oem_kwargs}: {error}") from error

    def _init_callback(self, callback: MaybeCallback, progress_bar: bool = False) -> BaseCallback:
        given = callback if isinstance(callback, list) else [callback]
        callbacks = [_as_callback(each) for each in given if each is not None]
        if not _has_entropy_reward(callbacks):
            callbacks.insert(0, self._oem_callback)
        return super()._init_callback(callbacks, progress_bar)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_oem_callback"]


def _as_callback(callback: Any) -> BaseCallback:
    return callback if isinstance(callback, BaseCallback) else ConvertCallback(callback)


def _has_entropy_reward(callbacks: Iterable[BaseCallback]) -> bool:
    return any(
        isinstance(each, OEMRewardCallback)
        or (isinstance(each, CallbackList) and _has_entropy_reward(each.callbacks))
        for each in callbacks
    )
