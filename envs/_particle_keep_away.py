"""mpe2's simple_push with three good agents; importing this imports mpe2."""

from __future__ import annotations

from mpe2._mpe_utils.simple_env import SimpleEnv
from mpe2.simple_push.simple_push import ExtendedAgent, ExtendedWorld, Scenario

_N_GOOD = 3


class KeepAwayScenario(Scenario):
    """Starts, rewards and observations of simple_push, which loop over all agents."""

    def make_world(self) -> ExtendedWorld:
        """mpe2's world of one adversary and one good agent, and two more good agents."""
        world = super().make_world()
        for i in range(1, _N_GOOD):
            agent = ExtendedAgent()
            agent.name = f"agent_{i}"
            agent.collide = True
            agent.silent = True
            world.agents.append(agent)
        return world


class raw_env(SimpleEnv):  # named as in the modules of mpe2
    """The scenario in mpe2's environment."""

    def __init__(self, max_cycles: int, continuous_actions: bool, render_mode: str | None) -> None:
        scenario = KeepAwayScenario()
        super().__init__(
            scenario=scenario,
            world=scenario.make_world(),
            max_cycles=max_cycles,
            continuous_actions=continuous_actions,
            render_mode=render_mode,
        )
