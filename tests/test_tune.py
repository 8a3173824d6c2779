"""The search for hyperparameters: what is tried, what counts as best, what is trained then."""

import csv
import signal
from types import SimpleNamespace

import optuna
import pytest
import yaml

pytest.importorskip("rl_zoo3")

from filelock import FileLock
from optuna.distributions import FloatDistribution
from optuna.trial import TrialState, create_trial

from sb3_e2c.zoo import objective, train, tune
from sb3_e2c.zoo.configuration import ALGORITHMS, read_yaml, resolve
from sb3_e2c.zoo.console import UserError
from sb3_e2c.zoo.search_space import SearchSpace
from sb3_e2c.zoo.study import (
    PRUNERS,
    SAMPLERS,
    AmongAsSafe,
    SeededByTrial,
    load_study,
    ranked,
    trial_in_words,
    violation_key,
)

ENV = "MultiRover-6-3-v0"
STUDY = f"e2c_t_{ENV}"
ROLLOUT = 6 * 10  # one world of six rovers for ten steps
SMALL = ["n_envs:1", "n_steps:10", "n_epochs:1", "batch_size:60", "policy_kwargs.net_arch:[4]"]


def flags(folder, *more, n_trials=3, algo="e2c_t", params=()):
    """A command line for trials of two rollouts."""
    argv = ["--algo", algo, "--env", ENV, "-n", 2 * ROLLOUT, "-f", folder, "--device", "cpu"]
    argv += ["--n-trials", n_trials, "--eval-episodes", 2, "--n-eval-envs", 2, "--seed", 3]
    argv += ["--n-evaluations", 2, "--env-kwargs", "max_cycles:10", "-params", *SMALL, *params]
    return [str(word) for word in [*argv, *more]]


def rows(folder, name=STUDY):
    with (folder / "tune" / name / "trials.csv").open() as file:
        return list(csv.DictReader(file))


def refusal(capsys, main, argv):
    with pytest.raises(SystemExit) as exit_:
        main([str(word) for word in argv])
    assert exit_.value.code == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1, lines
    return lines[0]


@pytest.fixture(name="searched", scope="module")
def fixture_searched(tmp_path_factory):
    """A folder with a study of three trials."""
    folder = tmp_path_factory.mktemp("logs")
    tune.main(flags(folder, "--verbose", 0))
    return folder


# ------------------------------------------------------------------------------------- a study


def test_a_study_has_as_many_trials_as_asked_for_and_the_same_command_adds_none(searched):
    assert [row["state"] for row in rows(searched)] == ["complete"] * 3
    tune.main(flags(searched, "--verbose", 0))
    assert len(rows(searched)) == 3
    tune.main(flags(searched, "--verbose", 0, n_trials=4))
    assert len(rows(searched)) == 4


def test_the_first_trial_has_the_settings_as_they_are(searched):
    config = load_study(None, STUDY, searched).trials[0].user_attrs["config"]
    assert config["learning_rate"] == "lin_0.0005"
    assert (config["gamma"], config["gae_lambda"], config["reward_scale"]) == (0.9, 0.95, 20.0)
    assert config["oem_kwargs"]["psi"] == 0.05


def test_later_trials_differ_in_what_is_searched_alone(searched):
    first, second, *_ = (t.user_attrs["config"] for t in load_study(None, STUDY, searched).trials)
    assert first["learning_rate"] != second["learning_rate"]
    assert second["learning_rate"].startswith("lin_")
    for key in ("n_epochs", "batch_size", "policy_kwargs", "ent_coef", "n_timesteps"):
        assert first[key] == second[key]


def test_the_limit_is_a_constraint_of_optuna(searched):
    for trial in load_study(None, STUDY, searched).trials:
        assert trial.constraints == {"cost_0": trial.user_attrs["costs"][0] - 20.0}
        assert trial.value == trial.user_attrs["return"] == trial.intermediate_values[2]


