"""The environments of the paper as PettingZoo parallel environments, registered by id.

Importing this package is light: an environment's module is imported when one is created.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import pettingzoo
from pettingzoo import ParallelEnv

_ROVERS_AND_COUPLING = ((6, 2), (6, 3), (6, 4), (8, 3), (8, 4), (10, 4))

# id -> module of this package, parameters of its parallel_env()
_REGISTRY: dict[str, tuple[str, dict[str, Any]]] = {
    **{
        f"MultiRover-{rovers}-{coupling}-v0": (
            "multi_rover_v0",
            {"n_rovers": rovers, "coupling": coupling},
        )
        for rovers, coupling in _ROVERS_AND_COUPLING
    },
    # An adversary acts in these, too; metadata["team"] and metadata["opponents"] say who is who.
    "PhysicalDeception-v0": ("physical_deception_v0", {}),
    "KeepAway-v0": ("keep_away_v0", {}),
    "PredatorPrey-v0": ("predator_prey_v0", {}),
    # MuJoCo is imported when one of these is created.
    **{
        f"Safe{scenario}-{agent_conf}-v0": (
            "safe_mamujoco_v0",
            {"scenario": scenario, "agent_conf": agent_conf},
        )
        for scenario, agent_conf in (("Ant", "2x4"), ("HalfCheetah", "2x3"))
    },
}


def _create(env_id: str, **parameters: Any) -> ParallelEnv:
    """``pettingzoo.make`` for one id; pickled by name, so that a worker process registers too."""
    return pettingzoo.make("parallel", env_id, **parameters)


def _register() -> None:
    for env_id, (module, parameters) in _REGISTRY.items():
        if env_id not in pettingzoo.parallel_registry:
            entry_point = f"{__name__}.{module}:parallel_env"
            pettingzoo.register("parallel", env_id, entry_point, kwargs=parameters)


_register()

ENV_IDS: dict[str, Callable[..., ParallelEnv]] = {
    env_id: partial(_create, env_id) for env_id in _REGISTRY
}
