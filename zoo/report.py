"""Tables of a suite in CSV and Markdown, and one HTML page that needs nothing else."""

import base64
import html
import io
from collections.abc import Iterable, Mapping, Sequence
from itertools import product
from typing import Any

import numpy as np
import pandas as pd
from matplotlib import rc_context
from matplotlib.figure import Figure

from sb3_e2c.zoo.aggregate import (
    bootstrap_interval,
    compare,
    first_step_near_peak,
    holm,
    interquartile_mean,
    mean_and_error,
    on_common_steps,
    smallest_mann_whitney,
)
from sb3_e2c.zoo.figures import shown
from sb3_e2c.zoo.results import Result
from sb3_e2c.zoo.suite import Experiment, Suite

Groups = Mapping[tuple[str, str], Sequence[Result]]
SIGNIFICANT = 0.05


def measures(table: pd.DataFrame) -> list[str]:
    """Names of the columns that methods are judged by: the return, and each cost.

    :param table: See :func:`sb3_e2c.zoo.results.final_numbers`
    """
    return [name for name in table if name == "return" or str(name).startswith("cost")]


def summary_table(finals: pd.DataFrame, groups: Groups) -> pd.DataFrame:
    """A row for each method, environment and mode of evaluation.

    :param finals: See :func:`sb3_e2c.zoo.results.final_numbers`
    :param groups: Results by environment and label
    :return: ``env, label, mode, seeds``; of each measure ``_mean, _se, _iqm, _low, _high`` over
        seeds; ``limit``s; ``violation`` (share of episodes over a limit, mean over seeds),
        ``within_limit`` (share of seeds whose mean costs keep the limits), ``lambda``,
        ``steps_to_90`` (agent steps until 90 % of the rise of the mean training curve)
    """
    rows = []
    for (env, label, mode), runs in finals.groupby(["env", "label", "mode"], sort=False):
        row = {"env": env, "label": label, "mode": mode, "seeds": len(runs)}
        for name in measures(finals):
            row |= _statistics(name, runs[name].dropna().to_numpy(float))
        limits = runs[[name for name in runs if str(name).startswith("limit")]]
        row |= limits.iloc[0].to_dict()
        row["violation"] = runs["violation"].mean()
        row["within_limit"] = _within(runs)
        row["lambda"] = runs["lambda"].mean()
        row["steps_to_90"] = _steps_to_90(groups.get((env, label), ()))
        rows.append(row)
    return pd.DataFrame(rows)


def _statistics(name: str, values: np.ndarray) -> dict[str, float]:
    if not values.size:
        return {}
    mean, error = mean_and_error(values)
    low, high = bootstrap_interval(values) or (np.nan, np.nan)
    return {
        f"{name}_mean": float(mean),
        f"{name}_se": float(error) if len(values) > 1 else np.nan,
        f"{name}_iqm": float(interquartile_mean(values)),
        f"{name}_low": low,
        f"{name}_high": high,
    }


def _within(runs: pd.DataFrame) -> float:
    """Share of seeds whose mean costs are within all limits; NaN where there is no limit."""
    costs = [name for name in runs if str(name).startswith("cost")]
    limits = runs[[name.replace("cost", "limit") for name in costs]].to_numpy(float)
    if not costs or np.isnan(limits).all():
        return np.nan
    return float((runs[costs].to_numpy(float) <= limits).all(axis=1).mean())


def _steps_to_90(results: Sequence[Result]) -> float:
    curves = [each.curve for each in shown(results) if each.curve is not None]
    if not curves:
        return np.nan
    steps = [curve["agent_steps"].to_numpy(float) for curve in curves]
    grid, values = on_common_steps(steps, [curve["reward"].to_numpy(float) for curve in curves])
    return first_step_near_peak(grid, values.mean(axis=0))