@pytest.mark.parametrize("way", ["--trial-id", "--conf-file"])
def test_the_best_trial_is_trained_with_its_settings_and_all_steps(searched, tmp_path, way):
    best = ranked(load_study(None, STUDY, searched).trials)[0]
    argv = ["--algo", "e2c_t", "--env", ENV, "--eval-freq", "-1", "--device", "cpu", "-n", "120"]
    log = searched if way == "--trial-id" else tmp_path
    which = "best" if way == "--trial-id" else str(searched / "tune" / STUDY / "best.yml")
    run = train.train([*argv, "-f", str(log), "--verbose", "0", way, which])
    assert read_yaml(run / ENV / "config.yml") == best.user_attrs["config"]
    assert best.user_attrs["config"]["n_timesteps"] == 1_500_000


def test_a_trial_is_trained_by_its_number_with_changes_on_top(searched):
    flags_ = ["-f", str(searched), "--study-name", STUDY, "--trial-id", "1", "--device", "cpu"]
    more = ["-params", "gamma:0.5", "--env-kwargs", "max_cycles:5", "--eval-freq", "-1", "-n", "60"]
    run = train.train([*flags_, *more, "--verbose", "0"])
    trial = load_study(None, STUDY, searched).trials[1].user_attrs["config"]
    config = read_yaml(run / ENV / "config.yml")
    assert config["learning_rate"] == trial["learning_rate"]
    assert (config["gamma"], config["env_kwargs"]["max_cycles"]) == (0.5, 5)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--trial-id", "99"], "--trial-id is 99; expected best, or one of the trials: 0, 1"),
        (["--trial-id", "best", "--preset", "pure"], "--preset contradicts --trial-id"),
        (["--trial-id", "best", "--study-name", "other"], "there is no study other in"),
        (["--trial-id", "best", "--storage", "sqlite:///no.db"], "there is no study"),
        (["--trial-id", "best", "--algo", "mappo", "--study-name", STUDY], "is about --algo e2c_t"),
        (["--study-name", STUDY], "--storage and --study-name are about --trial-id"),
        (["-optimize"], "-optimize/--optimize-hyperparameters is not available for teams: search"),
    ],
)
def test_a_trial_that_cannot_be_meant_is_refused(searched, capsys, more, message):
    argv = ["--env", ENV, "-f", searched, *more]
    assert message in refusal(capsys, train.main, argv)


def test_a_study_with_other_settings_is_refused(searched, capsys):
    argv = flags(searched, params=["gamma:0.5"])
    message = refusal(capsys, tune.main, argv)
    assert "config.gamma was 0.9 there, and is 0.5 now" in message
    assert "--study-name" in message


def test_sqlite_is_a_storage_and_a_method_without_limits_has_no_constraints(tmp_path, capsys):
    storage = f"sqlite:///{tmp_path}/study.db"
    argv = flags(tmp_path, "--storage", storage, "--study-name", "s", n_trials=1, algo="mappo")
    tune.main(argv)
    study = load_study(storage, "s", tmp_path)
    assert [trial.constraints for trial in study.trials] == [{}]
    assert "multipliers_kwargs.learning_rate" not in study.user_attrs["settings"]["space"]
    out = capsys.readouterr().out
    assert f"--trial-id best --study-name s --storage {storage} -f {tmp_path}" in out
    assert "trial 0, return" in out


def test_a_trial_that_blows_up_is_recorded_and_the_study_goes_on(tmp_path, capsys):
    space = tmp_path / "space.yml"
    space.write_text("'*': null\nlearning_rate: [5.0e-4, 1.0e+30]\n")
    tune.main(flags(tmp_path, "--space", space, "--sampler", "random", n_trials=4))
    found = {row["state"]: row for row in rows(tmp_path)}
    assert found.keys() == {"complete", "pruned"}
    assert found["pruned"]["learning_rate"] == "lin_1e+30"
    assert found["pruned"]["error"]
    assert "broke off: " in capsys.readouterr().out


def test_a_study_in_which_every_trial_blows_up_is_a_mistake(tmp_path, capsys):
    argv = flags(tmp_path, "--verbose", 0, n_trials=2, params=["learning_rate:1e30"])
    assert "no trial came to its end; the last broke off: " in refusal(capsys, tune.main, argv)


