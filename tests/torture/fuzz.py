"""Random command lines, YAML, constructor arguments and spoiled files.

Each either works or is one clear error: on the command line a line and exit status 2, in Python a
ValueError or TypeError that is raised by us or by Stable-Baselines3, not deep in torch or NumPy.
"""

import argparse
import contextlib
import inspect
import io
import os
import re
import signal
import traceback
import warnings
from pathlib import Path

import gymnasium
import numpy as np
import torch as th
import yaml
from conftest import TwoOnALine
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st
from stable_baselines3.common.utils import LinearSchedule

from sb3_e2c import (
    E2CMAPPO,
    MAPPO,
    GradientMultipliers,
    NearestNeighbor,
    OEMRewardCallback,
    PIDMultipliers,
    VisitCount,
    share_parameters,
)
from sb3_e2c.zoo import (
    benchmark,
    cli,
    completion,
    demo,
    enjoy,
    export,
    load,
    plot,
    push,
    record,
    speed,
    train,
    tune,
)
from sb3_e2c.zoo.build import build_model, go_on_from, load_weights, make_worlds
from sb3_e2c.zoo.configuration import ALGORITHMS, keys, preset_names
from sb3_e2c.zoo.console import UserError, one_line_errors
from sb3_e2c.zoo.curves import plot_learning
from sb3_e2c.zoo.hub import check_repo_id
from sb3_e2c.zoo.normalization import load_statistics
from sb3_e2c.zoo.resume import newest_point
from sb3_e2c.zoo.runs import find_run, load_model, make_env, open_run
from torture.runs import PREY, Outcome, quietly, trained

SECONDS = 30  # of a case; longer is a hang
OURS = [f"{os.sep}{name}{os.sep}" for name in ("sb3_e2c", "stable_baselines3", "gymnasium")]


class Hang(BaseException):
    """A case takes too long."""


