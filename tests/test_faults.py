"""Worlds that break the contract: a clear error within seconds, and nothing is left behind."""

import multiprocessing
import os
import signal
import sys
import time

import numpy as np
import pytest
import torch as th
from conftest import TwoOnALine, TwoOnManyLines
from gymnasium import spaces
from pettingzoo.utils import BaseParallelWrapper

from sb3_e2c import E2CMAPPO, MAPPO, TeamEvalCallback, evaluate_team, share_parameters

SMALL = {"n_steps": 8, "batch_size": 16, "n_epochs": 1, "device": "cpu", "seed": 0}
PATIENCE = 20.0  # seconds within which every case ends, on a busy machine
LAST = "agent_1"


def spoiled(answer, place, value):
    """What step() returned, with something else in the last agent's place of one part.

    :param place: name of the part
    :param value: what stands there, a function of what stood there, or DROP
    """
    names = ("observations", "rewards", "terminations", "truncations", "infos")
    parts = dict(zip(names, answer, strict=True))
    part = parts[place] = dict(parts[place])
    if value is DROP:
        del part[LAST]
    else:
        part[LAST] = value(part[LAST]) if callable(value) else value
    return tuple(parts.values())


DROP = object()
ROW = np.array([1, 2, 3], np.float32)


def info(**entries):
    return lambda old: {**old, **entries}


def without(key):
    return lambda old: {k: v for k, v in old.items() if k != key}


NOTHING = r"those of world 1: \{.*'agent_1': 'nothing'\}"

# fault: (part of the answer, what stands in it for the last agent, what the error says)
SPOILED = {
    "NaN observation": ("observations", ROW * np.nan, "observation of .* is not finite .*nan"),
    "infinite observation": ("observations", ROW * np.inf, "observation of .* is not finite .*inf"),
    "too large observation": (
        "observations",
        ROW.astype(float) * 1e300,
        "observation of .* is not finite .*inf",
    ),
    "observation too long": ("observations", np.zeros(4), r"observation of .* shape \(4,\)"),
    "observation with an axis": ("observations", ROW[None], r"observation of .* shape \(1, 3\)"),
    "observation of text": ("observations", ROW.astype(str), "observation of .* type <U32"),
    "complex observation": ("observations", ROW + 1j, "observation of .* type complex64"),
    "ragged observation": (
        "observations",
        [[1.0], [1.0, 2.0], 3.0],
        r"observation of .* \[\[1.0\], ",
    ),
    "no observation": ("observations", None, "observation of .* is None"),
    "observation missing": (
        "observations",
        DROP,
        r"observations with nothing for the agents \['agent_1'",
    ),
    "NaN reward": ("rewards", np.nan, "reward of .* is not finite .*nan"),
    "infinite reward": ("rewards", -np.inf, "reward of .* is not finite .*-inf"),
    "too large reward": ("rewards", 1e300, "reward of .* is not finite .*inf"),
    "no reward": ("rewards", None, "reward of .* is None; expected one number"),
    "reward of text": ("rewards", "much", "reward of .* is 'much'; expected one number"),
    "array of rewards": ("rewards", np.ones(2), r"reward of .* shape \(2,\).*expected one number"),
    "reward missing": ("rewards", DROP, r"rewards with nothing for the agents \['agent_1'"),
    "end missing": ("terminations", DROP, r"terminations with nothing for the agents \['agent_1'"),
    "end that is NaN": ("terminations", np.nan, "termination of .* is nan; expected True or False"),
    "end that is an array": (
        "truncations",
        np.zeros(2, bool),
        "truncation of .*; expected True or False",
    ),
    "early end of one agent": (
        "terminations",
        True,
        r"agents \['agent_1'\] of world 1 ended while",
    ),
    "info of another kind": ("infos", 3, "info of .* is 3; expected a dict"),
    "info missing": ("infos", DROP, NOTHING),
    "cost missing": ("infos", without("cost"), NOTHING),
    "NaN cost": ("infos", info(cost=np.nan), "cost of .* is not finite .*nan"),
    "infinite cost": ("infos", info(cost=np.inf), "cost of .* is not finite .*inf"),
    "negative cost": (
        "infos",
        info(cost=-1.0),
        r"cost of .* is negative .*-1.0; expected 0 or more",
    ),
    "two costs": (
        "infos",
        info(cost=[0.0, 1.0]),
        r"those of world 1: \{.*'agent_1': \[0.0, 1.0\]\}",
    ),
    "cost of text": ("infos", info(cost="high"), r"those of world 1: \{.*'agent_1': 'high'\}"),
}