def test_ctrl_c_says_how_to_go_on_and_the_trial_is_done_again(tmp_path, capsys, monkeypatch):
    def interrupt(*_):
        signal.raise_signal(signal.SIGINT)

    argv = flags(tmp_path, n_trials=1)
    with monkeypatch.context() as patch:
        patch.setattr(objective.Objective, "_train", interrupt)
        with pytest.raises(SystemExit) as exit_:
            tune.main(argv)
    assert exit_.value.code == 130
    assert "go on with: sb3-e2c tune --algo e2c_t" in capsys.readouterr().out
    tune.main(argv)
    assert [row["state"] for row in rows(tmp_path)] == ["fail", "complete"]
    assert rows(tmp_path)[1]["learning_rate"] == "lin_0.0005"


def test_the_trial_of_a_killed_process_is_given_up_and_that_of_a_live_one_is_not(tmp_path):
    args = tune.make_parser().parse_args(flags(tmp_path))
    search = tune.Search(args)
    study = search.open()
    workers = tmp_path / "tune" / STUDY / "workers"
    workers.mkdir()
    (workers / "killed.lock").touch()
    for worker in ("killed", "alive", "elsewhere"):
        study.ask().set_user_attr("worker", worker)
    with FileLock(workers / "alive.lock"):
        search.prepare(study)
    states = [trial.state for trial in study.trials]
    assert states == [TrialState.FAIL, TrialState.RUNNING, TrialState.RUNNING]
    assert search.missing(study) == 1


# ------------------------------------------------------------------------------------- the best


def made(value, costs=(), state=TrialState.COMPLETE, steps=None, violations=None):
    """A trial that was never run; costs are those above the limit."""
    return create_trial(
        state=state,
        value=value,
        params={"x": 0.5},
        distributions={"x": FloatDistribution(0, 1)},
        intermediate_values=steps or {},
        user_attrs={violation_key(k): v for k, v in (violations or {}).items()} | {"config": {}},
        system_attrs={f"constraints:cost_{j}": cost for j, cost in enumerate(costs)},
    )


def test_the_best_has_the_highest_return_among_those_that_keep_all_limits():
    trials = [made(9, [3, -1]), made(5, [-1, 0]), made(7, [-2, -2]), made(8, [1, 1])]
    pruned = made(99, [-5, -5], TrialState.PRUNED)
    assert [trial.value for trial in ranked([*trials, pruned])] == [7, 5, 8, 9]


def test_a_study_without_a_safe_trial_says_so(tmp_path):
    search = SimpleNamespace(
        space=SimpleNamespace(current=lambda _: 1), settings={"space": {}}, folder=tmp_path
    )
    search._model_limits, search._train_command = [2.0], str
    study = optuna.create_study(direction="maximize")
    study.add_trials([made(9, [3]), made(5, [1])])
    report = tune.Search.report(search, study)
    assert "Best of 2 complete trials: 1\nNo trial keeps all limits" in report


def test_pruning_compares_a_trial_with_those_that_are_as_safe_only():
    study = optuna.create_study(direction="maximize")
    study.add_trials([made(9, steps={1: 9}, violations={1: 4.0})] * 3)
    study.add_trials([made(5, steps={1: 5}, violations={1: 0.0})] * 3)
    median = PRUNERS["median"](1, 1)

    def pruned(value, excess, pruner):
        state = TrialState.RUNNING
        trial = made(None, state=state, steps={1: value}, violations={1: excess})
        return pruner.prune(study, trial)

    assert pruned(6, 0.0, median)  # Optuna's own looks at returns alone
    assert not pruned(6, 0.0, AmongAsSafe(median))
    assert pruned(4, 0.0, AmongAsSafe(median))
    assert pruned(6, 4.0, AmongAsSafe(median))
    assert not pruned(8, 4.0, AmongAsSafe(median))


