"""Multi-rover exploration (Sec. 5.1 of "Safe Multiagent Coordination via Entropic Exploration")."""

from __future__ import annotations

from dataclasses import fields
from difflib import get_close_matches
from typing import Any

import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv

from sb3_e2c.envs._rover_config import RoverConfig
from sb3_e2c.envs._rover_sim import METADATA, RoverSimulator

__all__ = ["PRESETS", "MultiRoverEnv", "RoverConfig", "parallel_env"]

# The preset "e2c" is the defaults of RoverConfig; the others follow the public implementations
# named in MultiRoverEnv. Every parameter can still be overridden.
PRESETS: dict[str, dict[str, Any]] = {
    "e2c": {},
    "nsmerl_6_4": {"dim": 15.0, "sensor_radius": 15.0, "max_cycles": 50, "early_stop": True},
    "nsmerl_circular": {
        "poi_placement": "rings",
        "poi_values": (2.0, 2.0, 2.0, 5.0, 5.0, 5.0),
        "sensor_radius": 20.0,
        "max_cycles": 40,
        "early_stop": True,
    },
    "merl": {
        "coupling": 3,
        "poi_values": (1.0, 1.0, 1.0, 1.0),
        "act_radius": 3.0,
        "sensor_radius": 200.0,
        "n_sectors": 36,
        "max_cycles": 50,
        "early_stop": True,
    },
}


def parallel_env(
    preset: str = "e2c", render_mode: str | None = None, **parameters: Any
) -> MultiRoverEnv:
    """Create the environment.

    :param preset: a key of :data:`PRESETS`
    :param render_mode: ``"rgb_array"`` or None
    :param parameters: any parameter of :class:`MultiRoverEnv`; overrides the preset
    """
    if preset not in PRESETS:
        raise ValueError(f"preset is {preset!r}; expected one of {sorted(PRESETS)}")
    names = [field.name for field in fields(RoverConfig)]
    for name in parameters:
        if name not in names:
            close = get_close_matches(name, names, n=1)
            hint = f"did you mean {close[0]!r}?" if close else f"expected one of {names}"
            raise TypeError(f"multi_rover_v0 has no parameter {name!r}; {hint}")
    return MultiRoverEnv(RoverConfig(**(PRESETS[preset] | parameters)), render_mode)


