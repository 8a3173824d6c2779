"""MAPPO for Stable-Baselines3, with cost constraints and observation-entropy exploration.

Shape letters of all docstrings: T rollout steps, W worlds (copies of the environment), N agents,
S = W·N slots (one agent of one world, slot = world·N + agent), B rows of a minibatch,
D observation size, K constrained parties (1 for a team, N for individual agents), M constraints.
"""

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
