"""Safe multi-agent MuJoCo (Sec. 5.1 of "Safe Multiagent Coordination via Entropic Exploration")."""

from __future__ import annotations

from dataclasses import fields
from difflib import get_close_matches
from typing import Any

import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv

from sb3_e2c.envs._mujoco_config import METADATA, RobotConfig
from sb3_e2c.envs._mujoco_env import RobotEnv
from sb3_e2c.envs._mujoco_sim import RobotSimulator
from sb3_e2c.envs._mujoco_views import View, build, factorize, pad

__all__ = ["RobotConfig", "SafeMAMuJoCoEnv", "parallel_env"]


def parallel_env(render_mode: str | None = None, **parameters: Any) -> SafeMAMuJoCoEnv:
    """Create the environment.

    :param render_mode: ``"rgb_array"`` or None
    :param parameters: any parameter of :class:`SafeMAMuJoCoEnv`
    """
    names = [field.name for field in fields(RobotConfig)]
    for name in parameters:
        if name not in names:
            close = get_close_matches(name, names, n=1)
            hint = f"did you mean {close[0]!r}?" if close else f"expected one of {names}"
            raise TypeError(f"safe_mamujoco_v0 has no parameter {name!r}; {hint}")
    return SafeMAMuJoCoEnv(RobotConfig(**parameters), render_mode)


