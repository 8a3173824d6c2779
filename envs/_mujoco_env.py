"""The robot of a task as a single-agent gymnasium environment: the reference for all others."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_e2c.envs._checks import check_render_mode, require_render_mode
from sb3_e2c.envs._mujoco_config import METADATA, RobotConfig
from sb3_e2c.envs._mujoco_import import MujocoEnv, mujoco
from sb3_e2c.envs._mujoco_models import STOCK_XML, build_model
from sb3_e2c.envs._mujoco_physics import get_state, set_state, take_snapshot
from sb3_e2c.envs._mujoco_render import HEIGHT, WIDTH, Painter
from sb3_e2c.envs._mujoco_robots import FRAME_SKIP, new_robot
from sb3_e2c.envs._mujoco_start import draw_start, place


class RobotEnv(MujocoEnv):
    """One robot with its walls or bomb; ``info["cost"]`` is the cost of a step.

    The observation is the state vector of the task, the action one number in [-1, 1] for each of
    the robot's motors in XML order. There is no time limit. It can be handed to
    gymnasium-robotics' ``parallel_env`` as ``gym_env``.

    :param config: parameters of the task
    :param render_mode: ``"rgb_array"`` or None
    """

    metadata = METADATA

    def __init__(self, config: RobotConfig, render_mode: str | None = None) -> None:
        check_render_mode(render_mode)
        self.config = config
        self.robot = new_robot(config)
        super().__init__(
            STOCK_XML[config.scenario],
            FRAME_SKIP,
            observation_space=None,
            render_mode=render_mode,
            width=WIDTH,
            height=HEIGHT,
        )
        self.now = take_snapshot(self.model, self.data)
        shape = self.robot.state(self.now)[0].shape
        self.observation_space = spaces.Box(-np.inf, np.inf, shape, np.float64)
        self._is_costing = False
        self._options: dict[str, Any] | None = None
        self._painter: Painter | None = None

    def _initialize_simulation(self) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """The stock model with walls or bomb."""
        model = build_model(self.config)
        return model, mujoco.MjData(model)

    def _set_action_space(self) -> spaces.Box:
        """The robot's motors, without that of the bomb."""
        self.action_space = spaces.Box(-1.0, 1.0, (self.robot.n_motors,))
        return self.action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start a new episode.

        :param seed: restarts the random stream
        :param options: "qpos" and "qvel" place the robot by hand
        """
        self._options = options
        return super().reset(seed=seed)

    def reset_model(self) -> np.ndarray:
        """Place the robot; see :func:`~sb3_e2c.envs._mujoco_start.draw_start`."""
        start = draw_start(self.robot, self.model, self.np_random)
        self.set_state(*place([start], self._options)[0])
        self._is_costing = False
        self.now = take_snapshot(self.model, self.data)
        return self.robot.state(self.now)[0]

    def _get_reset_info(self) -> dict[str, Any]:
        return _first(self.robot.whereabouts(self.now))

    def step(self, action: np.ndarray) -> tuple[np.ndarray, Any, bool, bool, dict[str, Any]]:
        """Advance by 0.05 s.

        :param action: shape (U,), clipped to [-1, 1]
        """
        before = self.now
        motors = np.clip(np.asarray(action, dtype=np.float64), -1.0, 1.0)[None]
        self.do_simulation(self.robot.controls(motors, before.time)[0], self.frame_skip)
        self.now = take_snapshot(self.model, self.data)
        verdict = self.robot.judge(before, self.now, motors)
        self._is_costing = bool(verdict.costs[0] > 0.0)
        reward, terminated = float(verdict.rewards[0]), bool(verdict.terminated[0])
        return self.robot.state(self.now)[0], reward, terminated, False, _first(verdict.infos)

    def see_hazards(self, data: mujoco.MjData) -> np.ndarray:
        """What is seen of walls or bomb, for a node of gymnasium-robotics, shape (H,)."""
        return self.robot.hazard_view(take_snapshot(self.model, data))[0]

    def render(self) -> np.ndarray:
        """Picture of the world, uint8, shape (480, 640, 3)."""
        require_render_mode(self.render_mode)
        if self._painter is None:
            self._painter = Painter(self.model)
        return self._painter.draw(self.data.qpos, self._is_costing)

    def close(self) -> None:
        """Release the OpenGL context, if there is one."""
        if self._painter is not None:
            self._painter.close()
            self._painter = None

    def __getstate__(self) -> dict[str, Any]:
        """Parameters, random stream and MuJoCo's state."""
        names = ("config", "render_mode", "now", "_is_costing", "_np_random", "_np_random_seed")
        state = {name: getattr(self, name) for name in names}
        return state | {"mujoco": get_state(self.model, [self.data])}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Continue where the pickle was taken."""
        RobotEnv.__init__(self, state["config"], state["render_mode"])
        set_state(self.model, [self.data], state.pop("mujoco"))
        self.__dict__.update(state)


def _first(columns: dict[str, np.ndarray]) -> dict[str, Any]:
    """The numbers of the only world."""
    return {key: values[0].item() for key, values in columns.items()}
