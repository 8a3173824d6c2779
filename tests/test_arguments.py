"""Arguments of models: what does not fit is one error that names it, what fits works."""

import inspect
import math
from pathlib import Path

import numpy as np
import pytest
import torch as th
from conftest import TwoOnALine
from stable_baselines3.common.utils import ConstantSchedule, LinearSchedule

from sb3_e2c import E2CMAPPO, MAPPO, GradientMultipliers, PIDMultipliers, share_parameters
from sb3_e2c.arguments import ATTRIBUTES, RULES, checked

NAN, INF = float("nan"), math.inf
NO_NUMBER = [None, "a", "0.5", [], [1], {}, (), b"a", True, np.bool_(True), 1j, th.tensor(0.5)]
NO_COUNT = [*NO_NUMBER, 0, -1, 2**63, 1.0, np.float32(2), NAN, INF]
NO_SHARE = [*NO_NUMBER, -0.1, 1.1, NAN, INF, 10**400]
NO_AMOUNT = [*NO_NUMBER, -1, -1e-9, NAN, 10**400, 1e300]
NO_SCHEDULE = [len, list, lambda _: NAN, lambda _: "a", lambda p: p - 0.1]
NO_FACTOR = [*NO_AMOUNT, INF]
NO_RATE = [*NO_FACTOR[:-2], INF, *NO_SCHEDULE]
NO_SWITCH = [None, "True", "", 0, 1, 0.5, []]
NO_KEYWORDS = ["a", 1, [], [("a", 1)], {1: 2}, dict]


def without_none(values):
    return [value for value in values if value is not None]


ODD = {
    **dict.fromkeys(("n_steps", "batch_size", "n_epochs", "stats_window_size"), NO_COUNT),
    **dict.fromkeys(("gamma", "gae_lambda"), NO_SHARE),
    "cost_margin": [1.0, *NO_SHARE],
    "cost_gamma": without_none(NO_SHARE),
    "learning_rate": NO_RATE,
    "critic_learning_rate": without_none(NO_RATE),
    "clip_range": [*NO_AMOUNT, *NO_SCHEDULE],
    "clip_range_vf": [0.0, *without_none(NO_AMOUNT), *NO_SCHEDULE],
    **dict.fromkeys(("ent_coef", "vf_coef", "reward_scale"), NO_FACTOR),
    "max_grad_norm": NO_AMOUNT,
    "target_kl": without_none(NO_AMOUNT),
    **dict.fromkeys(("normalize_advantage", "normalize_values"), NO_SWITCH),
    **dict.fromkeys(("policy_kwargs", "multipliers_kwargs", "opponent_kwargs"), NO_KEYWORDS),
    "oem_kwargs": NO_KEYWORDS,
    "seed": [-1, 2**32, 0.5, "1", [1], True, NAN],
    "tensorboard_log": [1, True, [], b"a"],
    "update_threads": [0, 3, "2", True, 1.0],
    "verbose": [-1, None, "1", 0.5, [], NAN],
    "device": [None, 0, "", "a", "cpu:", "meta", "mps:9", ["cpu"], th.device("meta")],
}
SMALL = {"n_steps": 4, "batch_size": 8, "n_epochs": 1, "policy_kwargs": {"net_arch": [4]}}
SMALL = {**SMALL, "seed": 0, "device": "cpu"}


def make(kind=MAPPO, policy="MlpPolicy", n_updates=0, **kwargs):
    env = share_parameters(TwoOnALine, n_worlds=2)
    model = kind(policy, **{"env": env, **SMALL, **kwargs})
    return model.learn(n_updates * 4 * 4) if n_updates else model


def flat(model):
    return th.nn.utils.parameters_to_vector(model.policy.parameters())


def test_every_argument_has_a_rule():
    by_themselves = {"policy", "env", "cost_limits", "cost_scope", "multipliers_class"}
    arguments = set(inspect.signature(MAPPO).parameters) - by_themselves - {"_init_setup_model"}
    assert set(RULES) == arguments | {"oem_kwargs"} == set(ODD)


@pytest.mark.parametrize("name", ODD)
def test_what_does_not_fit_is_refused_by_its_name(name):
    kind = E2CMAPPO if name == "oem_kwargs" else MAPPO
    for odd in ODD[name]:
        if name == "oem_kwargs" and odd is None:
            continue
        with pytest.raises((TypeError, ValueError)) as refusal:
            make(kind, **{name: odd})
        message = str(refusal.value)
        assert message.startswith(f"{name} is {odd!r}"[:200]), message
        assert f"; expected {RULES[name].expected}" in message


def test_another_kind_is_a_type_error_and_another_size_a_value_error():
    with pytest.raises(TypeError, match=r"^gamma is 'a'; expected a number from 0 to 1$"):
        make(gamma="a")
    with pytest.raises(ValueError, match=r"^gamma is 2; expected a number from 0 to 1$"):
        make(gamma=2)


def test_why_a_schedule_fails_is_told():
    with pytest.raises(ValueError, match=r"^clip_range is .*; expected .* a schedule") as refusal:
        make(clip_range=lambda progress: 1 / progress)
    assert isinstance(refusal.value.__cause__, ZeroDivisionError)