def comparison_table(experiment: Experiment, finals: pd.DataFrame) -> pd.DataFrame:
    """Each method of an experiment against each of its baselines, with sampled actions.

    :param experiment: Names the baselines
    :param finals: See :func:`sb3_e2c.zoo.results.final_numbers`
    :return: ``experiment, env, label, baseline, measure, seeds, baseline_seeds, difference, low,
        high, welch, welch_holm, mann_whitney, smallest_mann_whitney``; ``welch_holm`` is adjusted
        for all comparisons of the same measure in the experiment
    """
    sampled = finals[finals["mode"] == "sampled"]
    rows = []
    for measure in measures(finals):
        tests = list(_tests(experiment, sampled, measure))
        adjusted = holm([test["welch"] for test in tests])
        rows += [test | {"welch_holm": p} for test, p in zip(tests, adjusted, strict=True)]
    return pd.DataFrame(rows)


def _tests(experiment: Experiment, finals: pd.DataFrame, measure: str) -> Iterable[dict[str, Any]]:
    values = {key: runs[measure].dropna() for key, runs in finals.groupby(["env", "label"])}
    ours = [label for label in experiment.methods if label not in experiment.baselines]
    for env, label, baseline in product(experiment.envs, ours, experiment.baselines):
        mine, theirs = (values.get((env, name), pd.Series()) for name in (label, baseline))
        result = compare(mine.to_numpy(float), theirs.to_numpy(float))
        if result is not None:
            names = {"env": env, "label": label, "baseline": baseline, "measure": measure}
            n, m = len(mine), len(theirs)
            counts = {"seeds": n, "baseline_seeds": m}
            least = {"smallest_mann_whitney": smallest_mann_whitney(n, m)}
            yield {"experiment": experiment.id} | names | counts | result._asdict() | least


# ------------------------------------------------------------------------------ for people


def readable_summary(
    experiment: Experiment, summary: pd.DataFrame, suite: Suite, mode: str
) -> pd.DataFrame:
    """The rows of one experiment in words and rounded numbers.

    :param experiment: The experiment
    :param summary: See :func:`summary_table`
    :param suite: Knows the names of methods
    :param mode: Of the evaluation
    """
    rows = {(row["env"], row["label"], row["mode"]): row for _, row in summary.iterrows()}
    wanted = product(experiment.envs, experiment.methods, [mode])
    return pd.DataFrame([_readable_row(rows[key], suite) for key in wanted if key in rows])


def _readable_row(row: "pd.Series[Any]", suite: Suite) -> dict[str, str]:
    cells = {
        "task": str(row["env"]),
        "method": suite.methods[str(row["label"])].name,
        "seeds": str(row["seeds"]),
    }
    names = [name.removesuffix("_mean") for name in row.index if name.endswith("_mean")]
    for name in names:
        digits = 3 if name == "return" else 1
        cells[name] = plus_minus(row[f"{name}_mean"], row[f"{name}_se"], digits)
        middle, ends = row[f"{name}_iqm"], (row[f"{name}_low"], row[f"{name}_high"])
        cells[f"{name}, IQM"] = f"{number(middle, digits)} {interval(*ends, digits)}".strip()
        if name.startswith("cost"):
            cells[name.replace("cost", "limit")] = number(row[name.replace("cost", "limit")], None)
    cells["episodes over the limit"] = percent(row["violation"])
    cells["seeds within the limit"] = percent(row["within_limit"])
    cells["λ"] = number(row["lambda"], 2)
    cells["steps to 90 %"] = steps(row["steps_to_90"])
    return cells


def readable_comparisons(comparisons: pd.DataFrame, suite: Suite) -> pd.DataFrame:
    """Comparisons in words and rounded numbers.

    :param comparisons: See :func:`comparison_table`
    :param suite: Knows the names of methods
    """
    rows = []
    for _, row in comparisons.iterrows():
        digits = 3 if row["measure"] == "return" else 1
        sure = row["welch_holm"] < SIGNIFICANT
        ends = interval(row["low"], row["high"], digits)
        rows.append(
            {
                "task": row["env"],
                "method": suite.methods[row["label"]].name,
                "against": suite.methods[row["baseline"]].name,
                "measure": row["measure"],
                "difference": f"{row['difference']:+.{digits}f} {ends}",
                "seeds": f"{row['seeds']} / {row['baseline_seeds']}",
                "p (Welch)": p_value(row["welch"]),
                "p (Welch, Holm)": p_value(row["welch_holm"]) + (" *" if sure else ""),
                "p (Mann-Whitney)": p_value(row["mann_whitney"]),
            }
        )
    return pd.DataFrame(rows)