class MultiRoverEnv(ParallelEnv[str, np.ndarray, np.ndarray]):
    r"""Rovers explore a plane; a point of interest (POI) counts when enough of them meet there.

    ## Description

    The cooperative multi-rover domain of Agogino and Tumer in the form of Sec. 5.1: ``N`` rovers
    start in the middle of a square and know only what their sensors tell. A POI is captured once,
    at the first step at which at least ``coupling`` rovers are within ``act_radius`` of it; then
    it disappears from all sensors. Rovers pass through each other, but being close costs. What
    the paper leaves open follows the public code of NS-MERL (by the paper's first author) and
    MERL, or is a choice recorded with the project.

    ## Observation Space

    ``Box(D,)``, float32. The plane around a rover is cut into ``n_sectors`` sectors by the angle
    atan2(dx, dy) in the world frame (4 sectors: 0 is dx>0, dy>0; 1 is dx>0, dy<0; 2 is dx<0, dy<0;
    3 is dx<0, dy>0).

    | Entries | Size | Value | Present |
    |---|---|---|---|
    | rover sectors | n_sectors | -1 if empty, else 1/d² in (0, 4] | always |
    | POI sectors | n_sectors | -1 if empty, else V/d² in (0, 4 max V] | always |
    | identity | N | one-hot | ``add_id`` |
    | velocity | 2 | last displacement, after clamping | ``add_velocity`` |
    | position | 2 | x/dim, y/dim | ``add_position`` |

    Distances are floored at 0.5; what is farther than ``sensor_radius`` is not seen, and neither
    are captured POIs. ``sensor_type`` says how several targets in a sector combine: the largest
    ("closest"), the mean ("density") or the sum ("sum"). With ``sensor_scale="log"`` a sensor value
    x becomes log(x R²/V_max) / log(R²/0.25), clipped to [0, 1], with R = ``sensor_radius`` and
    V_max = 1 for rovers; empty stays -1.

    ## Action Space

    ``Box(-1, 1, (2,))``: displacement in x and y in units of ``max_step``. Actions are clipped, and
    positions clamped to [0, dim]².

    ## Rewards

    All rovers receive the same team reward, captured value / total value. With
    ``reward_at="end"`` it is paid at the last step, with ``"capture"`` when it is earned; the sum
    over an episode, at most 1, is the same.

    ## Costs

    ``infos[agent]["cost"]`` is 1.0 if another rover is strictly closer than ``collision_radius``
    after the move, else 0.0. The team cost is the sum over the rovers.

    ## Infos

    | Key | Meaning | In |
    |---|---|---|
    | ``cost`` | see above | steps |
    | ``beta`` | relevance β (Alg. 1), see below | steps |
    | ``colliding_pairs`` | number of pairs of rovers in collision | steps |
    | ``captured`` | number of POIs the team has captured so far | steps, resets |
    | ``position`` | (x, y) | steps, resets |
    | ``novelty_observation`` | the unscaled sectors, for count-based novelty | steps, resets |
    | ``critic_state`` | captured share, t / max_cycles (``add_critic_state``) | steps, resets |

    β is the product of the values of the POIs within ``act_radius`` that were open before this
    step's captures, and 1.0 if there is none.

    ## Starting State

    Rovers start on different integer cells of a central square of half width int(dim / (2 √10)).
    POIs lie outside the central square that is wider by 2, at least ``poi_distance`` apart
    ("scattered"), or half of them on each of two rings of radius dim/4 and dim/2 with random
    phases ("rings"). ``reset(options={"rovers": (N, 2), "pois": (K, 2)})`` places them by hand.

    ## Episode End

    After ``max_cycles`` steps, as a truncation or (``time_limit="terminate"``) as a true end. With
    ``early_stop`` the episode also terminates when all POIs are captured.

    ## Arguments

    | Parameter | Default | Meaning |
    |---|---|---|
    | ``n_rovers`` | 6 | number of rovers, N |
    | ``coupling`` | 2 | rovers needed at a POI |
    | ``dim`` | 20.0 | side of the square world |
    | ``poi_values`` | (5, 5, 5, 5) | values of the POIs, one for each |
    | ``poi_placement`` | "scattered" | or "rings" |
    | ``poi_distance`` | 4.0 | least distance between scattered POIs |
    | ``max_step`` | 1.0 | largest displacement per axis and step |
    | ``max_cycles`` | 80 | steps of an episode |
    | ``act_radius`` | 2.0 | distance (inclusive) at which a POI is visited |
    | ``collision_radius`` | 0.5 | distance (exclusive) of a collision |
    | ``sensor_radius`` | 10.0 | reach of the sensors (inclusive) |
    | ``n_sectors`` | 4 | sectors for rovers, and as many for POIs |
    | ``sensor_type`` | "closest" | or "density", "sum" |
    | ``sensor_scale`` | "linear" | or "log" |
    | ``add_id``, ``add_velocity``, ``add_position`` | False | see the observation table |
    | ``add_critic_state`` | False | see the table of infos |
    | ``reward_at`` | "end" | or "capture" |
    | ``time_limit`` | "truncate" | or "terminate" |
    | ``early_stop`` | False | end when all POIs are captured |

    Presets of :func:`parallel_env`: ``e2c`` (the defaults); ``nsmerl_6_4`` and ``nsmerl_circular``
    (worlds of NS-MERL; the latter is meant for n_rovers = 3 coupling); ``merl`` (sensors with
    unlimited range and 36 sectors).

    ## Version History

    * v0: first version
    """

    metadata = METADATA

    def __init__(self, config: RoverConfig | None = None, render_mode: str | None = None) -> None:
        self.config = RoverConfig() if config is None else config
        self.render_mode = render_mode
        self._world = RoverSimulator(self.config, 1, render_mode)
        self.possible_agents = self._world.possible_agents
        self.agents: list[str] = []

    def batched(self, n_worlds: int) -> RoverSimulator:
        """Build a simulator of many worlds with the same parameters."""
        return RoverSimulator(self.config, n_worlds, self.render_mode)

    def observation_space(self, agent: str) -> spaces.Box:
        """Observation space of an agent, shape (D,)."""
        return self._world.observation_space(agent)

    def action_space(self, agent: str) -> spaces.Box:
        """Action space of an agent, shape (2,)."""
        return self._world.action_space(agent)

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, dict[str, Any]]]:
        """Start a new episode; see the class for ``options``."""
        observations, infos = self._world.reset(np.zeros(1, np.int64), [seed], options)
        self.agents = self.possible_agents[:]
        return self._by_agent(observations), self._infos(infos)

    def step(
        self, actions: dict[str, np.ndarray]
    ) -> tuple[
        dict[str, np.ndarray],
        dict[str, float],
        dict[str, bool],
        dict[str, bool],
        dict[str, dict[str, Any]],
    ]:
        """Move all rovers at once."""
        missing = [agent for agent in self.agents if agent not in actions]
        if missing:
            raise ValueError(f"no action for {missing}; expected one for each of {self.agents}")
        joint = np.stack([actions[agent] for agent in self.possible_agents])[None]
        observations, rewards, terminated, truncated, infos = self._world.step(joint)
        if terminated[0] or truncated[0]:
            self.agents = []
        return (
            self._by_agent(observations),
            {agent: float(reward) for agent, reward in self._by_agent(rewards).items()},
            dict.fromkeys(self.possible_agents, bool(terminated[0])),
            dict.fromkeys(self.possible_agents, bool(truncated[0])),
            self._infos(infos),
        )

    def _by_agent(self, batch: np.ndarray) -> dict[str, np.ndarray]:
        return dict(zip(self.possible_agents, batch[0], strict=True))

    def _infos(self, infos: dict[str, np.ndarray]) -> dict[str, dict[str, Any]]:
        """One dict per agent; single numbers become Python numbers."""
        return {
            agent: {
                key: values[0, i].item() if values.ndim == 2 else values[0, i]
                for key, values in infos.items()
            }
            for i, agent in enumerate(self.possible_agents)
        }

    def render(self) -> np.ndarray:
        """Picture of the world, uint8, shape (height, width, 3)."""
        return self._world.render(0)

    def close(self) -> None:
        """Nothing to release."""
        self._world.close()