class SafeMAMuJoCoEnv(ParallelEnv[str, np.ndarray, np.ndarray]):
    """Agents move one robot together, each with some of its joints, where moving has its dangers.

    ## Description

    The two robots of the paper, rebuilt from the public repository Safe-Multi-Agent-MuJoCo
    ("SMM" below; Gu et al., "Safe multi-robot control via multi-agent policy optimisation") on
    current MuJoCo: gymnasium's stock XML files and mechanics, with walls and bomb added. The
    **Ant** walks along a corridor that bends by 60 degrees every 40 m; coming close to a wall or
    falling costs. The **HalfCheetah** runs behind a rolling bomb that it must not come close to.
    With ``cost_mode="velocity"`` the stock robots are alone, and speed costs, as in
    Safety-Gymnasium's multi-agent velocity tasks.

    ## Observation Space

    ``Box(D,)``, float32, unbounded, not normalized. With ``obs_mode="full"`` every agent sees the
    state vector of the task:

    | Robot | Entries | Size |
    |---|---|---|
    | Ant | height, orientation (w, x, y, z), 8 joints | 13 |
    | | velocities of torso (3), rotation (3), joints (8) | 14 |
    | | x / 5 m, offset from the center line of the corridor along y | 2 |
    | HalfCheetah | height, pitch, 6 joints | 8 |
    | | velocities of x, height, pitch, joints | 9 |
    | | velocity of the bomb, input u of its motor, distance / 10 m clipped to [-5, 5] | 3 |

    With ``obs_mode="obsk"`` an agent sees its own joints, positions of joints up to ``agent_obsk``
    joints away and the torso, as in gymnasium-robotics (which must be installed), and the last row
    of its robot above; shorter observations are filled up with zeros. ``add_id`` appends a one-hot
    identity in both modes. Speed tasks lack the last row. So D is 31 (Ant 2x4) and 22
    (HalfCheetah 2x3), or 67 and 17 with "obsk".

    ## Action Space

    ``Box(-1, 1, (A,))``: inputs of the agent's motors; actions are clipped. ``agent_conf`` is one
    of "2x4", "2x4d", "4x2", "8x1" (Ant) or "2x3", "3x2", "6x1" (HalfCheetah): agents x joints.
    Motors are given to agents by name, as in gymnasium-robotics: in the Ant's 2x4, agent_0 has
    legs 1 and 2 (on the left, +y). SMM names the same legs but feeds the joined actions to the
    motors in XML order, so that agent_0 drives legs 4 and 1 (in front, +x): ``legacy_split``.

    ## Rewards

    All agents receive the same reward, with the clipped action a of the whole robot:
    v - 0.5 a² - 0.0005 clip(contact forces, -1, 1)² + 1 (Ant) or v - 0.1 a² (HalfCheetah), where v
    is the mean x velocity of the step in m/s and squares are sums. With ``cost_mode="velocity"``
    the Ant's 1 is not paid at the step of a fall, as in gymnasium.

    ## Costs

    ``infos[agent]["cost"]`` is the robot's cost, 0.0 or 1.0, the same number for all agents; the
    team cost is that number.

    * Ant: 1.0 if the torso is, along y, less than 1.8 m away from a wall 5 m beside the center
      line, or has fallen. Beyond 6.8 m nothing costs, unless ``strict_outside``.
    * HalfCheetah: 1.0 if it is, along x, less than 9 m away from the center of the bomb. The
      bomb starts at x = 10 m. It weighs 0.1 kg, has a damping of 0.2 N s/m, and is driven with
      120 u newtons, u = 0.02 sin²(t / 3) - 0.004, set once per step: it rolls back to 8.0 m in
      1.8 s, and on average ahead at 3.6 m/s. A HalfCheetah that stands still pays 35 per episode.
    * ``cost_mode="velocity"``: 1.0 above ``speed_limit``.

    ## Infos

    | Key | Meaning | In |
    |---|---|---|
    | ``cost`` | see above | steps |
    | ``x_position``, ``y_position`` (Ant) | of the torso, m | steps, resets |
    | ``y_offset`` (Ant) | from the center line along y, m | steps, resets |
    | ``cost_wall``, ``cost_fall`` (Ant) | parts of the cost | steps |
    | ``bomb_distance`` (HalfCheetah) | x of bomb - x of robot, m | steps, resets |
    | ``speed`` | m/s (``cost_mode="velocity"``) | steps |
    | ``reward_forward``, ``reward_ctrl`` | parts of the reward | steps |
    | ``reward_contact``, ``reward_survive`` (Ant) | parts of the reward | steps |

    ## Starting State

    Positions (the bomb's, too) have uniform noise in [-0.1, 0.1], velocities normal noise with
    standard deviation 0.1. ``reset(options={"qpos": (nq,), "qvel": (nv,)})`` sets them by hand.

    ## Episode End

    The Ant's episode terminates when its torso is outside of a height of 0.2 to 1 m, nearly upside
    down, or not finite (MuJoCo restarts an unstable simulation by itself). After ``max_steps``
    steps of 0.05 s all episodes are truncated.

    ## Arguments

    | Parameter | Default | Meaning |
    |---|---|---|
    | ``scenario`` | "HalfCheetah" | or "Ant" |
    | ``agent_conf`` | "2x3" or "2x4" | see the action space |
    | ``obs_mode``, ``agent_obsk`` | "full", 1 | see the observation space |
    | ``add_id`` | True | append a one-hot identity |
    | ``per_vector_norm`` | False | standardize every observation within itself, as SMM does |
    | ``max_steps`` | 2000 | steps of an episode; SMM's figures are for 1000 |
    | ``cost_mode`` | "hazard" | or "velocity" |
    | ``speed_limit`` | published | m/s, for ``cost_mode="velocity"`` |
    | ``walls`` | "visual" | or "free": the Ant's fall when touched, as in SMM; or "none" |
    | ``strict_outside`` | False | charge everything farther than 3.2 m from the center line |
    | ``legacy_split`` | False | see the action space |
    | ``n_threads`` | None | threads of :meth:`batched`; None is one for each core |

    ## Version History

    * v0: first version
    """

    metadata = METADATA

    def __init__(self, config: RobotConfig | None = None, render_mode: str | None = None) -> None:
        self.config = RobotConfig() if config is None else config
        self.render_mode = render_mode
        self.possible_agents = self.config.agents
        self.agents: list[str] = []
        self._steps = 0
        self._build(RobotEnv(self.config, render_mode))

    def _build(self, env: RobotEnv) -> None:
        """Make what follows from the parameters and the single-agent environment."""
        self.single_agent_env = env
        self._view = View(self.config, env.robot, env.now)
        self._order = self.config.action_order
        shape = (len(self._order) // len(self.possible_agents),)
        self._observation_spaces = {agent: self._view.space() for agent in self.possible_agents}
        self._action_spaces = {
            agent: spaces.Box(-1.0, 1.0, shape) for agent in self.possible_agents
        }
        is_local = self.config.obs_mode == "obsk"
        self._parts = factorize(self.config, env.robot, env.see_hazards) if is_local else None

    def batched(self, n_worlds: int) -> RobotSimulator:
        """Build a simulator of many worlds with the same parameters."""
        return RobotSimulator(self.config, n_worlds, self.render_mode)

    def observation_space(self, agent: str) -> spaces.Box:
        """Observation space of an agent, shape (D,)."""
        return self._observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Box:
        """Action space of an agent, shape (A,)."""
        return self._action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, dict[str, Any]]]:
        """Start a new episode; see the class for ``options``."""
        state, info = self.single_agent_env.reset(seed=seed, options=options)
        self.agents = self.possible_agents[:]
        self._steps = 0
        return self._observations(state), {agent: dict(info) for agent in self.agents}

    def step(
        self, actions: dict[str, np.ndarray]
    ) -> tuple[
        dict[str, np.ndarray],
        dict[str, float],
        dict[str, bool],
        dict[str, bool],
        dict[str, dict[str, Any]],
    ]:
        """Move all joints at once."""
        if not self.agents:
            raise ValueError("step() was called although no episode is running; reset first")
        missing = [agent for agent in self.agents if agent not in actions]
        if missing:
            raise ValueError(f"no action for {missing}; expected one for each of {self.agents}")
        joined = np.concatenate([self._action(agent, actions[agent]) for agent in self.agents])
        state, reward, terminated, _, info = self.single_agent_env.step(joined[self._order])
        self._steps += 1
        truncated = self._steps >= self.config.max_steps
        if terminated or truncated:
            self.agents = []
        agents = self.possible_agents
        return (
            self._observations(state),
            dict.fromkeys(agents, reward),
            dict.fromkeys(agents, terminated),
            dict.fromkeys(agents, truncated),
            {agent: dict(info) for agent in agents},
        )

    def _action(self, agent: str, action: Any) -> np.ndarray:
        array = np.asarray(action, dtype=np.float64)
        shape = self._action_spaces[agent].shape
        if array.shape != shape or not np.isfinite(array).all():
            raise ValueError(
                f"the action of {agent} is {array.tolist()}; expected finite numbers, shape {shape}"
            )
        return array

    def _observations(self, state: np.ndarray) -> dict[str, np.ndarray]:
        """Every agent's observation, given the state vector of the task."""
        if self._parts is None:
            local = state[None]
        else:
            local = pad(build(self._parts, self.single_agent_env.data))
        return dict(zip(self.possible_agents, self._view.finish(local[None])[0], strict=True))

    def state(self) -> np.ndarray:
        """State vector of the task, shape (S,)."""
        env = self.single_agent_env
        return env.robot.state(env.now)[0]

    def render(self) -> np.ndarray:
        """Picture of the world, uint8, shape (480, 640, 3)."""
        return self.single_agent_env.render()

    def close(self) -> None:
        """Release the OpenGL context, if there is one."""
        self.single_agent_env.close()

    def __getstate__(self) -> dict[str, Any]:
        """The whole state, without what :meth:`_build` makes again."""
        names = ("config", "render_mode", "possible_agents", "agents", "_steps", "single_agent_env")
        return {name: getattr(self, name) for name in names}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Continue where the pickle was taken."""
        self.__dict__.update(state)
        self._build(self.single_agent_env)
