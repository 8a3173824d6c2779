"""Learning curves of one run: team reward, team cost and multipliers over agent steps."""

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sb3_e2c.zoo.configuration import read_yaml, team_limits
from sb3_e2c.zoo.console import UserError, brief, check_file, write_whole
from sb3_e2c.zoo.figures import tidy
from sb3_e2c.zoo.results import agent_steps, read_table

WINDOW = 100  # episodes, as in the paper's figures
_BLUE, _RED, _GREEN = "#1f6f9f", "#b5403a", "#3a7d44"


def plot_learning(run_folder: str | Path, out: str | Path | None = None) -> Path:
    """Draw what a run has learned, each curve smoothed over the last hundred episodes.

    :param run_folder: What ``train`` wrote, for instance logs/e2c_t/MultiRover-6-3-v0_1
    :param out: The picture; default: learning.png in that folder
    :return: Where the picture is
    :raises UserError: if the folder is no run, or no episode of it has finished
    """
    folder = Path(run_folder)
    out = folder / "learning.png" if out is None else Path(out)
    check_file(out, "--out")
    args, config = _settings(folder)
    progress = read_table(folder / "progress.csv")
    episodes = read_table(folder / "monitor.csv", comment="#")
    try:
        write_whole(out, _draw(args, config, episodes, progress))
    except (ArithmeticError, IndexError, KeyError, TypeError, ValueError) as error:
        raise UserError(
            f"{folder}: monitor.csv or progress.csv is damaged, or none of train: "
            f"{brief(repr(error))}"
        ) from error
    return out


def _draw(
    args: dict[str, Any], config: dict[str, Any], episodes: pd.DataFrame, progress: pd.DataFrame
) -> bytes:
    """The picture, as a PNG file."""
    steps = agent_steps(episodes, progress)
    figure = Figure(figsize=(12, 3.6), layout="constrained", dpi=150)
    reward, cost, multipliers = figure.subplots(1, 3)
    figure.suptitle(f"{args['algo']} on {args['env']}, seed {args['seed']}")
    _curve(reward, steps, episodes["r"], _BLUE)
    reward.set_title("team reward of an episode")
    names = [name for name in episodes.columns if name.startswith("cost")]
    for number, name in enumerate(names):
        label = name if len(names) > 1 else None
        _curve(cost, steps, episodes[name], _RED, label, 1 - 0.3 * number)
    _draw_limits(cost, team_limits(args["env"], config), config.get("cost_limits") is not None)
    cost.set_title("team cost of an episode")
    _draw_multipliers(multipliers, progress)
    for axes in (reward, cost, multipliers):
        tidy(axes)
    picture = io.BytesIO()
    figure.savefig(picture, format="png")
    return picture.getvalue()


def _settings(folder: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """args.yml and config.yml of a run."""
    found = list(folder.glob("*/args.yml"))
    if len(found) != 1:
        raise UserError(f"{folder} is not the folder of one run: it has no */args.yml")
    return read_yaml(found[0]), read_yaml(found[0].with_name("config.yml"))


def _curve(
    axes: Axes,
    steps: np.ndarray,
    values: pd.Series,
    color: str,
    label: str | None = None,
    alpha: float = 1.0,
) -> None:
    window = values.astype(float).rolling(WINDOW, min_periods=1)
    mean, error = window.mean(), window.std().fillna(0.0) / np.sqrt(window.count())
    axes.plot(steps, mean, color=color, label=label, alpha=alpha)
    axes.fill_between(steps, mean - error, mean + error, color=color, alpha=0.2, linewidth=0)


def _draw_limits(axes: Axes, limits: Sequence[float], constrained: bool) -> None:
    for limit in limits:
        text = f"limit {limit:g}" + ("" if constrained else " (not imposed)")
        axes.axhline(limit, color="black", linestyle="--", linewidth=1, label=text)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(frameon=False)


def _draw_multipliers(axes: Axes, progress: pd.DataFrame) -> None:
    names = [name for name in progress.columns if name.startswith("train/lambda")]
    for number, name in enumerate(names):
        rows = progress[["time/total_timesteps", name]].dropna()
        rows = rows.drop_duplicates("time/total_timesteps", keep="last")
        label = name.removeprefix("train/") if len(names) > 1 else None
        axes.plot(*rows.to_numpy().T, color=_GREEN, alpha=1 - 0.3 * number, label=label)
    if not names:
        axes.text(0.5, 0.5, "no constraint", ha="center", va="center", transform=axes.transAxes)
    elif len(names) > 1:
        axes.legend(frameon=False)
    axes.set_title("Lagrange multiplier λ")