def test_numpy_s_numbers_do_the_same_as_python_s():
    numbers = {"n_steps": 4, "batch_size": 8, "n_epochs": 2, "stats_window_size": 3, "seed": 7}
    numbers |= {"learning_rate": 0.125, "gamma": 0.5, "gae_lambda": 0.75, "clip_range": 0.25}
    numbers |= {"clip_range_vf": 0.5, "ent_coef": 0.125, "vf_coef": 0.25, "max_grad_norm": 1.0}
    numbers |= {"target_kl": 8.0, "reward_scale": 2.0, "critic_learning_rate": 0.25, "verbose": 0}
    numbers |= {"cost_margin": 0.25}
    numbers |= {"cost_gamma": 0.25, "normalize_values": True, "normalize_advantage": False}
    types = {int: np.int64, float: np.float32, bool: np.bool_}  # all are whole binary fractions
    plain = make(n_updates=2, **numbers)
    same = make(n_updates=2, **{key: types[type(x)](x) for key, x in numbers.items()})
    assert flat(plain).equal(flat(same))
    for name in ATTRIBUTES:
        assert type(getattr(plain, name)) is type(getattr(same, name)), name


def test_a_number_is_the_schedule_that_is_always_that_number():
    rates = {"learning_rate": 0.125, "critic_learning_rate": 0.25}
    rates |= {"clip_range": 0.25, "clip_range_vf": 0.5}
    plain = make(n_updates=2, **rates)
    same = make(n_updates=2, **{name: ConstantSchedule(x) for name, x in rates.items()})
    assert flat(plain).equal(flat(same))


@pytest.mark.parametrize(
    "kwargs",
    [
        {"clip_range": INF, "max_grad_norm": INF, "target_kl": INF, "clip_range_vf": INF},
        {"learning_rate": 0, "clip_range": 0, "max_grad_norm": 0, "target_kl": 0},
        {"gamma": 0, "gae_lambda": 1, "cost_gamma": 1, "reward_scale": 0},
        {"clip_range_vf": LinearSchedule(0.5, 0.0, 1.0), "learning_rate": abs},
        {"verbose": False, "seed": None, "tensorboard_log": None, "policy_kwargs": None},
        {"multipliers_kwargs": None, "opponent_kwargs": None, "device": th.device("cpu")},
        {"seed": 2**32 - 1, "device": "cuda"},  # the CPU where there is no CUDA, as elsewhere
    ],
    ids=str,
)
def test_what_makes_sense_at_the_edge_is_taken(kwargs):
    assert th.isfinite(flat(make(n_updates=2, **kwargs))).all()


def test_a_log_folder_may_be_a_path(tmp_path):
    pytest.importorskip("tensorboard")
    make(n_updates=1, tensorboard_log=tmp_path / "logs")
    assert list(Path(tmp_path).rglob("events.*"))


def test_what_load_replaces_is_checked_too(tmp_path):
    make().save(tmp_path / "model")
    with pytest.raises(ValueError, match=r"^gamma is -1; expected"):
        MAPPO.load(tmp_path / "model", gamma=-1)
    model = MAPPO.load(tmp_path / "model", learning_rate=np.float32(0.5))
    assert type(model.learning_rate) is float


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"activation_fn": int}, "int"),
        ({"log_std_init": "a"}, ""),
        ({"optimizer_kwargs": {"eps": -1}}, "Invalid epsilon value: -1"),
        ({"optimizer_kwargs": {"eps": "a"}}, "str"),
        ({"squash_output": True}, "squash_output=True is only available when using gSDE"),
        ({"log_std_init": NAN}, r"log_std begins with numbers that are not finite"),
        ({"net_arch": 3}, "net_arch has 3"),
    ],
)
def test_networks_that_cannot_be_made_name_policy_kwargs(kwargs, message):
    with pytest.raises(ValueError, match=rf"{message}.*; found in n_steps=4, policy_kwargs="):
        make(policy_kwargs=kwargs, env="Pendulum-v1")  # continuous actions


def test_a_rollout_that_no_array_can_hold_names_n_steps():
    with pytest.raises(ValueError, match=r"; found in n_steps=4611686018427387904,"):
        make(n_steps=2**62)


def test_a_model_without_an_environment_is_explained():
    with pytest.raises(TypeError, match=r"env is None; expected what share_parameters"):
        make(env=None)


def test_an_object_that_cannot_be_shown_is_named_by_its_type():
    with pytest.raises(ValueError, match=r"gamma is an object of type int; expected"):
        checked("gamma", 10**5000)  # Python refuses to write so many digits
    with pytest.raises(TypeError, match=r"gamma is 'aaa.*\.\.\.; expected"):
        checked("gamma", "a" * 1000)


@pytest.mark.parametrize("kind", [GradientMultipliers, PIDMultipliers])
@pytest.mark.parametrize(
    "kwargs",
    [
        *({"shape": odd} for odd in ("a", 1, None, (1,), (1, -1), (1.0, 1), [[1, 1]])),
        *({"agent_scaling": odd} for odd in (None, 1, "a", 0.0)),
        *({"pooled": odd} for odd in (None, 1, "a", 0.0)),
        *({"initial": odd} for odd in (None, "a", -1, NAN, INF, True, 10**400, [0.0])),
        *({"maximum": odd} for odd in (None, "a", -1, NAN, True, 1e300)),
    ],
    ids=str,
)
def test_multipliers_refuse_odd_arguments_by_their_name(kind, kwargs):
    (name,) = kwargs
    with pytest.raises((TypeError, ValueError), match=f"multipliers: {name} is"):
        kind(**{"shape": (1, 1), **kwargs})