class Faulty(BaseParallelWrapper):
    """The line, whose second world fails in its third step of every episode.

    Worlds tell themselves apart by their random stream: which one may be the second is drawn by
    the first reset with a seed, seeds being 0 for the first world and 1 for the second.

    :param fault: a name of SPOILED, or a function of this world
    """

    def __init__(self, fault, **parameters):
        super().__init__(TwoOnALine(length=5, **parameters))
        self.fault, self.second = fault, False

    def reset(self, seed=None, options=None):
        if seed is not None:
            self.second = seed == 1
        return super().reset(seed=seed, options=options)

    def step(self, actions):
        answer = super().step(actions)
        if not self.second or self.env.t != 3:
            return answer
        if callable(self.fault):
            return self.fault(self, answer)
        place, value, _ = SPOILED[self.fault]
        return spoiled(answer, place, value)


def raise_an_error(*_):
    raise ZeroDivisionError("the rover fell off the edge")


class TwoPart(Exception):
    """Cannot be unpickled: its constructor wants another number of arguments."""

    def __init__(self, what, where):
        super().__init__(f"{what} at {where}")


def raise_an_odd_error(*_):
    raise TwoPart("rain", "home")


def raise_a_broken_pipe(*_):
    raise BrokenPipeError("the radio is silent")


def leave_a_child(*_):
    if not os.fork():
        time.sleep(3)
        os._exit(0)
    os._exit(7)


# fault: (what step() does, the error, what it says)
ACTIONS = {
    "an error": (raise_an_error, ZeroDivisionError, "the rover fell off the edge"),
    "an error of the environment's own pipe": (
        raise_a_broken_pipe,
        BrokenPipeError,
        "radio is silent",
    ),
    "sys.exit": (lambda *_: sys.exit(3), RuntimeError, r"step\(\) of world 1 called sys.exit\(3\)"),
    "a single-agent answer": (
        lambda *_: (0, 1.0, False, {}),
        ValueError,
        r"step\(\) of world 1 returned int, float, bool, dict; expected 5 dicts",
    ),
    "nothing": (
        lambda *_: None,
        ValueError,
        r"step\(\) of world 1 returned NoneType; expected 5 dicts",
    ),
}

# fault, in a worker process only: (what step() does, the error, what it says)
DEATHS = {
    "kill -9": (
        lambda *_: os.kill(os.getpid(), signal.SIGKILL),
        RuntimeError,
        "ended with exit code -9",
    ),
    "exit without a word": (lambda *_: os._exit(0), RuntimeError, "ended with exit code 0"),
    "exit with a child left": (leave_a_child, RuntimeError, "ended with exit code 7"),
    "a hang": (
        lambda *_: time.sleep(60),
        TimeoutError,
        r"has not answered for 2 seconds; .*timeout=\.\.\.",
    ),
    "an error that cannot be read": (
        raise_an_odd_error,
        RuntimeError,
        "sent something that cannot be read",
    ),
}


def line(fault, n_processes=1, **parameters):
    make_env = lambda: Faulty(fault, **parameters)  # noqa: E731
    return share_parameters(make_env, 2, n_processes, seed=0, timeout=2.0)


def learn(env, tmp_path, **kwargs):
    model = MAPPO("MlpPolicy", env, cost_limits=1.0, **SMALL, **kwargs)
    model.save(tmp_path / "model")
    model.learn(32)


def evaluate(env, tmp_path):
    model = MAPPO("MlpPolicy", share_parameters(TwoOnALine, 2), **SMALL)
    model.save(tmp_path / "model")
    evaluate_team(model, env, 4)


def learn_and_evaluate(env, tmp_path):
    model = MAPPO("MlpPolicy", share_parameters(TwoOnALine, 2), cost_limits=1.0, **SMALL)
    model.save(tmp_path / "model")
    callback = TeamEvalCallback(env, eval_freq=8, best_model_save_path=str(tmp_path / "best"))
    model.learn(64, callback=callback)


WAYS = {"learn": learn, "evaluate_team": evaluate, "TeamEvalCallback": learn_and_evaluate}


def check(env, way, tmp_path, error, message, patience=PATIENCE):
    """It stops in time with the error; workers are gone; what was saved is loaded and finite."""
    start = time.monotonic()
    with pytest.raises(error, match=f"(?s){message}") as caught:
        WAYS[way](env, tmp_path)
    env.close()
    assert time.monotonic() - start < patience
    assert not multiprocessing.active_children()
    loaded = MAPPO.load(tmp_path / "model", device="cpu")
    assert all(th.isfinite(parameter).all() for parameter in loaded.policy.parameters())
    return caught