@contextlib.contextmanager
def deadline():
    """Interrupt what takes too long."""

    def stop(*_):
        raise Hang

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, SECONDS)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def fuzz(fault, cases, act, n, number=0):
    """Try random cases.

    :param cases: A strategy
    :param act: Tries one; returns None, or what is wrong
    :param n: How many
    :param number: Of the random sequence
    :return: A line of the table
    """
    tried, wrong = 0, {}

    @seed(number)
    @settings(
        max_examples=max(n, 1),
        deadline=None,
        database=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(cases)
    def trial(case):
        nonlocal tried
        tried += 1
        try:
            with deadline(), warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of numbers that make no sense
                problem = act(case)
        except Hang:
            problem = "hang"
        except Exception as error:
            problem = f"{type(error).__name__} in {_place(error)}: {str(error)[:200]}"
        if problem is not None:
            wrong.setdefault(problem, []).append(repr(case)[:600])

    trial()
    notes = tuple(f"{len(found)} x {what}\n    {found[0]}" for what, found in wrong.items())
    return Outcome(fault, tried, wrong=sum(map(len, wrong.values())), notes=notes)


def _place(error):
    frames = traceback.extract_tb(error.__traceback__)
    ours = [f for f in frames if OURS[0] in f.filename] or frames
    return f"{Path(ours[-1].filename).name}:{ours[-1].lineno}"


# ---------------------------------------------------------------------------- command lines

NUMBERS = ["0", "-1", "1", "2", "7", "1e3", "3.5", "nan", "inf", "-inf", "9" * 20, "9" * 400]
NUMBERS += ["1e400", "1_0", "0x10", "½", "１", "-0.0", "1e-320", str(2**32), str(2**63)]
NAMES = [
    "",
    " ",
    "logs",
    "conf.yml",
    "model.zip",
    "garbage.zip",
    "missing",
    "new/folder",
    "a" * 300,
]
NAMES += ["ü", "\udcff", "a\nb", "-x", "--", "@a", "auto", "cpu", "cuda:9", "best", "own", "random"]
NAMES += [*ALGORITHMS, PREY, "MultiRover-6-3-v0", "SafeAnt-2x4-v0", *preset_names(), "no/body"]
NAMES += ["gru,lambda_1", "a.gif", "a.mp4", "sqlite:///missing/a.db", "smoke", "paper", "e2c-t"]
VALUES = [*NUMBERS, "", "true", "null", "[1,2]", "[]", "dict(a=1)", "lin_1e-3", "lin_nan", "[[1]]"]
VALUES += [
    "{1: 2}",
    "9**9**9",
    "__import__('os')",
    "(" * 300,
    "-" * 5000 + "1",
    "[" * 90 + "]" * 90,
]
VALUES += ["'a", "visit_count", "nearest_neighbor", "GruPolicy", "Tanh", "PIDMultipliers", "b'1'"]
VALUES += ["1j", "...", "{1, 2}", "dict(**a)", "dict([1])", "f'{1}'", "'a' * 9", "0777"]
INNER = [
    "psi",
    "estimator",
    "estimator_kwargs",
    "k",
    "net_arch",
    "activation_fn",
    "pi",
    "learning_rate",
]
INNER += [
    "max_cycles",
    "n_predators",
    "",
    "a",
    "optimizer_kwargs",
    "shape",
    "initial",
    "eps",
    "betas",
]
KEYS = [*keys("e2c_t"), "seed", "device", "policy_kwarg", "", "1", "__class__"]

words = st.sampled_from([*NUMBERS, *NAMES]) | st.text(
    st.characters(exclude_characters="\0/.~", exclude_categories=()), max_size=8
)
dotted = st.lists(st.sampled_from([*KEYS, *INNER]), min_size=1, max_size=3).map(".".join)
pairs = st.builds("{}:{}".format, dotted, st.sampled_from(VALUES) | words) | words


def argv_of(parser):
    """Command lines of a parser: its flags with values that fit more or less."""
    flags = [a for a in parser._actions if not isinstance(a, argparse._HelpAction)]
    part = st.one_of([_flag(each) for each in flags] + [words.map(lambda word: [word])])
    few = st.lists(st.one_of([_flag(each) for each in flags]), max_size=2)
    return (few | st.lists(part)).map(lambda parts: [word for part in parts for word in part])


def _flag(action):
    values = words
    if "StoreDict" in type(action).__name__:
        values = pairs
    elif action.choices:
        values = st.sampled_from(list(map(str, action.choices))) | words
    elif action.type in (int, float):
        values = st.sampled_from(NUMBERS) | st.integers(-5, 50).map(str) | words
    most = {0: 0, None: 1, "?": 1}.get(action.nargs, 3)
    names = st.sampled_from(action.option_strings or [""])
    return st.builds(
        lambda name, given: [*([name] if name else []), *given],
        names,
        st.lists(values, min_size=min(most, 1), max_size=most),
    )


def train_parser():
    """The parser of ``train`` with all its flags, which RL-Zoo and we add while it parses."""
    found, real = [], train.TrainParser.parse_args

    def parse(self, *args):
        found.append(self)
        return real(self, *args)

    train.TrainParser.parse_args = parse
    try:
        only_check(train.main)([])
    finally:
        train.TrainParser.parse_args = real
    return found[0]


def only_check(main):
    """``train`` up to where it would build something."""

    def act(argv):
        def stop(*_, **__):
            raise SystemExit(0)

        real, train.TeamExperimentManager = train.TeamExperimentManager, stop
        try:
            status, out, error = quietly(main, argv)
        finally:
            train.TeamExperimentManager = real
        return status, out, error

    return act


def _parse_then(module, *checks):
    def main(argv):
        args = module.make_parser().parse_args(argv)
        with one_line_errors():
            for check in checks:
                check(args)

    return lambda argv: quietly(main, argv)


def _repo(args):
    if args.repo_id is not None:
        check_repo_id(args.repo_id)


def _but(main, *more):
    return lambda argv: quietly(main, [*argv, *more])


def commands():
    """Every command: its parser, and how it is tried up to where work would begin."""
    return {
        "train": (train_parser(), only_check(train.main)),
        "enjoy": (enjoy.make_parser(), _parse_then(enjoy, enjoy._check, find_run)),
        "record": (record.make_parser(), _parse_then(record, record._check, find_run)),
        "export": (export.make_parser(), _parse_then(export, find_run)),
        "push": (push.make_parser(), _parse_then(push, _repo, find_run)),
        "load": (load.make_parser(), _parse_then(load, _repo)),
        "benchmark": (benchmark.make_parser(), _but(benchmark.main, "--dry-run")),
        "plot": (plot.make_parser(), _but(plot.main)),
        "tune": (tune.make_parser(), _but(tune.main, "--show-space")),
        "speed": (speed.make_parser(), _parse_then(speed, speed._check)),
        "demo": (demo.make_parser(), _parse_then(demo)),
        "completion": (completion.make_parser(), _but(completion.main)),
    }


def one_line(found):
    """None if a command worked, or refused in one line; else what is wrong."""
    status, _, error = found
    lines = error.strip().splitlines()
    if status in (0, None) or (status == 2 and len(lines) == 1 and len(error) < 3000):
        return None
    return f"status {status}, {len(lines)} lines: {error[-200:]}"


# ---------------------------------------------------------------------------- YAML

plain = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-3, 100),
    st.sampled_from([0.0, 0.5, -1.0, 1e30, float("nan"), float("inf"), 10**400, 2**63]),
    st.sampled_from(["", "a", "lin_0.1", "visit_count", "Tanh", "GruPolicy", PREY, "e2c_t"]),
    st.text(max_size=3),
    st.dates(),
    st.binary(max_size=2),
)
values = st.recursive(
    plain,
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(st.sampled_from([*KEYS, *INNER]) | plain, inner, max_size=3)
    ),
    max_leaves=6,
)
configurations = st.dictionaries(st.sampled_from(KEYS) | plain, values, max_size=4)
suites = st.fixed_dictionaries(
    {
        "methods": st.just({"e2c_t": {}}) | values,
        "experiments": st.just({"a": {"envs": [PREY], "methods": ["e2c_t"]}})
        | st.dictionaries(
            st.sampled_from(["a", "b", ""]),
            st.fixed_dictionaries(
                {"envs": st.just([PREY]) | values, "methods": st.just(["e2c_t"]) | values},
                optional={k: values for k in ("baselines", "n_timesteps", "title", "figure")},
            )
            | values,
            max_size=2,
        )
        | values,
    },
    optional={k: values for k in ("title", "seeds", "window", "n_timesteps", "preset", "a")},
)
edits = st.lists(
    st.tuples(
        st.integers(0, 400), st.sampled_from(list("{}[]:-&*!|>'\"%@#\n\t ,?")) | st.text(max_size=2)
    ),
    max_size=2,
)
TAGS = [
    "!!bool x",
    "!!int ''",
    "!!float x",
    "2001-99-99",
    "!!binary é",
    "!!set {a}",
    "<<: 1",
    "=: 1",
]
TAGS += ["!!python/name:os.system", "&a [*a]", "*nobody", "? [a]", "!!timestamp x", "!!pairs 1"]


