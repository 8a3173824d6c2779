"""What every environment and simulator of this package refuses in the same words."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def check_render_mode(render_mode: str | None) -> None:
    """Refuse an unknown mode."""
    if render_mode not in (None, "rgb_array"):
        raise ValueError(f"render_mode is {render_mode!r}; expected None or 'rgb_array'")


def require_render_mode(render_mode: str | None) -> None:
    """Refuse to draw without a mode."""
    if render_mode is None:
        raise ValueError(
            "render() needs a render mode, found None; create the environment with "
            "render_mode='rgb_array'"
        )


def check_running(needs_reset: np.ndarray) -> None:
    """Refuse to step worlds whose episode has ended.

    :param needs_reset: whether it has, shape (W,)
    """
    if needs_reset.any():
        raise ValueError(
            f"step() was called although the episode of world(s) "
            f"{np.flatnonzero(needs_reset).tolist()} has ended or not begun; reset first"
        )


def check_actions(actions: np.ndarray, shape: tuple[int, int, int], agents: Sequence[str]) -> None:
    """Refuse actions of a wrong shape or with numbers that are not finite.

    :param actions: of all worlds and agents
    :param shape: expected, (W, N, A)
    :param agents: names of the N agents
    """
    if actions.shape != shape:
        raise ValueError(f"actions have shape {actions.shape}; expected (W, N, A) = {shape}")
    if not np.isfinite(actions).all():
        world, agent, _ = np.argwhere(~np.isfinite(actions))[0]
        raise ValueError(
            f"the action of {agents[agent]} in world {world} is "
            f"{actions[world, agent].tolist()}; expected {shape[2]} finite numbers"
        )