class TestAnswers:
    @pytest.mark.parametrize("fault", SPOILED)
    def test_a_fault_while_learning_is_named_with_its_world_and_agent(self, fault, tmp_path):
        message = SPOILED[fault][2]
        caught = check(line(fault), "learn", tmp_path, ValueError, message)
        assert "world 1" in str(caught.value)
        assert LAST in str(caught.value)

    @pytest.mark.parametrize("fault", sorted(set(SPOILED) - {"negative cost"}))
    def test_a_fault_while_evaluating_is_named_too(self, fault, tmp_path):
        message = SPOILED[fault][2]
        caught = check(line(fault), "evaluate_team", tmp_path, ValueError, message)
        assert "world 1" in str(caught.value)
        if "not finite" in str(caught.value):
            assert "at step 3 of the evaluation" in str(caught.value)

    @pytest.mark.parametrize("fault", ["NaN observation", "NaN reward", "NaN cost", "cost missing"])
    def test_a_fault_in_an_evaluation_stops_the_training(self, fault, tmp_path):
        check(line(fault), "TeamEvalCallback", tmp_path, ValueError, SPOILED[fault][2])

    def test_a_fault_in_a_worker_process_says_the_same(self, tmp_path):
        for fault in (
            "NaN reward",
            "observation too long",
            "cost missing",
            "early end of one agent",
        ):
            env = line(fault, n_processes=2)
            check(env, "learn", tmp_path, ValueError, SPOILED[fault][2])

    @pytest.mark.parametrize("fault", ["NaN cost", "NaN reward"])
    def test_what_nobody_learns_from_stops_the_run_too(self, fault, tmp_path):
        # without limits costs are only watched; the pure bonus takes the place of the reward
        model = E2CMAPPO("MlpPolicy", line(fault), **SMALL)
        with pytest.raises(
            ValueError, match=r"world 1, agent 'agent_1' is not finite at step 2 of"
        ):
            model.learn(32)

    def test_negative_costs_may_be_watched_but_not_limited(self, tmp_path):
        MAPPO("MlpPolicy", line("negative cost"), **SMALL).learn(32)
        evaluation = evaluate_team(
            MAPPO("MlpPolicy", line("negative cost"), **SMALL), line("negative cost"), 4
        )
        assert evaluation.costs.min() < 4

    def test_costs_whose_number_changes_in_all_worlds_are_refused(self, tmp_path):
        class Growing(TwoOnALine):
            batched = None

            def step(self, actions):
                self.n_costs = 1 + (self.t >= 2)
                return super().step(actions)

        env = share_parameters(Growing, 2)
        check(env, "learn", tmp_path, ValueError, "report 2 costs .* now and reported 1 before")

    def test_integers_must_fit_their_type(self):
        class Bytes(TwoOnALine):
            batched = None

            def observation_space(self, agent):
                return spaces.Box(0, 255, (3,), np.uint8)

            def _observations(self):
                return dict.fromkeys(self.possible_agents, np.array([0, 1, self.value]))

        Bytes.value = 255
        env = share_parameters(Bytes, 1)
        assert env.reset().tolist() == [[0, 1, 255]] * 2
        for value in (256, -1, 0.5, np.nan):
            Bytes.value = value
            with pytest.raises(ValueError, match=r"world 0, agent 'agent_0' is an array of shape"):
                env.reset()


