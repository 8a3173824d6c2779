"""Physical deception (Sec. 5.1 of "Safe Multiagent Coordination via Entropic Exploration")."""

from __future__ import annotations

from typing import Any, ClassVar

from sb3_e2c.envs._particle_config import PHYSICAL_DECEPTION, ParticleTask
from sb3_e2c.envs._particle_env import ParticleEnv

__all__ = ["PhysicalDeceptionEnv", "parallel_env"]


class PhysicalDeceptionEnv(ParticleEnv):
    """Three agents know which landmark is the goal and hide it from an adversary by spreading out.

    ## Description

    ``simple_adversary`` of mpe2 with N=3: its physics, starts, rewards, observations and pictures,
    plus a cost for every agent. The team is ``agent_0``, ``agent_1``, ``agent_2``
    (``metadata["team"]``); ``adversary_0`` (``metadata["opponents"]``) looks for the goal. Bodies
    do not push each other.

    ## Observation Space

    ``Box(14,)`` for the team, ``Box(12,)`` for the adversary, float32, unbounded.

    | Entries | Size | Present |
    |---|---|---|
    | goal - self | 2 | team |
    | landmarks - self | 6 | always |
    | other agents - self, the adversary first | 6 | always |

    ## Action Space

    ``Discrete(5)``: nothing, left, right, down, up. With ``continuous_actions``
    ``Box(0, 1, (5,))``: x is entry 2 minus entry 1, y is entry 4 minus entry 3, after clipping.

    ## Rewards

    The team shares the adversary's distance to the goal minus the smallest distance of a team agent
    to it; the adversary gets minus its own. The team's return is the sum over its agents.

    ## Costs

    ``infos[agent]["cost"]`` of a team agent is 1.0 if after the step it is strictly closer to a
    counted entity than the sum of the two sizes (0.30 for another agent), else 0.0. ``cost_with``
    says what counts. The adversary has no cost; its number is always 0.0, so that all infos have
    the same keys. The team cost is the sum over the team.

    ## Infos

    | Key | Meaning | In |
    |---|---|---|
    | ``cost`` | see above | steps |

    ## Starting State

    All positions are uniform in [-1, 1]², velocities are 0, and the goal is one of the landmarks
    with equal probability. ``reset(options={"agents": (4, 2), "landmarks": (3, 2), "goal": 0})``
    places them by hand, the adversary first. One seed gives the start that mpe2 gives.

    ## Episode End

    After ``max_cycles`` steps, as a truncation for all.

    ## Arguments

    | Parameter | Default | Meaning |
    |---|---|---|
    | ``max_cycles`` | 80 | steps of an episode |
    | ``continuous_actions`` | False | see the action space |
    | ``cost_with`` | ("teammates",) | any of "teammates", "adversary" |
    | ``render_mode`` | None | or "rgb_array" |

    ## Version History

    * v0: first version
    """

    task: ClassVar[ParticleTask] = PHYSICAL_DECEPTION
    metadata = PHYSICAL_DECEPTION.metadata


def parallel_env(render_mode: str | None = None, **parameters: Any) -> PhysicalDeceptionEnv:
    """Create the environment.

    :param render_mode: ``"rgb_array"`` or None
    :param parameters: any parameter of :class:`PhysicalDeceptionEnv`
    """
    return PhysicalDeceptionEnv(render_mode=render_mode, **parameters)
