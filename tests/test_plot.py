"""Many seeds as curves, intervals and tests; figures, tables and the report."""

import json
import re
from html.parser import HTMLParser

import numpy as np
import pandas as pd
import pytest

pytest.importorskip("rl_zoo3")

from sb3_e2c.zoo import cli
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
from sb3_e2c.zoo.figures import Look, draw_curves
from sb3_e2c.zoo.plot import plot_suite
from sb3_e2c.zoo.report import comparison_table, how_to_read, markdown_table, summary_table, svg
from sb3_e2c.zoo.results import final_numbers, find_results
from sb3_e2c.zoo.suite import Experiment, Method, find_suite, read_suite

ENV = "MultiRover-6-3-v0"
SUITE = f"""
title: A <small> suite
seeds: 3
methods:
  mappo: {{name: MAPPO}}
  e2c_t: {{name: E2C (T)}}
  e2c_t-pure: {{name: "E2C (T), bonus only", algo: e2c_t, preset: pure}}
experiments:
  fig3:
    {{figure: Fig. 3, title: Rovers, envs: [{ENV}], methods: [mappo, e2c_t], baselines: [mappo]}}
  later: {{envs: [SafeAnt-2x4-v0], methods: [e2c_t-pure]}}
"""
MACHINE = {"cores": 2, "cpu": "a processor", "system": "Linux"}


def write_run(folder, label, seed, final, cost, finished=True):
    """What a job leaves: a curve that rises to ``final``, and its evaluations."""
    place = folder / ENV / label / f"seed_{seed}"
    place.mkdir(parents=True)
    rows = [[100 * k, 1000 * k, k, final * k / 4, cost, 20, 0.5, 0.1] for k in range(1, 5)]
    names = ["episodes", "agent_steps", "seconds", "reward", "cost", "limit", "violation", "lambda"]
    pd.DataFrame(rows, columns=names).to_csv(place / "curve.csv", index=False)
    if not finished:
        return
    result = {"team_return": final, "team_cost": cost, "cost_limits": [20.0], "lambda": 0.5}
    result["violation_rate"] = 0.25
    evaluation = {"sampled": result, "deterministic": {**result, "team_return": 2 * final}}
    (place / "evaluation.json").write_text(json.dumps(evaluation))
    record = {"training_seconds": 60.0, "machine": MACHINE, "versions": {"python": "3.11"}}
    (place / "run.json").write_text(json.dumps(record))


@pytest.fixture
def folder(tmp_path):
    """Small files of three seeds of two methods, as they might be committed."""
    folder = tmp_path / "results" / "tiny"
    folder.mkdir(parents=True)
    (folder / "suite.yml").write_text(SUITE)
    for seed in range(3):
        write_run(folder, "mappo", seed, final=0.5 + 0.1 * seed, cost=100.0 + seed)
        write_run(folder, "e2c_t", seed, final=0.8 + 0.1 * seed, cost=18.0 + 2 * seed)
    return folder


def refusal(capsys, argv):
    with pytest.raises(SystemExit) as exit_:
        cli.main(["plot", *map(str, argv)])
    assert exit_.value.code == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1, lines
    return lines[0]


# ---------------------------------------------------------------------------- statistics


def test_the_standard_error_is_over_seeds():
    mean, error = mean_and_error(np.array([[1.0, 5.0], [3.0, 5.0]]))
    assert mean.tolist() == [2.0, 5.0]
    assert error.tolist() == [1.0, 0.0]  # sqrt(2) / sqrt(2)
    assert mean_and_error(np.array([4.0]))[1] == 0.0


def test_equal_steps_are_kept_and_others_are_interpolated_where_all_curves_are():
    same = np.array([1.0, 2.0])
    grid, values = on_common_steps([same, same], [np.array([0.0, 1.0]), np.array([2.0, 3.0])])
    assert grid.tolist() == [1.0, 2.0]
    assert values.tolist() == [[0.0, 1.0], [2.0, 3.0]]
    grid, values = on_common_steps(
        [np.array([0.0, 10.0]), np.array([2.0, 6.0])], [np.array([0.0, 10.0]), np.array([1.0, 1.0])]
    )
    assert (grid[0], grid[-1]) == (2.0, 6.0)
    np.testing.assert_allclose(values[0], grid)
    np.testing.assert_allclose(values[1], 1.0)


def test_the_interquartile_mean_drops_a_quarter_at_each_end():
    assert interquartile_mean(np.array([100.0, 1.0, 2.0, -50.0])) == 1.5
    assert interquartile_mean(np.array([1.0, 2.0, 9.0])) == 4.0  # a quarter of three is none


def test_the_bootstrap_interval_stays_within_the_seeds():
    values = np.array([1.0, 2.0, 3.0, 4.0, 10.0])
    low, high = bootstrap_interval(values)
    assert 1.0 <= low < interquartile_mean(values) < high <= 10.0
    assert bootstrap_interval(values) == (low, high)
    assert bootstrap_interval(np.full(4, 7.0)) == (7.0, 7.0)
    assert bootstrap_interval(values[:2]) is None