def yamls(content):
    """Texts of YAML files that are right, nearly, or not at all."""
    dumped = st.builds(_edited, content.map(_dump), edits)
    tagged = st.builds(
        "{}\n{}: {}".format, content.map(_dump), st.sampled_from(KEYS), st.sampled_from(TAGS)
    )
    return dumped | tagged | st.text(max_size=30)


def _dump(content):
    return yaml.safe_dump(content, allow_unicode=True)


def _edited(text, changes):
    for place, new in changes:
        text = text[: place % (len(text) + 1)] + new + text[place % (len(text) + 1) :]
    return text


def _write(name, text):
    Path(name).write_bytes(text.encode("utf-8", "surrogatepass"))


def try_conf_file(text):
    _write("conf.yml", text)
    argv = ["--env", PREY, "-f", "new", "--conf-file", "conf.yml"]
    return one_line(only_check(train.main)(argv))


def try_suite(text):
    _write("suite.yml", text)
    return one_line(quietly(benchmark.main, ["--suite", "suite.yml", "-f", "new", "--dry-run"]))


def try_space(text):
    _write("space.yml", text)
    return one_line(quietly(tune.main, ["--env", PREY, "--space", "space.yml", "--show-space"]))


def try_building(case):
    """A changed configuration of a run: is it refused, or can a model be built?"""
    algo, changes = case
    config = yaml.safe_load(Path("config.yml").read_text())
    config = {**{k: config[k] for k in config if k in keys(algo)}, **changes}

    def act(_):
        from sb3_e2c.zoo.configuration import check

        with one_line_errors():
            check(algo, config)
            env = make_worlds(PREY, config.get("env_kwargs"), 1, 0)
            try:
                build_model(algo, {**config, "n_steps": min(config["n_steps"], 100)}, env)
            finally:
                env.close()

    return one_line(quietly(act, []))


