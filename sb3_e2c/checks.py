"""What the answers of environments must be like, and where they are not.

Every message names the world, the agent and the quantity. Shapes: W worlds, N agents,
S = W·N slots, slot = world·N + agent, M costs.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces

# What the two calls of a parallel environment return, each by agent
_ANSWERS = {
    "reset": ("observations", "infos"),
    "step": ("observations", "rewards", "terminations", "truncations", "infos"),
}
# Spaces that know whether they contain something; boxes are looked at more closely
_COUNTING = (spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)
_REAL = "biuf"  # kinds of NumPy's types that are real numbers


@contextmanager
def named_world(call: str, world: int) -> Iterator[None]:
    """Say of an error in the environment's own code which world it comes from.

    :param call: "reset" or "step"
    :param world: number of the world
    """
    try:
        yield
    except SystemExit as error:  # it would end the program, and from a worker without a word
        raise RuntimeError(
            f"{call}() of world {world} called sys.exit({error.code!r}); expected it to return, or "
            "to raise an error that says what is wrong"
        ) from error
    except Exception as error:
        if hasattr(error, "add_note"):  # from Python 3.11 on; its type and message stay as they are
            error.add_note(f"The error was raised by {call}() of world {world}.")
        raise


def check_answer(call: str, answer: Any, world: int) -> Sequence[Mapping[str, Any]]:
    """Refuse what no parallel environment returns, such as the answer of a single-agent one.

    :param call: "reset" or "step"
    :param answer: what it returned
    :param world: number of the world
    :return: the answer, one mapping from agents for each kind
    """
    kinds = _ANSWERS[call]
    is_sequence = isinstance(answer, (tuple, list))
    parts = answer if is_sequence else [answer]
    if is_sequence and len(parts) == len(kinds) and all(isinstance(p, Mapping) for p in parts):
        return parts
    found = ", ".join(type(part).__name__ for part in parts)
    raise ValueError(
        f"{call}() of world {world} returned {found}; expected {len(kinds)} dicts by agent: "
        f"{', '.join(kinds)}"
    )


def check_finite(
    agents: Sequence[str],
    when: str,
    worlds: np.ndarray | None = None,
    **quantities: np.ndarray,
) -> None:
    """Stop before a number that is not finite reaches the networks or a result.

    :param agents: names of the N agents of a world
    :param when: the moment, such as "at step 3 of the rollout"
    :param worlds: numbers of the w worlds that the arrays are about; None: all
    :param quantities: arrays by name, shape (w·N, ...)
    :raises ValueError: that names world, agent and quantity
    """
    for name, array in quantities.items():
        finite = np.isfinite(array)
        if not finite.all():
            place, odd = _place(~finite, agents, worlds), array[tuple(np.argwhere(~finite)[0])]
            raise ValueError(
                f"{name} of {place} is not finite {when}: {odd}. Nothing is learned from it, the "
                "model keeps its last parameters; mend the environment, or bound this quantity"
            )


def check_costs(agents: Sequence[str], when: str, costs: np.ndarray, limited: bool) -> None:
    """Refuse costs that are not finite, and negative ones where they are limited.

    A negative cost would pay for violations elsewhere in the episode, and is most often a cost
    with the sign of a reward: the limit would then reward what it should prevent.

    :param agents: names of the N agents
    :param when: see :func:`check_finite`
    :param costs: shape (W, N, M)
    :param limited: whether there are limits, or the costs are only watched
    :raises ValueError: that names world and agent
    """
    slots = costs.reshape(costs.shape[0] * costs.shape[1], costs.shape[2])
    check_finite(agents, when, cost=slots)
    negative = slots < 0
    if limited and negative.any():
        raise ValueError(
            f"cost of {_place(negative, agents)} is negative {when}: {slots[negative][0]}; "
            "expected 0 or more, because a cost is harm and its limit an upper one. Turn its sign, "
            "or add a constant to it in every step, and as much for a whole episode to its limit"
        )


def _place(odd: np.ndarray, agents: Sequence[str], worlds: np.ndarray | None = None) -> str:
    """World and agent of the first odd slot.

    :param odd: shape (w·N, ...)
    :param agents: names of the N agents
    :param worlds: numbers of the w worlds; None: all
    """
    row, agent = divmod(int(np.argwhere(odd)[0, 0]), len(agents))
    return f"world {row if worlds is None else worlds[row]}, agent {agents[agent]!r}"


def fitting(found: Any, space: spaces.Space) -> Any:
    """An observation as its space has it.

    :param found: what the environment returned
    :param space: the agent's own
    :return: a copy in the space's type if it is a box; None if it does not belong there
    """
    if isinstance(space, spaces.Box):
        return _in_box(found, space)
    return found if not isinstance(space, _COUNTING) or space.contains(found) else None


def number(found: Any) -> Any:
    """The number that was found.

    :param found: a reward or a flag
    :return: None if it is no number, or more than one
    """
    if isinstance(found, (bool, int, float)):
        return found
    try:
        array = np.asarray(found)
    except ValueError:  # rows of different lengths
        return None
    return array.item() if array.ndim == 0 and array.dtype.kind in _REAL else None


def described(found: Any) -> str:
    """What was found, by its shape if it is an array.

    :param found: anything
    """
    if isinstance(found, np.ndarray) and found.ndim:
        return f"an array of shape {found.shape} and type {found.dtype}"
    return repr(found) if len(repr(found)) <= 80 else f"an object of type {type(found).__name__}"


def as_type(array: np.ndarray, dtype: Any) -> np.ndarray | None:
    """Numbers in another type; too large ones become infinite.

    :param array: of any type
    :param dtype: the other type
    :return: the array itself if it is of that type already; None if its numbers do not fit
    """
    if array.dtype == dtype:
        return array
    if array.dtype.kind not in _REAL:
        return None
    with np.errstate(over="ignore", invalid="ignore"):
        copy = array.astype(dtype)
    return copy if copy.dtype.kind == "f" or np.array_equal(copy, array) else None


def _in_box(found: Any, space: spaces.Box) -> np.ndarray | None:
    try:
        array = np.asarray(found)
    except ValueError:  # rows of different lengths
        return None
    typed = as_type(array, space.dtype) if array.shape == space.shape else None
    return typed.copy() if typed is array else typed


class Form(NamedTuple):
    """What the arrays of a simulator must be like."""

    n_worlds: int
    n_agents: int
    space: spaces.Space  # of an agent's observations

    def observations(self, call: str, found: Any, n_worlds: int) -> np.ndarray:
        """Observations in the type of their space, shape (R, N, ...).

        :param call: "reset" or "step"
        :param found: what it returned
        :param n_worlds: R
        """
        shape = (n_worlds, self.n_agents, *(self.space.shape or ()))
        array = check_array(call, "observations", found, shape)
        typed = as_type(array, self.space.dtype)
        if typed is None:
            raise ValueError(
                f"{call}() of the simulator returned observations of type {array.dtype}; expected "
                f"numbers that {self.space.dtype}, the type of their space, can hold"
            )
        return typed


def check_parts(call: str, answer: Any, n_parts: int) -> tuple[Any, ...]:
    """Refuse an answer of another simulator's kind.

    :param call: "reset" or "step"
    :param answer: what it returned
    :param n_parts: how many parts it must have
    """
    if not isinstance(answer, tuple) or len(answer) != n_parts:
        found = f"a tuple of {len(answer)}" if isinstance(answer, tuple) else type(answer).__name__
        raise ValueError(f"{call}() of the simulator returned {found}; expected {n_parts} parts")
    return answer


def check_simulator(sim: Any, n_worlds: int, agents: Sequence[str]) -> Any:
    """Refuse a simulator of other worlds than were asked for.

    :param sim: has W worlds
    :param n_worlds: how many it must have
    :param agents: names of the agents that it must have
    :return: the simulator
    """
    groups = getattr(sim, "groups", None)
    found = list(sim.possible_agents) if groups is None else [a for g in groups.values() for a in g]
    if sim.n_worlds != n_worlds or sorted(found) != sorted(agents):
        raise ValueError(
            f"the simulator {type(sim).__name__} has {sim.n_worlds} worlds of {found}; expected "
            f"{n_worlds} of {list(agents)}, as its environment was asked for"
        )
    return sim


def check_fresh(observations: Any, last: np.ndarray | None) -> Any:
    """Refuse a simulator that writes into the array that it has returned before.

    :param observations: of this step
    :param last: of the step before
    :return: the observations
    """
    same = isinstance(observations, np.ndarray) and last is not None
    if same and np.may_share_memory(observations, last):
        raise ValueError(
            "step() of the simulator returned the array of the step before again; expected a new "
            "one at every step, because learners keep them: return observations.copy()"
        )
    return observations


def check_array(call: str, name: str, found: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Refuse what is no array of a shape.

    :param call: "reset" or "step"
    :param name: what it is
    :param found: what was returned as it
    :param shape: what it must have, (W, N, ...)
    :return: the array
    """
    if isinstance(found, np.ndarray) and found.shape == shape:
        return found
    is_array = isinstance(found, np.ndarray)
    kind = f"shape {found.shape}" if is_array else f"type {type(found).__name__}"
    raise ValueError(
        f"{call}() of the simulator returned {name} of {kind}; expected an array of shape {shape}: "
        "worlds, then agents"
    )