def test_a_pruned_trial_keeps_its_constraints(tmp_path, monkeypatch):
    monkeypatch.setattr(AmongAsSafe, "prune", lambda *_: True)
    tune.main(flags(tmp_path, "--verbose", 0, n_trials=1))
    (trial,) = load_study(None, STUDY, tmp_path).trials
    assert trial.state == TrialState.PRUNED
    assert list(trial.intermediate_values) == [1]
    assert trial.constraints == {"cost_0": trial.user_attrs["costs"][0] - 20.0}
    assert trial_in_words(trial, [20.0]).endswith("kept, pruned")


# ---------------------------------------------------------------------------------- samplers


@pytest.mark.parametrize("name", SAMPLERS)
def test_a_trial_follows_from_seed_and_number_whoever_makes_it(name):
    def sampler():
        return SeededByTrial(lambda seed: SAMPLERS[name](seed, 2), 5)

    def values(n_samplers):
        study = optuna.create_study(direction="maximize")
        samplers = [sampler() for _ in range(n_samplers)]
        for number in range(5):
            study.sampler = samplers[number % n_samplers]
            trial = study.ask()
            x = trial.suggest_float("x", 0, 1)
            trial.set_constraint("cost_0", x - 0.5)
            study.tell(trial, x)
        return [trial.params["x"] for trial in study.trials]

    found = values(2)
    assert found == values(1)
    assert len(set(found)) == 5


# ------------------------------------------------------------------------------------ the space


@pytest.mark.parametrize("env_id", [ENV, "KeepAway-v0", "SafeAnt-2x4-v0"])
def test_the_shipped_settings_of_every_method_lie_in_the_space(env_id):
    for algo in ALGORITHMS:
        for preset in ([], ["gru"]):
            space = SearchSpace(algo, resolve(algo, env_id, preset))
            assert len(space.start()) == len(space.dimensions)


def searched_keys(algo, presets=(), overrides=None, fixed=None, path=None):
    config = resolve(algo, "KeepAway-v0", presets, {**(overrides or {}), **(fixed or {})})
    return set(SearchSpace(algo, config, fixed, path).plain())


def test_only_what_the_method_reads_is_searched():
    own = {"oem_kwargs.psi", "oem_kwargs.estimator_kwargs.k"}
    limited = {"multipliers_kwargs.learning_rate"}
    assert searched_keys("e2c") - searched_keys("c_mappo") == own
    assert searched_keys("c_mappo_pe") - searched_keys("mappo") == limited
    assert searched_keys("c_mappo_pe") - searched_keys("c_mappo") == {"ent_coef"}
    pure = {"oem_kwargs.psi", "reward_scale"}
    assert searched_keys("e2c") - searched_keys("e2c", ["pure"]) == pure
    assert searched_keys("e2c", ["gru"]) - searched_keys("e2c") == {"policy_kwargs.gru_hidden_size"}
    pid = searched_keys("e2c", overrides={"multipliers_class": "PIDMultipliers"})
    gains = {f"multipliers_kwargs.{gain}" for gain in ("kp", "ki", "kd")}
    assert pid - searched_keys("e2c") == gains
    assert searched_keys("e2c") - pid == limited


def test_what_the_user_gives_is_not_searched():
    fixed = {"gamma": 0.9, "policy_kwargs": {"net_arch": [8]}}
    gone = {"gamma", "policy_kwargs.net_arch.pi", "policy_kwargs.net_arch.vf"}
    assert searched_keys("mappo") - searched_keys("mappo", fixed=fixed) == gone


def test_a_file_restricts_and_extends_the_space(tmp_path):
    file = tmp_path / "space.yml"
    file.write_text("policy_kwargs.*: null\ngamma: null\nent_coef: {low: 1.0e-4, high: 1.0e-2}\n")
    found = searched_keys("e2c", path=file)
    assert "ent_coef" in found  # although the method sets it to 0
    assert not {"gamma", "policy_kwargs.net_arch.pi"} & found
    file.write_text("'*': null\nn_epochs: [2, 4]\n")
    assert searched_keys("e2c", path=file) == {"n_epochs"}