def readable_crossplay(
    experiment: Experiment, crossplay: pd.DataFrame, suite: Suite
) -> pd.DataFrame:
    """Return and cost of each method against the same opponents, ± standard error over seeds.

    :param experiment: The experiment
    :param crossplay: See ``sb3_e2c.zoo.crossplay``
    :param suite: Knows the names of methods
    """
    groups = dict(iter(crossplay.groupby(["env", "label"])))
    wanted = [key for key in product(experiment.envs, experiment.methods) if key in groups]
    return pd.DataFrame([_crossplay_row(groups[key], suite) for key in wanted])


def _crossplay_row(rows: pd.DataFrame, suite: Suite) -> dict[str, str]:
    first = rows.iloc[0]
    cells = {"task": str(first["env"]), "method": suite.methods[str(first["label"])].name}
    cells["seeds"] = str(rows["seed"].nunique())
    kinds = rows["opponent"].str.split("/").str[0]  # of a pool, all seeds together
    seeds = rows.groupby([kinds, "seed"])[measures(rows)].mean()
    for kind in sorted(set(kinds), key=lambda kind: (kind not in ("own", "random"), kind)):
        for name in measures(rows):
            values = seeds.loc[kind, name].to_numpy(float)
            error = float(mean_and_error(values)[1]) if len(values) > 1 else np.nan
            cells[f"{name}, {kind}"] = plus_minus(float(values.mean()), error, 1)
    return cells


def number(value: float, digits: int | None) -> str:
    """A rounded number; a dash for none.

    :param value: The number
    :param digits: Behind the point; None: as few as needed
    """
    if pd.isna(value):
        return "–"
    return f"{value:g}" if digits is None else f"{value:.{digits}f}"


def plus_minus(mean: float, error: float, digits: int) -> str:
    """Mean ± standard error, as far as they are known."""
    known = not pd.isna(error)
    return number(mean, digits) + (f" ± {number(error, digits)}" if known else "")


def interval(low: float, high: float, digits: int) -> str:
    """[low, high], or nothing if it is unknown."""
    return "" if pd.isna(low) else f"[{number(low, digits)}, {number(high, digits)}]"


def percent(share: float) -> str:
    """A share; a dash for none."""
    return "–" if pd.isna(share) else f"{share:.0%}"


def steps(value: float) -> str:
    """Agent steps with three digits."""
    return "–" if pd.isna(value) else f"{float(f'{value:.3g}'):,.0f}"


def p_value(p: float) -> str:
    """A p-value as it is printed."""
    return "< 0.001" if p < 0.001 else f"{p:.3f}"


def how_to_read(seeds: Sequence[int]) -> list[str]:
    """What the numbers mean, and what they cannot say.

    :param seeds: How many seeds the methods have
    """
    fewest = min(seeds, default=0)
    sentences = [
        "Return and cost are those of the whole team in an episode, averaged over the evaluation "
        "episodes of a trained policy (with sampled actions unless said otherwise), then over "
        "seeds, ± standard error over seeds. IQM: interquartile mean over seeds with its 95 % "
        "percentile bootstrap interval (none for fewer than 3 seeds).",
        "Curves: mean over seeds of the means over windows of training episodes, with the standard "
        "error over seeds as a band; the dotted line is the limit. Without finished runs, those "
        "that have begun are drawn as far as all of them have come.",
        "p: Welch's two-sided t-test between the seeds of two methods, plain and adjusted by "
        "Holm's method for all comparisons of one measure in the figure (* below 0.05). It takes "
        "the means of seeds to be roughly normal; the Mann-Whitney test does not.",
    ]
    if 0 < fewest < 5:
        least = smallest_mann_whitney(fewest, fewest)
        sentences.append(
            f"There are only {fewest} seeds of some methods. With {fewest} against {fewest} the "
            f"Mann-Whitney test cannot give less than p = {least:.2g}, bootstrap intervals are too "
            "narrow, and one odd seed can carry a t-test: read such rows as hints, and a missing "
            "difference as not seen rather than not there."
        )
    return sentences


