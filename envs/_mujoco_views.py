"""What the agents of a robot observe: its whole state, or the joints near their own.

The second is the factorization of gymnasium-robotics (its ``obsk``), with two changes. Its
partitions count joints from the end, which a bomb or free walls behind the robot's joints would
silently shift: here they count from the start. And its observations know nothing of walls and
bomb: here they are one more global node.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces

from sb3_e2c.envs._mujoco_config import RobotConfig
from sb3_e2c.envs._mujoco_robots import Robot, Snapshot, clipped

# gymnasium-robotics' defaults: what is seen of own joints, and of those 1, 2, ... joints away
_OWN = {"Ant": ["qpos", "qvel", "cfrc_ext"], "HalfCheetah": ["qpos", "qvel"]}
_NEAR = ["qpos"]
_GLOBAL = ("qpos", "qvel")


class Factorization(NamedTuple):
    """The arguments of gymnasium-robotics' ``build_obs`` that are the same at every step."""

    partition: list[tuple[Any, ...]]
    edges: list[Any]
    globals: list[Any]
    near: list[dict[int, list[Any]]]  # for every agent, nodes by distance
    categories: list[list[str]]  # by distance


def factorize(
    config: RobotConfig, robot: Robot, see_hazards: Callable[[Any], np.ndarray]
) -> Factorization:
    """Cut a robot into agents.

    :param config: parameters of the task
    :param robot: the robot, for its numbers of joints
    :param see_hazards: what is seen of walls or bomb, shape (H,), given MuJoCo's data
    """
    obsk = import_obsk()
    parts, edges, shared = obsk.get_parts_and_edges(config.scenario, None)
    nodes = {node.label: _from_the_start(node, robot) for node in parts[0]}
    edges = [obsk.HyperEdge(*(nodes[node.label] for node in edge.nodes)) for edge in edges]
    hazards = {"qpos": see_hazards, "qvel": lambda _: np.empty(0)}
    shared = [*shared, obsk.Node("hazards", None, None, None, extra_obs=hazards)]
    partition = [tuple(nodes[motor] for motor in agent) for agent in config.partition]
    reach = config.agent_obsk
    near = [obsk.get_joints_at_kdist(agent, edges, k=reach) for agent in partition]
    categories = [_OWN[config.scenario]] + [_NEAR] * reach
    return Factorization(partition, edges, shared, near, categories)


def import_obsk() -> Any:
    """The module of gymnasium-robotics, which is needed for these observations only."""
    try:
        from gymnasium_robotics.envs.multiagent_mujoco import obsk
    except ImportError as error:
        raise ImportError(
            "obs_mode='obsk' needs gymnasium-robotics, which is not installed: "
            "pip install gymnasium-robotics"
        ) from error
    return obsk


def _from_the_start(node: Any, robot: Robot) -> Any:
    """A copy of a node whose indices, negative in the stock tables, count from the start."""
    node = copy(node)
    node.qpos_ids += robot.n_qpos if node.qpos_ids < 0 else 0
    node.qvel_ids += robot.n_qvel if node.qvel_ids < 0 else 0
    return node


def build(parts: Factorization, data: Any, is_index: bool = False) -> list[np.ndarray]:
    """Observation of every agent by gymnasium-robotics, without identity.

    :param parts: the factorization
    :param data: MuJoCo's data
    :param is_index: whether the data are indices, which must not be clipped
    """
    obsk = import_obsk()
    return [
        obsk.build_obs(data, near, parts.categories, parts.globals, _GLOBAL, is_index)
        for near in parts.near
    ]


class View:
    """Observations of all agents of W worlds at once.

    :param config: parameters of the task
    :param robot: its robot
    :param example: what will be observed, of any world
    """

    def __init__(self, config: RobotConfig, robot: Robot, example: Snapshot) -> None:
        self.config = config
        self.robot = robot
        self._index = _index(config, robot, example) if config.obs_mode == "obsk" else None
        self.n_agents = len(config.agents)
        self._ids = np.eye(self.n_agents, self.n_agents * config.add_id)
        self.size = self.observe(example).shape[-1]

    def space(self) -> spaces.Box:
        """Observation space of an agent, shape (D,)."""
        return spaces.Box(-np.inf, np.inf, (self.size,), np.float32)

    def observe(self, now: Snapshot) -> np.ndarray:
        """Observations (W, N, D), float32."""
        if self._index is None:
            return self.finish(self.robot.state(now)[:, None])
        forces = clipped(now.contact, 1.0)
        zero = np.zeros((len(now.time), 1))
        blocks = (now.qpos, now.qvel, forces, self.robot.hazard_view(now), zero)
        return self.finish(np.concatenate(blocks, axis=1)[:, self._index])

    def finish(self, local: np.ndarray) -> np.ndarray:
        """Append identities and standardize, as far as the parameters say so.

        :param local: shape (W, N, D) without identities, or (W, 1, D) if all agents see the same
        """
        shape, size = (len(local), self.n_agents), local.shape[-1]
        is_scaled = self.config.per_vector_norm
        dtype = np.float64 if is_scaled else np.float32
        whole = np.empty((*shape, size + self._ids.shape[1]), dtype)
        whole[..., :size] = local
        whole[..., size:] = self._ids
        if is_scaled:
            whole -= whole.mean(axis=-1, keepdims=True)
            whole /= whole.std(axis=-1, keepdims=True)
        return whole.astype(np.float32, copy=False)


def pad(rows: list[np.ndarray], filler: float = 0.0) -> np.ndarray:
    """Rows of different lengths with a filler behind them, shape (N, D)."""
    length = max(map(len, rows))
    return np.stack([np.pad(r, (0, length - len(r)), constant_values=filler) for r in rows])


def _index(config: RobotConfig, robot: Robot, example: Snapshot) -> np.ndarray:
    """Where the entries of the observations stand in (qpos, qvel, contact, hazards, 0): (N, D).

    Gymnasium-robotics tells it by being shown indices in place of the data.
    """
    blocks = (example.qpos, example.qvel, example.contact, robot.hazard_view(example))
    ends = np.cumsum([block.shape[1] for block in blocks])
    qpos, qvel, contact, hazards = np.split(np.arange(ends[-1]), ends[:-1])
    data = SimpleNamespace(qpos=qpos, qvel=qvel, cfrc_ext=contact.reshape(-1, 6))
    parts = factorize(config, robot, lambda _: hazards)
    return pad(build(parts, data, is_index=True), filler=ends[-1]).astype(np.int64)