def test_the_space_that_is_shown_is_a_file_for_it(tmp_path, capsys):
    argv = flags(tmp_path)
    tune.main([*argv, "--show-space"])
    text = capsys.readouterr().out
    file = tmp_path / "space.yml"
    file.write_text(text)
    tune.main([*argv, "--space", str(file), "--show-space"])
    assert capsys.readouterr().out == text
    assert yaml.safe_load(text)["gamma"] == {"low": 0.8, "high": 0.995, "scale": "log(1 - x)"}


def test_opponents_learn_as_they_would_without_the_search():
    space = SearchSpace("e2c_t", resolve("e2c_t", "KeepAway-v0"))
    space.hold_opponents()
    trial = optuna.trial.FixedTrial(space.start() | {"learning_rate": 1e-3, "reward_scale": 3.0})
    config = space.suggest(trial)
    assert (config["learning_rate"], config["reward_scale"]) == ("lin_0.001", 3.0)
    held = config["opponent_kwargs"]
    assert (held["learning_rate"], held["reward_scale"]) == ("lin_5e-4", 1.0)
    assert held["ent_coef"] == 1e-3


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("gama: [0.9]", "did you mean 'gamma'"),
        ("gamma: 0.9", "gamma is 0.9 in the search space; expected {low: A, high: B}"),
        ("gamma: {low: 0.9, high: 0.8}", "gamma goes from 0.9 to 0.8; expected low < high"),
        ("gamma: {low: 0.9, high: 1.0, scale: log(1 - x)}", "expected low < high < 1"),
        ("gamma: {low: 0.0, high: 0.9, scale: log}", "expected 0 < low < high"),
        ("gamma: {low: 0.1, high: 0.9, scale: lg}", "scale is 'lg'; expected one of linear"),
        ("gamma: {low: 0.1, hi: 0.9}", "expected {low: A, high: B}"),
        ("gamma: {low: 0.1, high: 1.5}", "gamma is 1.5; expected at most 1"),
        ("batch_size: [60, 0.5]", "batch_size"),
        ("oem_kwargs.estimator_kwargs.k: [5]", "k"),
        ("'*': null", "nothing is left to search"),
        ("n_epochs: [1, 2]", "-params fixes it"),
    ],
)
def test_a_space_that_cannot_be_meant_is_one_line(tmp_path, capsys, text, message):
    (tmp_path / "space.yml").write_text(text)
    argv = flags(tmp_path / "logs", "--space", tmp_path / "space.yml")
    assert message in refusal(capsys, tune.main, argv)
    assert not (tmp_path / "logs").exists()


def test_a_space_with_what_the_method_does_without_is_refused(tmp_path):
    (tmp_path / "space.yml").write_text("multipliers_kwargs.learning_rate: [0.1]")
    with pytest.raises(UserError, match="mappo does not read multipliers_kwargs"):
        searched_keys("mappo", path=tmp_path / "space.yml")


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--algo", "e2c-t"], "did you mean 'e2c_t'"),
        (["--n-trials", "0"], "--n-trials is 0; expected at least 1"),
        (["-n", "0"], "--n-timesteps is 0"),
        (["--sampler", "grid"], "--sampler is 'grid'; expected one of tpe, gp, nsgaii, random"),
        (["--pruner", "no"], "--pruner is 'no'"),
        (["--storage", "study.db"], "expected sqlite:///study.db"),
        (["--storage", "nosql://host/db"], "--storage nosql://host/db: "),
        (["--seed", "-1"], "--seed is -1"),
        (["-conf", "missing.yml"], "cannot read missing.yml"),
        (["--env-kwargs", "max_cylces:10"], "did you mean 'max_cycles'"),
        (["-params", "callback:no.such.Callback", *SMALL], "callback 'no.such.Callback'"),
    ],
)
def test_a_mistake_is_one_line(tmp_path, capsys, more, message):
    assert message in refusal(capsys, tune.main, flags(tmp_path / "logs", *more))
    assert not list(tmp_path.glob("logs/tune/*/study.log"))


def test_the_help_has_an_example(capsys):
    with pytest.raises(SystemExit) as exit_:
        tune.main(["--help"])
    assert exit_.value.code == 0
    assert "sb3-e2c tune --algo e2c_t --env KeepAway-v0 -n 300000" in capsys.readouterr().out