def test_welch_and_mann_whitney_on_numbers_done_by_hand():
    result = compare(np.array([4.0, 5.0, 6.0]), np.array([1.0, 2.0, 3.0]))
    # t = 3 / sqrt(1/3 + 1/3), 4 degrees of freedom: t_0.975 = 2.7764
    half = 2.776445 * np.sqrt(2 / 3)
    assert result.difference == 3.0
    assert (result.low, result.high) == pytest.approx((3 - half, 3 + half), abs=1e-5)
    assert result.welch == pytest.approx(0.021312, abs=1e-5)
    assert result.mann_whitney == pytest.approx(2 / 20)  # 20 ways to choose three of six


def test_ties_do_not_make_ranks_surer_than_they_can_be():
    result = compare(np.array([1.0, 1.0]), np.array([2.0, 3.0]))
    assert result.mann_whitney == pytest.approx(smallest_mann_whitney(2, 2)) == 1 / 3


def test_nothing_can_be_compared_without_spread_or_with_one_seed():
    assert compare(np.array([1.0]), np.array([1.0, 2.0])) is None
    assert compare(np.array([1.0, 1.0]), np.array([2.0, 2.0])) is None


@pytest.mark.parametrize(("n", "m", "p"), [(3, 3, 0.1), (5, 5, 2 / 252), (1, 1, 1.0)])
def test_ranks_of_few_seeds_cannot_be_surer_than_this(n, m, p):
    assert smallest_mann_whitney(n, m) == pytest.approx(p)


def test_holm_multiplies_the_smallest_most_and_keeps_the_order():
    assert holm([0.01, 0.04, 0.03]) == pytest.approx([0.03, 0.06, 0.06])
    assert holm([0.9, 0.8]) == [1.0, 1.0]
    assert holm([]) == []


def test_the_first_step_near_the_peak():
    steps, values = np.array([1.0, 2.0, 3.0, 4.0]), np.array([10.0, 19.0, 20.0, 12.0])
    assert first_step_near_peak(steps, values, 0.9) == 2.0
    assert first_step_near_peak(steps, values, 1.0) == 3.0


def test_a_rise_begins_where_the_curve_is_lowest():
    steps, values = np.arange(6.0), np.array([9.0, 1.0, 0.0, 2.0, 4.0, 5.0])
    assert first_step_near_peak(steps, values, 0.4) == 3.0
    assert first_step_near_peak(steps, values, 0.9) == 5.0


# ---------------------------------------------------------------------------- tables


def test_the_summary_is_over_seeds(folder):
    results = find_results(folder)
    groups = {(ENV, "mappo"): [r for r in results if r.label == "mappo"]}
    table = summary_table(final_numbers(results), groups).set_index(["label", "mode"])
    row = table.loc[("mappo", "sampled")]
    assert (row["seeds"], row["limit"], row["violation"], row["lambda"]) == (3, 20, 0.25, 0.5)
    assert row["return_mean"] == pytest.approx(0.6)
    assert row["return_se"] == pytest.approx(0.1 / np.sqrt(3))
    assert row["within_limit"] == 0.0
    assert row["steps_to_90"] == 4000  # the mean curve rises from 0.15 to 0.6: 0.555 after 3700
    assert table.loc[("e2c_t", "sampled"), "within_limit"] == pytest.approx(2 / 3)
    assert table.loc[("mappo", "deterministic"), "return_mean"] == pytest.approx(1.2)


def test_methods_are_compared_with_baselines_only(folder):
    suite = read_suite(folder / "suite.yml")
    table = comparison_table(suite.experiments[0], final_numbers(find_results(folder)))
    assert table[["label", "baseline", "measure"]].to_numpy().tolist() == [
        ["e2c_t", "mappo", "return"],
        ["e2c_t", "mappo", "cost"],
    ]
    assert table["difference"].tolist() == pytest.approx([0.3, -81.0])


def test_few_seeds_are_called_few():
    assert "There are only 3 seeds" in how_to_read([3, 10])[-1]
    assert "There are only" not in " ".join(how_to_read([10]))
    assert "There are only" not in " ".join(how_to_read([]))


def test_bars_in_cells_do_not_break_a_markdown_table():
    assert markdown_table(pd.DataFrame({"a": ["x|y"]})) == "| a |\n| --- |\n| x\\|y |\n"


# ---------------------------------------------------------------------------- figures


def methods(*labels):
    return {label: Method(label, label, label.partition("-")[0]) for label in labels}


def test_a_method_looks_alike_in_every_figure_and_its_variants_have_its_color():
    look = Look(methods("mappo", "e2c", "e2c-pure"))
    assert look.color("e2c") == look.color("e2c-pure") != look.color("mappo")
    assert look.dashes("e2c") != look.dashes("e2c-pure")
    assert look.dashes("e2c") == look.dashes("mappo") == (1, 0)
    assert look.color("e2c") == Look(methods("e2c", "c_mappo")).color("e2c")