# ---------------------------------------------------------------------------- constructors

numbers = st.one_of(
    st.integers(-2, 8),
    st.floats(allow_nan=True, allow_infinity=True),
    st.sampled_from([0.5, 0.0, 1.0, 10**400, 2**63, True, th.tensor(0.5)]),
    st.sampled_from(
        [np.float32(0.5), np.int64(3), np.array(2.0), np.bool_(True), np.float64("nan")]
    ),
    st.sampled_from([None, "a", "", [], {}, [1, 2], (), "lin_0.1", b"a", len, float, object()]),
)
optimizer_kwargs = st.dictionaries(
    st.sampled_from(["eps", "betas", "lr", "strange"]), numbers, max_size=2
)
schedules = st.sampled_from([LinearSchedule(0.3, 0.0, 1.0), LinearSchedule(0.1, -0.1, 1.0), abs])
SENSIBLE = {
    **dict.fromkeys(("n_steps", "batch_size", "n_epochs", "stats_window_size"), st.integers(1, 8)),
    **dict.fromkeys(("learning_rate", "critic_learning_rate"), schedules),
    **dict.fromkeys(("clip_range", "clip_range_vf"), schedules),
    **dict.fromkeys(("normalize_advantage", "normalize_values"), st.booleans()),
    "device": st.sampled_from(["auto", "cpu", "cuda", "cuda:9", "meta", "mps", th.device("cpu")]),
    "seed": st.integers(0, 2**33),
    "tensorboard_log": st.sampled_from([None, "tensorboard", Path("tensorboard")]),
    "cost_limits": st.sampled_from([None, 1.0, [2.0], []]),
    "cost_scope": st.sampled_from(["team", "individual"]),
    "multipliers_class": st.sampled_from([GradientMultipliers, PIDMultipliers]),
    "multipliers_kwargs": st.dictionaries(
        st.sampled_from(
            ["learning_rate", "initial", "maximum", "kp", "agent_scaling", "pooled", "shape"]
        ),
        numbers,
        max_size=2,
    ),
    "policy": st.sampled_from(["MlpPolicy", "GruPolicy", "CnnPolicy", int]),
    "policy_kwargs": st.dictionaries(
        st.sampled_from(
            [
                *("net_arch", "activation_fn", "gru_hidden_size", "ortho_init", "log_std_init"),
                *("optimizer_class", "optimizer_kwargs", "features_extractor_class", "strange"),
                *("share_features_extractor", "squash_output", "use_sde", "normalize_images"),
            ]
        ),
        numbers | st.lists(st.integers(-1, 4), max_size=2) | optimizer_kwargs,
        max_size=2,
    ),
    "oem_kwargs": st.dictionaries(
        st.sampled_from(["estimator", "psi", "estimator_kwargs", "verbose"]),
        numbers | st.sampled_from(["visit_count", {"k": 2}, {"k": 0}, VisitCount()]),
        max_size=3,
    ),
}
MODEL_ARGUMENTS = [*inspect.signature(MAPPO).parameters, "oem_kwargs"]
MODEL_ARGUMENTS.remove("_init_setup_model")