def markdown_table(table: pd.DataFrame) -> str:
    """A table in Markdown.

    :param table: Of strings
    """
    if table.empty:
        return "No finished runs.\n"
    rows = [list(table.columns), ["---"] * len(table.columns), *table.to_numpy().tolist()]
    return "".join(f"| {' | '.join(_cell(cell) for cell in row)} |\n" for row in rows)


def _cell(text: object) -> str:
    return str(text).replace("|", "\\|").replace("nan", "–")


# ------------------------------------------------------------------------------ HTML

_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 75rem; margin: 2rem auto; padding: 0 1rem;
  color: #1a1a1a; background: #fff; }
h1, h2, h3 { line-height: 1.2; } h2 { margin-top: 3rem; border-bottom: 1px solid #ccc; }
img { width: min(100%, 64rem); height: auto; display: block; margin: 1rem 0; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: .85rem; margin: 1rem 0; }
th, td { padding: .25rem .6rem; text-align: right; border-bottom: 1px solid #ddd; }
td { white-space: nowrap; }
th:nth-child(-n+2), td:nth-child(-n+2) { text-align: left; }
th { vertical-align: bottom; }
.note { color: #444; font-size: .9rem; }
"""


def html_page(title: str, body: Iterable[str]) -> str:
    """A whole page that refers to nothing outside of it.

    :param title: Its title
    :param body: Pieces of HTML
    """
    head = "<meta charset='utf-8'><meta name='viewport' content='width=device-width'>"
    return (
        f"<!DOCTYPE html>\n<html lang='en'>\n<head>{head}<title>{html.escape(title)}</title>"
        f"<style>{_STYLE}</style></head>\n<body>\n<h1>{html.escape(title)}</h1>\n"
        + "\n".join(body)
        + "\n</body>\n</html>\n"
    )


def html_text(tag: str, text: str, kind: str = "") -> str:
    """A piece of text.

    :param tag: Its element
    :param text: Not escaped yet
    :param kind: Its class
    """
    attribute = f" class='{kind}'" if kind else ""
    return f"<{tag}{attribute}>{html.escape(text)}</{tag}>"


def html_table(table: pd.DataFrame) -> str:
    """A table that scrolls sideways where the page is narrow.

    :param table: Of strings
    """
    if table.empty:
        return html_text("p", "No finished runs.", "note")
    body = table.to_html(index=False, border=0, na_rep="–", classes=[])
    return f"<div class='wide'>{body}</div>"


def html_figure(figure: Figure, description: str) -> str:
    """A figure inside the page.

    :param figure: The figure
    :param description: For those who do not see it
    """
    content = base64.b64encode(svg(figure)).decode()
    alt = html.escape(description, quote=True)
    return f"<img alt='{alt}' src='data:image/svg+xml;base64,{content}'>"


def svg(figure: Figure) -> bytes:
    """A figure as SVG, the same bytes for the same figure.

    :param figure: The figure
    """
    with rc_context({"svg.hashsalt": "sb3_e2c"}):
        return _saved(figure, "svg", metadata={"Date": None})


def png(figure: Figure) -> bytes:
    """A figure as PNG.

    :param figure: The figure
    """
    return _saved(figure, "png")


def _saved(figure: Figure, kind: str, **options: Any) -> bytes:
    picture = io.BytesIO()
    figure.savefig(picture, format=kind, **options)
    return picture.getvalue()