def test_no_two_methods_of_the_paper_look_the_same():
    suite = read_suite(find_suite("paper"))
    look = Look(suite.methods)
    for experiment in suite.experiments:
        looks = {(look.color(label), look.dashes(label)) for label in experiment.methods}
        assert len(looks) == len(experiment.methods), experiment.id


def test_curves_stand_beside_each_other_with_the_limit(folder):
    suite = read_suite(folder / "suite.yml")
    results = find_results(folder)
    groups = {(ENV, m): [r for r in results if r.label == m] for m in ("mappo", "e2c_t")}
    figure = draw_curves(suite.experiments[0], groups, Look(suite.methods))
    reward, cost = figure.axes
    assert [axes.get_ylabel() for axes in (reward, cost)] == ["team reward", "team cost"]
    mappo, e2c = reward.lines
    assert mappo.get_xdata().tolist() == [1000, 2000, 3000, 4000]
    np.testing.assert_allclose(mappo.get_ydata(), [0.15, 0.3, 0.45, 0.6])
    assert mappo.get_color() != e2c.get_color()
    assert cost.lines[-1].get_ydata() == [20.0, 20.0]


def test_runs_that_have_not_finished_are_drawn_only_alone(folder):
    write_run(folder, "e2c_t", 3, final=100.0, cost=0.0, finished=False)
    write_run(folder, "e2c_t-pure", 0, final=0.3, cost=0.0, finished=False)
    results = find_results(folder)
    labels = ("e2c_t", "e2c_t-pure")
    groups = {(ENV, m): [r for r in results if r.label == m] for m in labels}
    look = Look(read_suite(folder / "suite.yml").methods)
    figure = draw_curves(Experiment("x", "x", "x", (ENV,), labels), groups, look)
    assert [line.get_ydata()[-1] for line in figure.axes[0].lines] == pytest.approx([0.9, 0.3])


# ---------------------------------------------------------------------------- report


class Page(HTMLParser):
    """Tags that were opened and closed, and everything that the page refers to."""

    def __init__(self, text):
        super().__init__()
        self.open, self.links, self.text = [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.links += [value for name, value in attrs if name in ("src", "href")]
        if tag not in ("meta", "img", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


def test_the_report_is_one_page_that_needs_nothing_else(folder, tmp_path):
    report = plot_suite(folder, tmp_path / "plots")
    page = Page(report.read_text())
    assert page.open == []
    assert len(page.links) == 2
    assert all(link.startswith("data:image/svg+xml;base64,") for link in page.links)
    assert not re.search(r"url\(|@import|<script", report.read_text())
    text = " ".join(page.text)
    for words in ("A <small> suite", "6 finished runs of 9", "0.10 hours", "Fig. 3: Rovers"):
        assert words in text
    assert "later" not in text  # nothing of it has been run
    names = {path.name for path in report.parent.iterdir()}
    assert names == {
        *("report.html", "tables.md", "runs.csv", "summary.csv", "comparisons.csv"),
        *("fig3_curves.png", "fig3_finals.png"),
    }
    assert "0.900 ± 0.058" in (report.parent / "tables.md").read_text()


def test_the_report_of_a_suite_that_has_only_begun(tmp_path, capsys):
    folder = tmp_path / "results" / "tiny"
    folder.mkdir(parents=True)
    (folder / "suite.yml").write_text(SUITE)
    write_run(folder, "mappo", 0, final=0.5, cost=1.0, finished=False)
    cli.main(["plot", "-f", str(tmp_path)])
    report = tmp_path / "plots" / "tiny" / "report.html"
    assert capsys.readouterr().out.strip() == str(report)
    assert "0 finished runs of 9" in report.read_text()
    assert (report.parent / "fig3_curves.png").is_file()


def test_results_are_drawn_although_their_preset_has_gone(folder):
    path = folder / "suite.yml"
    path.write_text(SUITE.replace("  mappo: {", "  mappo: {preset: gone, "))
    assert "gone" in path.read_text()
    cli.main(["plot", "-f", str(folder.parent.parent)])


def test_the_same_results_give_the_same_picture(folder):
    suite, results = read_suite(folder / "suite.yml"), find_results(folder)
    groups = {(ENV, "mappo"): [r for r in results if r.label == "mappo"]}
    pictures = {
        svg(draw_curves(suite.experiments[0], groups, Look(suite.methods))) for _ in range(2)
    }
    assert len(pictures) == 1


def test_mistakes_are_one_line(folder, tmp_path, capsys):
    assert "needs the folder of one run, or -f" in refusal(capsys, [])
    assert "needs the folder of one run, or -f" in refusal(capsys, [tmp_path, "-f", tmp_path])
    assert "--suite goes with -f" in refusal(capsys, [tmp_path, "--suite", "tiny"])
    assert "did you mean 'tiny'" in refusal(capsys, ["-f", tmp_path, "--suite", "tinny"])
    assert "has no results" in refusal(capsys, ["-f", folder / ENV])
    (folder / ENV / "mappo" / "seed_0" / "evaluation.json").write_text("{")
    assert "cannot read" in refusal(capsys, ["-f", tmp_path])
