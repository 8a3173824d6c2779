"""Keep away (Sec. 5.1 of "Safe Multiagent Coordination via Entropic Exploration")."""

from __future__ import annotations

from typing import Any, ClassVar

from sb3_e2c.envs._particle_config import KEEP_AWAY, ParticleTask
from sb3_e2c.envs._particle_env import ParticleEnv

__all__ = ["KeepAwayEnv", "parallel_env"]


class KeepAwayEnv(ParticleEnv):
    """Three agents go to a goal, from which an adversary that does not know it pushes them away.

    ## Description

    ``simple_push`` of mpe2 with three good agents instead of one: its physics, starts, rewards,
    observations and pictures, plus a cost for every agent. The team is ``agent_0``, ``agent_1``,
    ``agent_2`` (``metadata["team"]``); ``adversary_0`` (``metadata["opponents"]``) must guess which
    of two landmarks is the goal. Agents push each other on contact, landmarks do not.

    ## Observation Space

    ``Box(23,)`` for the team, ``Box(12,)`` for the adversary, float32, unbounded.

    | Entries | Size | Present |
    |---|---|---|
    | own velocity | 2 | always |
    | goal - self | 2 | team |
    | own color, which tells the goal | 3 | team |
    | landmarks - self | 4 | always |
    | colors of the landmarks | 6 | team |
    | other agents - self, the adversary first | 6 | always |

    ## Action Space

    ``Discrete(5)``: nothing, left, right, down, up. With ``continuous_actions``
    ``Box(0, 1, (5,))``: x is entry 2 minus entry 1, y is entry 4 minus entry 3, after clipping.

    ## Rewards

    A team agent gets minus its own distance to the goal; the adversary gets the smallest of these
    distances minus its own. The team's return is the sum over its agents.

    ## Costs

    ``infos[agent]["cost"]`` of a team agent is 1.0 if after the step it is strictly closer to a
    counted entity than the sum of the two sizes (0.10 for another agent), else 0.0. ``cost_with``
    says what counts: contact with the adversary is its move, which the team cannot choose. The
    adversary has no cost; its number is always 0.0, so that all infos have the same keys. The team
    cost is the sum over the team.

    ## Infos

    | Key | Meaning | In |
    |---|---|---|
    | ``cost`` | see above | steps |

    ## Starting State

    All positions are uniform in [-1, 1]², velocities are 0, and the goal is one of the landmarks
    with equal probability. ``reset(options={"agents": (4, 2), "landmarks": (2, 2), "goal": 0})``
    places them by hand, the adversary first. One seed gives the start that mpe2's reset would draw.

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

    task: ClassVar[ParticleTask] = KEEP_AWAY
    metadata = KEEP_AWAY.metadata


def parallel_env(render_mode: str | None = None, **parameters: Any) -> KeepAwayEnv:
    """Create the environment.

    :param render_mode: ``"rgb_array"`` or None
    :param parameters: any parameter of :class:`KeepAwayEnv`
    """
    return KeepAwayEnv(render_mode=render_mode, **parameters)
