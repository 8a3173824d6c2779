"""Figures of a suite: curves as the paper draws them, and where each method ends."""

from collections.abc import Mapping, Sequence
from itertools import count
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from sb3_e2c.zoo.aggregate import (
    bootstrap_interval,
    interquartile_mean,
    mean_and_error,
    on_common_steps,
)
from sb3_e2c.zoo.results import Result
from sb3_e2c.zoo.suite import Experiment, Method

# One color for each algorithm, everywhere: those of Okabe and Ito, which color-blind people can
# tell apart. Variants of an algorithm differ in their lines.
_COLORS = {
    "mappo": "#000000",
    "c_mappo": "#E69F00",
    "c_mappo_pe": "#CC79A7",
    "e2c": "#56B4E9",
    "e2c_t": "#0072B2",
}
_DASHES: tuple[tuple[float, ...], ...] = (
    *((1, 0), (5, 2), (1.5, 1.5)),
    *((7, 2, 1.5, 2), (3, 1, 1, 1, 1, 1)),
    *((10, 4), (1, 3), (8, 1.5, 1.5, 1.5, 1.5, 1.5)),
)
_MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<")
_LETTERS = 4.5  # of a legend's name, for each inch of the figure, so that two stand side by side
_LIMIT: dict[str, Any] = {"color": "#444444", "linestyle": (0, (1, 1)), "linewidth": 1.2}


class Look:
    """How the methods of a suite are drawn, alike in all figures.

    :param methods: All methods of the suite
    """

    def __init__(self, methods: Mapping[str, Method]):
        variants = {method.algo: count() for method in methods.values()}
        self._variant = {label: next(variants[each.algo]) for label, each in methods.items()}
        self._methods = methods

    def name(self, label: str) -> str:
        """Name of a method for people."""
        return self._methods[label].name

    def color(self, label: str) -> str:
        """Color of its algorithm."""
        return _COLORS.get(self._methods[label].algo, "#009E73")

    def dashes(self, label: str) -> tuple[float, ...]:
        """Its line: solid for the first variant of an algorithm in the suite."""
        return _DASHES[self._variant[label] % len(_DASHES)]

    def marker(self, label: str) -> str:
        """Its symbol."""
        return _MARKERS[self._variant[label] % len(_MARKERS)]


def tidy(axes: Axes) -> None:
    """The look of axes with agent steps.

    :param axes: With everything drawn
    """
    axes.set_xlabel("agent steps")
    axes.set_xlim(left=0)
    if axes.dataLim.ymin >= 0:
        axes.set_ylim(bottom=0)
    axes.ticklabel_format(axis="x", style="sci", scilimits=(0, 0), useMathText=True)
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)


def shown(results: Sequence[Result]) -> list[Result]:
    """The runs of a method that a curve is drawn of: the finished ones, or else the others.

    :param results: Of one method on one environment
    """
    begun = [result for result in results if result.curve is not None]
    return [result for result in begun if result.finished] or begun


def draw_curves(
    experiment: Experiment, groups: Mapping[tuple[str, str], Sequence[Result]], look: Look
) -> Figure | None:
    """Reward and cost over agent steps, a row for each environment.

    Lines are means over seeds of the means over each window of episodes, bands their standard
    errors.

    :param experiment: What the figure compares
    :param groups: Results by environment and method
    :param look: How methods are drawn
    :return: None if no episode has finished
    """
    envs = [env for env in experiment.envs if _all(env, experiment.methods, groups)]
    if not envs:
        return None
    costs = _cost_names([each for env in envs for each in _all(env, experiment.methods, groups)])
    columns = ["reward", *costs]
    figure, table = _grid(len(envs), len(columns), row_height=2.6)
    for row, env in zip(table, envs, strict=True):
        for axes, column in zip(row, columns, strict=True):
            for label in experiment.methods:
                _draw_curve(axes, shown(groups.get((env, label), ())), column, look, label)
            _draw_limit(axes, _all(env, experiment.methods, groups), column)
            axes.set_ylabel(_words(column))
            tidy(axes)
        row[0].set_title(env, loc="left", fontweight="bold")
        counts = [len(shown(groups.get((env, label), ()))) for label in experiment.methods]
        row[0].set_title(_seeds(counts), loc="right", fontsize="small", color="#444444")
    drawn = [
        label for label in experiment.methods if any(_all(env, [label], groups) for env in envs)
    ]
    _legend(figure, drawn, look, limit=bool(costs))
    return figure


def _grid(n_rows: int, n_columns: int, row_height: float) -> tuple[Figure, np.ndarray]:
    size = (4.6 * n_columns, row_height * n_rows + 0.7)
    figure = Figure(figsize=size, layout="constrained", dpi=150)
    return figure, figure.subplots(n_rows, n_columns, squeeze=False)


def _all(
    env: str, labels: Sequence[str], groups: Mapping[tuple[str, str], Sequence[Result]]
) -> list[Result]:
    return [result for label in labels for result in shown(groups.get((env, label), ()))]


