"""MAPPO for Stable-Baselines3, with cost constraints and observation-entropy exploration.

Shape letters of all docstrings: T rollout steps, W worlds (copies of the environment), N agents,
S = W·N slots (one agent of one world, slot = world·N + agent), B rows of a minibatch,
D observation size, K constrained parties (1 for a team, N for individual agents), M constraints.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sb3_e2c.callbacks import OEMRewardCallback
    from sb3_e2c.e2c_mappo import E2CMAPPO
    from sb3_e2c.entropy import NearestNeighbor, VisitCount
    from sb3_e2c.evaluation import TeamEvalCallback, TeamEvaluation, evaluate_team
    from sb3_e2c.mappo import MAPPO
    from sb3_e2c.monitor import TeamMonitor
    from sb3_e2c.multipliers import GradientMultipliers, PIDMultipliers
    from sb3_e2c.trust_region import TrustRegionMonitor
    from sb3_e2c.vec_env import MultiAgentVecEnv, OpponentVecEnv, share_parameters

__version__ = "0.1.0"

__all__ = [
    "E2CMAPPO",
    "MAPPO",
    "GradientMultipliers",
    "MultiAgentVecEnv",
    "NearestNeighbor",
    "OEMRewardCallback",
    "OpponentVecEnv",
    "PIDMultipliers",
    "TeamEvalCallback",
    "TeamEvaluation",
    "TeamMonitor",
    "TrustRegionMonitor",
    "VisitCount",
    "evaluate_team",
    "share_parameters",
]

# Where each name lives. What is asked for is imported then, so that the command line can show its
# help, or be interrupted, before torch is there.
_HOMES = {
    "E2CMAPPO": "sb3_e2c.e2c_mappo",
    "MAPPO": "sb3_e2c.mappo",
    "GradientMultipliers": "sb3_e2c.multipliers",
    "MultiAgentVecEnv": "sb3_e2c.vec_env",
    "NearestNeighbor": "sb3_e2c.entropy",
    "OEMRewardCallback": "sb3_e2c.callbacks",
    "OpponentVecEnv": "sb3_e2c.vec_env",
    "PIDMultipliers": "sb3_e2c.multipliers",
    "TeamEvalCallback": "sb3_e2c.evaluation",
    "TeamEvaluation": "sb3_e2c.evaluation",
    "TeamMonitor": "sb3_e2c.monitor",
    "TrustRegionMonitor": "sb3_e2c.trust_region",
    "VisitCount": "sb3_e2c.entropy",
    "evaluate_team": "sb3_e2c.evaluation",
    "share_parameters": "sb3_e2c.vec_env",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