class TestActions:
    @pytest.mark.parametrize("n_processes", [1, 2])
    @pytest.mark.parametrize("fault", ACTIONS)
    def test_what_a_world_does_in_a_step_arrives_with_its_message(
        self, fault, n_processes, tmp_path
    ):
        action, error, message = ACTIONS[fault]
        caught = check(line(action, n_processes), "learn", tmp_path, error, message)
        if sys.version_info >= (3, 11) and "error" in fault:
            assert caught.value.__notes__ == ["The error was raised by step() of world 1."]

    @pytest.mark.parametrize("fault", DEATHS)
    def test_a_worker_process_that_is_lost_is_named_with_its_worlds(self, fault, tmp_path):
        action, error, message = DEATHS[fault]
        message = rf"worker process 1 \(worlds 1 to 1\) {message}"
        env = line(action, 2)
        # a worker that hangs is waited for 2 seconds, and killed at once
        check(env, "learn", tmp_path, error, message, patience=8.0)
        with pytest.raises(RuntimeError, match="make a new one"):
            env.reset()

    @pytest.mark.parametrize("way", ["evaluate_team", "TeamEvalCallback"])
    def test_a_worker_process_lost_in_an_evaluation_is_named_too(self, way, tmp_path):
        action, error, message = DEATHS["kill -9"]
        check(line(action, 2), way, tmp_path, error, message)

    def test_an_environment_that_hangs_while_it_is_made_is_given_up(self):
        parent = os.getpid()

        def make_env():
            if os.getpid() != parent:
                time.sleep(60)
            return TwoOnALine()

        with pytest.raises(TimeoutError, match=r"worker process 0 .* has not answered for 0.5 sec"):
            share_parameters(make_env, 2, n_processes=2, timeout=0.5)
        assert not multiprocessing.active_children()

    def test_a_slow_worker_is_not_given_up_while_it_keeps_its_time(self):
        def slow(world, answer):
            time.sleep(0.8)
            return answer

        env = share_parameters(lambda: Faulty(slow), 2, n_processes=2, timeout=30.0)
        env.reset()
        for _ in range(3):
            env.step(np.zeros(4, int))
        env.close()

    @pytest.mark.parametrize("timeout", [0, -1, "long", True, float("nan")])
    def test_a_timeout_that_makes_no_sense_is_refused(self, timeout):
        with pytest.raises(ValueError, match=r"timeout is .*; expected seconds above 0, or None"):
            share_parameters(TwoOnALine, 2, n_processes=2, timeout=timeout)

    def test_a_reset_of_the_old_kind_is_explained(self):
        class Old(TwoOnALine):
            batched = None

            def reset(self, seed=None, options=None):
                return super().reset(seed, options)[0]

        with pytest.raises(
            ValueError, match=r"reset\(\) of world 0 returned dict; expected 2 dict"
        ):
            share_parameters(Old, 2)


def test_random_faults_at_random_moments_always_end_in_an_error():
    rng = np.random.default_rng(0)

    class Dice(TwoOnALine):
        batched = None

        def step(self, actions):
            answer = super().step(actions)
            if rng.random() > 0.05:
                return answer
            place, value, _ = SPOILED[self.fault]
            return spoiled(answer, place, value)

    model = MAPPO("MlpPolicy", share_parameters(Dice, 1), cost_limits=1.0, **SMALL)
    before = th.nn.utils.parameters_to_vector(model.policy.parameters())
    for Dice.fault in rng.permutation(list(SPOILED) * 2).tolist():
        with pytest.raises(ValueError, match=LAST):
            model.learn(10_000)
        parameters = th.nn.utils.parameters_to_vector(model.policy.parameters())
        assert th.isfinite(parameters).all()
    assert not parameters.equal(before)  # some learned before the world failed


def is_running(pid):
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


@pytest.mark.skipif(not os.path.exists("/proc/self/stat"), reason="needs /proc")
def test_workers_end_when_the_program_is_killed():
    def program(pipe):
        env = share_parameters(TwoOnALine, 2, n_processes=2)
        env.reset()
        pipe.send([process.pid for process in env.worlds.vec.procs])
        time.sleep(60)

    receiver, sender = multiprocessing.Pipe(duplex=False)
    process = multiprocessing.get_context("fork").Process(target=program, args=(sender,))
    process.start()
    assert receiver.poll(PATIENCE)
    workers = receiver.recv()
    assert all(map(is_running, workers))
    process.kill()
    process.join()
    end = time.monotonic() + PATIENCE
    while any(map(is_running, workers)) and time.monotonic() < end:
        time.sleep(0.05)
    assert not any(map(is_running, workers))


class TestOpponents:
    """The last agent is not of the team, but an opponent."""

    def env(self, fault, n_processes=1):
        make_env = lambda: Faulty(fault)  # noqa: E731
        return share_parameters(make_env, 2, n_processes, team=["agent_0"], timeout=2.0)

    @pytest.mark.parametrize("acting", ["learning", "trained"])
    @pytest.mark.parametrize(
        "fault", ["NaN observation", "observation too long", "observation missing", "NaN reward"]
    )
    def test_a_fault_on_their_side_is_named(self, fault, acting, tmp_path):
        env = self.env(fault)
        if acting == "trained":
            env.set_opponent(MAPPO("MlpPolicy", env, **SMALL).new_opponent(env))
            if fault == "NaN reward":
                pytest.skip("nobody learns from the rewards of opponents that do not learn")
        caught = check(env, "learn", tmp_path, ValueError, SPOILED[fault][2])
        assert "world 1" in str(caught.value)

    def test_an_evaluation_names_it_too(self):
        env = self.env("NaN observation")
        model = MAPPO("MlpPolicy", env, **SMALL)
        with pytest.raises(ValueError, match="observation of world 1, agent 'agent_1' is not fin"):
            evaluate_team(model, env, 4)

    def test_a_worker_that_dies_is_named(self, tmp_path):
        action, error, message = DEATHS["kill -9"]
        check(self.env(action, 2), "learn", tmp_path, error, message)