def _seeds(counts: Sequence[int]) -> str:
    """How many seeds the lines of one row are means of."""
    least, most = min(n for n in counts if n), max(counts)
    span = str(most) if least == most else f"{least} to {most}"
    return f"{span} seed" if most == 1 else f"{span} seeds"


def _cost_names(results: Sequence[Result]) -> list[str]:
    names = {name: None for each in results if each.curve is not None for name in each.curve}
    return [name for name in names if name.startswith("cost")]


def _words(column: str) -> str:
    kind, _, number = column.replace("return", "reward").partition("_")
    return f"team {kind} {number}".strip()


def _draw_curve(axes: Axes, results: Sequence[Result], column: str, look: Look, label: str) -> None:
    curves = [each.curve for each in results if each.curve is not None and column in each.curve]
    if not curves:
        return
    steps, values = on_common_steps(
        [curve["agent_steps"].to_numpy(float) for curve in curves],
        [curve[column].to_numpy(float) for curve in curves],
    )
    mean, error = mean_and_error(values)
    color = look.color(label)
    axes.plot(steps, mean, color=color, dashes=look.dashes(label), linewidth=1.6)
    axes.fill_between(steps, mean - error, mean + error, color=color, alpha=0.2, linewidth=0)


def _draw_limit(axes: Axes, results: Sequence[Result], column: str) -> None:
    for limit in sorted(_limits(results, column)):
        axes.axhline(limit, **_LIMIT)


def _limits(results: Sequence[Result], column: str) -> set[float]:
    if not column.startswith("cost"):
        return set()
    name = column.replace("cost", "limit")
    curves = [each.curve for each in results if each.curve is not None]
    return {float(curve[name].iloc[0]) for curve in curves if name in curve}


def _legend(figure: Figure, labels: Sequence[str], look: Look, limit: bool) -> None:
    handles = [
        Line2D([], [], color=look.color(label), dashes=look.dashes(label), linewidth=1.8)
        for label in labels
    ]
    names = [look.name(label) for label in labels]
    if limit:
        handles.append(Line2D([], [], **_LIMIT))
        names.append("limit of the team's cost")
    columns = 2 if max(map(len, names)) <= _LETTERS * figure.get_figwidth() else 1
    style: dict[str, Any] = {"ncols": columns, "handlelength": 4, "frameon": False}
    figure.legend(handles, names, loc="outside upper center", **style)


def draw_finals(experiment: Experiment, finals: pd.DataFrame, look: Look) -> Figure | None:
    """Evaluated return and cost after training: seeds, interquartile means, their intervals.

    :param experiment: What the figure compares
    :param finals: Sampled rows of :func:`sb3_e2c.zoo.results.final_numbers`
    :param look: How methods are drawn
    :return: None if no run has finished
    """
    ours = finals[finals["env"].isin(experiment.envs) & finals["label"].isin(experiment.methods)]
    envs = [env for env in experiment.envs if (ours["env"] == env).any()]
    if not envs:
        return None
    columns = [name for name in ours if name == "return" or name.startswith("cost")]
    methods = [label for label in experiment.methods if (ours["label"] == label).any()]
    height = 0.33 * len(methods) + 0.9
    figure, table = _grid(len(envs), len(columns), row_height=height)
    for row, env in zip(table, envs, strict=True):
        for axes, column in zip(row, columns, strict=True):
            _draw_final(axes, ours[ours["env"] == env], column, methods, look)
        row[0].set_title(env, loc="left", fontweight="bold")
        row[0].set_yticks(range(len(methods)), map(look.name, methods))
    return figure


def _draw_final(
    axes: Axes, finals: pd.DataFrame, column: str, labels: Sequence[str], look: Look
) -> None:
    for place, label in enumerate(labels):
        values = finals.loc[finals["label"] == label, column].dropna().to_numpy(float)
        if values.size:
            _draw_seeds(axes, place, values, look, label)
    if column.startswith("cost"):
        for limit in finals[column.replace("cost", "limit")].dropna().unique():
            axes.axvline(limit, **_LIMIT)
    axes.set_ylim(len(labels) - 0.4, -0.6)
    axes.set_yticks([])
    axes.set_xlabel(_words(column))
    axes.xaxis.set_major_locator(MaxNLocator(4))
    axes.margins(x=0.08)
    axes.grid(axis="x", alpha=0.25)
    axes.spines[["top", "right", "left"]].set_visible(False)


def _draw_seeds(axes: Axes, place: int, values: np.ndarray, look: Look, label: str) -> None:
    color = look.color(label)
    axes.plot(values, np.full(len(values), place), "|", color=color, alpha=0.7, markersize=9)
    interval = bootstrap_interval(values)
    if interval is not None:
        axes.plot(interval, [place, place], color=color, linewidth=3, alpha=0.45)
    axes.plot(interquartile_mean(values), place, look.marker(label), color=color, markersize=6)