def arguments(names, most=3):
    """Some of the arguments, each with a value that may or may not fit."""
    return st.dictionaries(st.sampled_from(names), st.none(), max_size=most).flatmap(
        lambda chosen: st.fixed_dictionaries(
            {name: numbers | SENSIBLE.get(name, numbers) for name in chosen}
        )
    )


def clear(act, given, named=True):
    """None if it works, or refuses clearly; else what is wrong.

    :param act: Calls a constructor with the arguments
    :param given: Odd arguments
    :param named: Whether the message has to name one of them, or an argument inside one
    """
    error = _refusal(act, given)
    if error is None:
        return None
    message = str(error).lower()
    fits = not named or _is_of_found_in(message, act, given)
    return _unclear(error) or (None if fits else _nameless(message, given))


def _refusal(act, given):
    try:
        act(given)
    except (ValueError, TypeError, gymnasium.error.Error) as error:
        return error
    return None


def _is_of_found_in(message, act, given):
    """Whether an error of torch or NumPy comes from what it was "found in": is it gone without?"""
    others = {name: given[name] for name in given if name not in ("n_steps", "policy_kwargs")}
    what, _, where = message.partition("; found in ")
    if not where or len(others) == len(given):
        return False
    return str(_refusal(act, others)).lower().partition("; found in ")[0] != what


def _nameless(message, given):
    """None if a message names an argument before it shows a value; what a value says is no name."""
    said = re.split(r" is |; found in ", message)[0]
    names = [name for each in given.items() for name in _names(*each)]
    if any(re.search(rf"(?<!\w){re.escape(name)}(?!\w)", said) for name in [*names, "missing"]):
        return None
    if "; training stops, " in message:  # numbers that are large in effect
        return None
    return f"names none of its arguments: {message[:100]}"


def _names(name, value):
    """An argument's name, what Stable-Baselines3 says for it, and the names of those inside."""
    inner = [str(key).lower() for key in value] if isinstance(value, dict) else []
    return [name, {"policy": "policy_class", "env": "environment"}.get(name, name), *inner]


def _unclear(error):
    frames = traceback.extract_tb(error.__traceback__)
    if any(name in frames[-1].filename for name in OURS) or "fuzz.py" in frames[-1].filename:
        return None if str(error).strip() else f"empty message in {_place(error)}"
    return f"{type(error).__name__} in {_place(error)}: {str(error)[:100]}"


def try_model(case):
    kind, kwargs = case
    small = {"policy": "MlpPolicy", "n_steps": 4, "batch_size": 8, "n_epochs": 1, "device": "cpu"}
    small["policy_kwargs"] = {"net_arch": [4]}
    env = share_parameters(TwoOnALine, n_worlds=2)

    def act(given):
        with contextlib.redirect_stdout(io.StringIO()):
            model = kind(**{"env": env, **small, **given})
        if model.n_steps < 100 and model.n_epochs < 100:
            with contextlib.redirect_stdout(io.StringIO()):
                model.learn(1)

    return clear(act, kwargs)


def try_part(case):
    kind, kwargs = case
    return clear(lambda given: kind(**given), kwargs)


def try_worlds(kwargs):
    def act(given):
        share_parameters(**{"make_env": TwoOnALine, "n_worlds": 1, **given}).close()

    return clear(act, kwargs, named=False)