# fault of a batched simulator: (the changed part, how, what the error says)
SIMULATORS = {
    "rewards of fewer worlds": (
        1,
        lambda a: a[:1],
        r"rewards of shape \(1, 2\); expected .*\(2, 2\)",
    ),
    "a reward for each world": (1, lambda a: a[:, 0], r"rewards of shape \(2,\)"),
    "rewards of text": (1, lambda a: a.astype(str), "rewards of type <U"),
    "rewards in a list": (1, lambda a: a.tolist(), "rewards of type list"),
    "observations of slots": (0, lambda a: a.reshape(4, 3), r"observations of shape \(4, 3\)"),
    "longer observations": (
        0,
        lambda a: np.repeat(a, 2, axis=2),
        r"observations of shape \(2, 2, 6\)",
    ),
    "observations of objects": (0, lambda a: a.astype(object), "observations of type object"),
    "NaN observations": (
        0,
        lambda a: a + np.array([0, np.nan, 0], np.float32),
        "observation of world 0, agent 'agent_0' is not finite",
    ),
    "ends for each slot": (2, lambda a: np.repeat(a, 2), r"terminated of shape \(4,\)"),
    "ends that are numbers": (3, lambda a: a.astype(int), "truncated of type int64; expected bool"),
    "infos for each slot": (
        4,
        lambda c: {"cost": c["cost"].ravel()},
        r"infos\['cost'\] of shape \(4,\)",
    ),
    "infos in a list": (4, lambda c: [{}] * 4, "infos .*; expected a dict"),
    "NaN costs": (
        4,
        lambda c: {"cost": c["cost"] * np.nan},
        "cost of world 0, agent 'agent_0' is not",
    ),
}


class TestSimulators:
    def simulator(self, change):
        class Sim(TwoOnManyLines):
            def step(self, actions):
                return change(super().step(actions))

        class Env(TwoOnALine):
            def batched(self, n_worlds):
                return Sim(n_worlds, **self.parameters)

        return share_parameters(Env, 2, backend="batched")

    @pytest.mark.parametrize("fault", SIMULATORS)
    def test_a_fault_is_named(self, fault, tmp_path):
        number, how, message = SIMULATORS[fault]

        def change(answer):
            return (*answer[:number], how(answer[number]), *answer[number + 1 :])

        check(self.simulator(change), "learn", tmp_path, ValueError, message)

    def test_an_answer_with_too_few_parts_is_refused(self, tmp_path):
        env = self.simulator(lambda answer: answer[:4])
        check(
            env, "learn", tmp_path, ValueError, r"step\(\) of the simulator returned a tuple of 4"
        )

    def test_an_array_that_is_used_again_is_refused(self, tmp_path):
        buffer = np.zeros((2, 2, 3), np.float32)

        def reuse(answer):
            buffer[:] = answer[0]
            return (buffer, *answer[1:])

        check(self.simulator(reuse), "learn", tmp_path, ValueError, "the array of the step before")

    def test_float64_arrays_become_float32(self):
        env = self.simulator(lambda a: (a[0].astype(np.float64), a[1].astype(np.float64), *a[2:]))
        env.reset()
        observations, rewards, _, _ = env.step(np.zeros(4, int))
        assert observations.dtype == rewards.dtype == np.float32

    @pytest.mark.parametrize("part", ["observations", "infos"])
    def test_the_reset_of_another_number_of_worlds_is_refused(self, part):
        class Sim(TwoOnManyLines):
            def reset(self, worlds, seeds, options=None):
                observations, columns = super().reset(worlds, seeds, options)
                if part == "observations":
                    return observations[:1], columns
                return observations, {name: column[:1] for name, column in columns.items()}

        class Env(TwoOnALine):
            def batched(self, n_worlds):
                return Sim(n_worlds, **self.parameters)

        with pytest.raises(
            ValueError, match=r"reset\(\) of the simulator returned .* of shape \(1,"
        ):
            share_parameters(Env, 2).reset()

    def test_a_simulator_of_another_number_of_worlds_is_refused(self):
        class Env(TwoOnALine):
            def batched(self, n_worlds):
                return TwoOnManyLines(n_worlds + 1, **self.parameters)

        with pytest.raises(ValueError, match=r"has 3 worlds of .*; expected 2 of"):
            share_parameters(Env, 2)
