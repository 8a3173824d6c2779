"""Predator prey (Sec. 5.1 of "Safe Multiagent Coordination via Entropic Exploration")."""

from __future__ import annotations

from typing import Any, ClassVar

from sb3_e2c.envs._particle_config import PREDATOR_PREY, ParticleTask
from sb3_e2c.envs._particle_env import ParticleEnv

__all__ = ["PredatorPreyEnv", "parallel_env"]


class PredatorPreyEnv(ParticleEnv):
    """Three slow predators hunt a faster prey between two obstacles.

    ## Description

    ``simple_tag`` of mpe2 with one prey, three predators and two obstacles: its physics, starts,
    rewards, observations and pictures, plus a cost for every predator. The team is the predators,
    which mpe2 calls ``adversary_0``, ``adversary_1``, ``adversary_2`` (``metadata["team"]``); the
    prey ``agent_0`` (``metadata["opponents"]``) is the paper's adversary. All bodies push each
    other on contact.

    | | size | acceleration | largest speed |
    |---|---|---|---|
    | predator | 0.075 | 3.0 | 1.0 |
    | prey | 0.05 | 4.0 | 1.3 |
    | obstacle | 0.2 | | |

    ## Observation Space

    ``Box(16,)`` for the predators, ``Box(14,)`` for the prey, float32, unbounded.

    | Entries | Size | Present |
    |---|---|---|
    | own velocity | 2 | always |
    | own position | 2 | always |
    | obstacles - self | 4 | always |
    | other agents - self, predators first | 6 | always |
    | velocity of the prey | 2 | predators |

    ## Action Space

    ``Discrete(5)``: nothing, left, right, down, up. With ``continuous_actions``
    ``Box(0, 1, (5,))``: x is entry 2 minus entry 1, y is entry 4 minus entry 3, after clipping.

    ## Rewards

    Every predator gets 10 for each predator that touches the prey in this step. The prey loses 10
    for each of them, and for each axis, with x the absolute value of its coordinate, 10 (x - 0.9)
    from x = 0.9 to 1.0 and min(exp(2x - 2), 10) beyond. The team's return is the sum over its
    agents.

    ## Costs

    ``infos[agent]["cost"]`` of a predator is 1.0 if after the step it is strictly closer to a
    counted entity than the sum of the two sizes (0.15 for a teammate, 0.275 for an obstacle, 0.125
    for the prey), else 0.0. ``cost_with`` says what counts; touching the prey is the goal, so by
    default it does not. The prey has no cost; its number is always 0.0, so that all infos have the
    same keys. The team cost is the sum over the team.

    ## Infos

    | Key | Meaning | In |
    |---|---|---|
    | ``cost`` | see above | steps |

    ## Starting State

    Agents are uniform in [-1, 1]² and obstacles in [-0.9, 0.9]²; velocities are 0.
    ``reset(options={"agents": (4, 2), "landmarks": (2, 2)})`` places them by hand, predators first.
    One seed gives the start that mpe2 gives.

    ## Episode End

    After ``max_cycles`` steps, as a truncation for all.

    ## Arguments

    | Parameter | Default | Meaning |
    |---|---|---|
    | ``max_cycles`` | 80 | steps of an episode |
    | ``continuous_actions`` | False | see the action space |
    | ``cost_with`` | ("teammates", "obstacles") | any of "teammates", "obstacles", "adversary" |
    | ``render_mode`` | None | or "rgb_array" |

    ## Version History

    * v0: first version
    """

    task: ClassVar[ParticleTask] = PREDATOR_PREY
    metadata = PREDATOR_PREY.metadata


def parallel_env(render_mode: str | None = None, **parameters: Any) -> PredatorPreyEnv:
    """Create the environment.

    :param render_mode: ``"rgb_array"`` or None
    :param parameters: any parameter of :class:`PredatorPreyEnv`
    """
    return PredatorPreyEnv(render_mode=render_mode, **parameters)