PARTS = [
    (VisitCount, ["quantization", "empty", "high"]),
    (NearestNeighbor, ["k"]),
    (OEMRewardCallback, ["estimator", "estimator_kwargs", "psi", "verbose"]),
    (GradientMultipliers, ["learning_rate", "initial", "maximum", "agent_scaling", "pooled"]),
    (PIDMultipliers, ["kp", "ki", "kd", "initial", "maximum", "agent_scaling", "pooled"]),
]
parts = st.one_of(
    [
        st.tuples(
            st.just(kind),
            arguments(names).map(
                lambda kw, kind=kind: (
                    {"shape": (1, 1), **kw} if "Multipliers" in kind.__name__ else kw
                )
            ),
        )
        for kind, names in PARTS
    ]
)
WORLDS = [
    "n_worlds",
    "n_processes",
    "seed",
    "backend",
    "team_return",
    "team_cost",
    "team",
    "make_env",
]
# More than one process would be started
worlds = arguments(WORLDS).filter(lambda kw: kw.get("n_processes", 1) in (1, None, "a", 0, -1))
worlds = worlds.filter(lambda kw: not _is_many(kw.get("n_worlds", 1)))


def _is_many(number):
    return isinstance(number, (int, float)) and number > 100


# ---------------------------------------------------------------------------- spoiled files

spoils = st.tuples(
    st.sampled_from(["flip", "set", "cut", "behead", "remove", "repeat", "insert", "zero"]),
    st.floats(0, 1),
    st.integers(1, 64) | st.integers(65, 5000),
    st.binary(min_size=1, max_size=8),
)


def spoil(content, kind, where, length, new):
    """Change a region of a file."""
    at = min(int(where * len(content)), len(content) - 1)
    region = content[at : at + length]
    changes = {
        "flip": bytes([content[at] ^ 1 << length % 8]) + content[at + 1 : at + length],
        "set": new + region[len(new) :],
        "remove": b"",
        "repeat": region * 2,
        "insert": new + region,
        "zero": bytes(len(region)),
    }
    if kind == "cut":
        return content[:at]
    return (
        content[at:] if kind == "behead" else content[:at] + changes[kind] + content[at + length :]
    )


class Files:
    """Files of a run, to be spoiled one at a time; all else stays as it was.

    :param run: Its folder
    """

    def __init__(self, run):
        self.run, self.logs = run, run.parents[1]
        self.whole = open_run(run, "e2c_t", PREY)
        self.env = make_env(self.whole, 1, 0)
        self.model = load_model(self.whole, self.env, device="cpu")
        self.weights = {k: v.clone() for k, v in self.model.policy.state_dict().items()}
        self.acts = {
            f"{PREY}.zip": self._model,
            f"{PREY}.adversary.zip": self._opponent,
            f"{PREY}.vecnormalize.npz": self._statistics,
            f"{PREY}/config.yml": self._run,
            f"{PREY}/args.yml": self._run,
            "resume/*.point": self._point,
        }
        self.slow = {"progress.csv": self._plot, "monitor.csv": self._plot}

    def try_one(self, case):
        name, change = case
        path = sorted(self.run.glob(name))[-1]
        content = path.read_bytes()
        try:
            path.write_bytes(spoil(content, *change))
            ({**self.acts, **self.slow})[name](path)
        except UserError as error:
            return None if "\n" not in str(error)[:10] else "message begins with an empty line"
        finally:
            path.write_bytes(content)
        return None

    def sweep(self, n):
        """Flip a bit in every region of the archives, and cut them there.

        :param n: How many cases in all
        :return: A line of the table
        """
        wrong, step = [], 4 / max(n, 4)
        cases = [
            (name, (how, number * step, number, b"\0"))
            for name in (f"{PREY}.zip", f"{PREY}.adversary.zip")
            for how in ("flip", "cut")
            for number in range(n // 4)
        ]
        for case in cases:
            try:
                with deadline():
                    self.try_one(case)
            except (Hang, Exception) as error:
                wrong.append(f"{type(error).__name__} in {_place(error)}: {case}")
        return Outcome(
            "archives, flipped and cut in every region", len(cases), 0, len(wrong), tuple(wrong)
        )

    def _model(self, path):
        load_weights(self.model, path)
        go_on_from(self.model, path)
        assert all(th.equal(v, self.weights[k]) for k, v in self.model.policy.state_dict().items())

    def _opponent(self, path):
        from sb3_e2c.vec_env import opponent_env
        from sb3_e2c.zoo.build import load_opponent

        load_opponent(self.model, opponent_env(self.env), path)
        go_on_from(self.model, self.run / f"{PREY}.zip")

    def _statistics(self, path):
        load_statistics(self.env.venv, path)

    def _run(self, path):
        run = open_run(self.run, "e2c_t", PREY)
        if run.config.get("env_kwargs") == self.whole.config.get("env_kwargs"):
            load_model(run, self.env, device="cpu")

    def _point(self, path):
        quietly(lambda _: newest_point(self.run), [])

    def _plot(self, path):
        plot_learning(self.run)


# ---------------------------------------------------------------------------- all


def torture(folder, n=10_000):
    """Everything, as lines of the table.

    :param folder: An empty folder; the process works in it
    :param n: How many cases in all
    """
    before = Path.cwd()
    os.chdir(folder)
    try:
        run = trained("logs", PREY, 3)
        Path("garbage.zip").write_bytes(bytes(100))
        Path("model.zip").write_bytes((run / f"{PREY}.zip").read_bytes())
        Path("config.yml").write_bytes((run / PREY / "config.yml").read_bytes())
        yield from _torture(run.absolute(), n)
    finally:
        os.chdir(before)


def _torture(run, n):
    every = commands()
    lines = st.one_of(
        [st.tuples(st.just(name), argv_of(every[name][0])) for name in every]
        + [st.tuples(st.just("train"), argv_of(every["train"][0]))] * 4
    )
    yield fuzz("command lines", lines, lambda c: one_line(every[c[0]][1](c[1])), int(0.33 * n))
    strange = st.lists(words, max_size=3).filter(lambda argv: argv[:1] != ["demo"])
    yield fuzz("commands", strange, lambda a: one_line(quietly(cli.main, a)), int(0.02 * n))
    texts = yamls(st.fixed_dictionaries({PREY: configurations}))
    yield fuzz("YAML: --conf-file", texts, try_conf_file, int(0.10 * n))
    yield fuzz("YAML: suites", yamls(suites), try_suite, int(0.06 * n))
    yield fuzz("YAML: search spaces", yamls(configurations), try_space, int(0.04 * n))
    built = st.tuples(st.sampled_from(sorted(ALGORITHMS)), configurations)
    yield fuzz("configurations that are built", built, try_building, int(0.06 * n))
    models = st.tuples(st.sampled_from([MAPPO, E2CMAPPO]), arguments(MODEL_ARGUMENTS))
    models = models.filter(lambda c: c[0] is E2CMAPPO or "oem_kwargs" not in c[1])
    yield fuzz("arguments of models", models, try_model, int(0.12 * n))
    yield fuzz("arguments of estimators, multipliers", parts, try_part, int(0.05 * n))
    yield fuzz("arguments of share_parameters", worlds, try_worlds, int(0.05 * n))
    files = Files(run)
    names = st.sampled_from(sorted(files.acts))
    yield fuzz("spoiled files", st.tuples(names, spoils), files.try_one, int(0.08 * n))
    yield files.sweep(int(0.08 * n))
    names = st.sampled_from(sorted(files.slow))
    yield fuzz("spoiled logs", st.tuples(names, spoils), files.try_one, int(0.01 * n))
