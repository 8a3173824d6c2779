"""Algorithm 1 lines 3-10: what a new observation is worth."""

import copy
import math
import pickle

import numpy as np
import pytest

from sb3_e2c.entropy import EntropyEstimator, NearestNeighbor, VisitCount


@pytest.fixture(params=[VisitCount(), NearestNeighbor(1)], ids=["visits", "neighbors"])
def estimator(request: pytest.FixtureRequest) -> EntropyEstimator:
    return copy.deepcopy(request.param)


def score_one(estimator: EntropyEstimator, *observations: list[float]) -> list[float]:
    """Bonuses of a sequence of observations of one slot."""
    estimator.reset(1)
    return [float(estimator.score(np.array([o], np.float32))[0]) for o in observations]


def test_the_first_visit_earns_1_and_the_second_one_half():
    here, there = [-1.0, 3.0], [3.0, -1.0]
    assert score_one(VisitCount(), here, here, there, here) == [1, 1 / 2, 1, pytest.approx(1 / 3)]


def test_level_1_only_tells_something_from_nothing():
    codes = VisitCount().quantize(np.array([-1.0, 0.0, 0.3, 7.0], np.float32))
    assert codes.tolist() == [0, 1, 1, 1]


def test_quantized_neighbors_count_as_the_same_observation():
    assert score_one(VisitCount(), [0.2, -1.0], [0.9, -1.0], [0.9, 0.9]) == [1, 1 / 2, 1]


def test_level_4_bins_at_multiples_of_a_quarter_of_high():
    # high / q = 2: [0, 2) is 1, [2, 4) is 2, [4, 6) is 3, from 6 on is 4
    estimator = VisitCount(quantization=4, high=8.0)
    codes = estimator.quantize(np.array([-1.0, 0.0, 1.9, 2.0, 5.9, 6.0, 8.0, 50.0, -0.5]))
    assert codes.tolist() == [0, 1, 1, 2, 3, 4, 4, 4, 1]
    assert score_one(estimator, [0.5], [1.5], [2.5]) == [1, 1 / 2, 1]


def test_empty_is_recognized_where_float32_cannot_hold_it():
    assert VisitCount(empty=-0.1).quantize(np.array([-0.1, -0.2], np.float32)).tolist() == [0, 1]
    assert VisitCount(empty=0.0).quantize(np.array([0.0, 1e-9], np.float32)).tolist() == [0, 1]


def test_knn_bonus_is_log_of_1_plus_the_distance_to_the_kth_neighbor():
    # (0, 0) lies at 5 from (3, 4), at 10 from (6, 8) and at 13 from (5, 12)
    stored = [3.0, 4.0], [5.0, 12.0], [6.0, 8.0]
    for k, distance in (1, 5.0), (2, 10.0), (3, 13.0):
        bonus = score_one(NearestNeighbor(k), *stored, [0.0, 0.0])[-1]
        assert bonus == pytest.approx(math.log(distance + 1), rel=1e-6)


def test_with_fewer_than_k_neighbors_the_farthest_counts():
    bonuses = score_one(NearestNeighbor(5), [0.0], [1.0], [3.0], [2.0])
    assert bonuses == pytest.approx([0, math.log(1 + 1), math.log(3 + 1), math.log(2 + 1)])


def test_knn_bonus_is_0_without_earlier_observations():
    assert score_one(NearestNeighbor(1), [7.0]) == [0]


def test_the_observation_is_scored_before_it_is_stored():
    # stored first, it would be its own nearest neighbor, at distance 0
    assert score_one(NearestNeighbor(1), [0.0], [2.0])[-1] == pytest.approx(math.log(2 + 1))


def test_repeated_observations_are_neighbors_at_distance_0():
    assert score_one(NearestNeighbor(2), [4.0], [4.0], [4.0], [5.0])[2:] == [
        0,
        pytest.approx(math.log(2)),
    ]


def test_near_duplicates_keep_their_distance():
    # float32 numbers near 1000 are 2^-14 apart; |a|^2 - 2ab + |b|^2 would lose it entirely
    step = 2.0**-14
    observations = np.full((1, 60), 1000.0, np.float32)
    estimator = NearestNeighbor(1)
    estimator.reset(1)
    estimator.score(observations)
    assert estimator.score(observations + np.float32(step))[0] == pytest.approx(
        math.log1p(step * math.sqrt(60)), rel=1e-6
    )


def test_a_new_episode_forgets(estimator: EntropyEstimator):
    first, *_ = score_one(estimator, [5.0], [6.0])
    estimator.forget(np.array([True]))
    assert estimator.score(np.array([[5.0]]))[0] == first


def test_slots_do_not_share_a_memory():
    estimator = VisitCount()
    estimator.reset(2)
    assert estimator.score(np.array([[1.0], [-1.0]])).tolist() == [1, 1]
    assert estimator.score(np.array([[1.0], [1.0]])).tolist() == [1 / 2, 1]
    estimator.forget(np.array([True, False]))
    assert estimator.score(np.array([[1.0], [1.0]])).tolist() == [1, 1 / 2]


def test_slots_of_different_ages_have_their_own_neighbors():
    estimator = NearestNeighbor(1)
    estimator.reset(2)
    estimator.score(np.array([[0.0], [0.0]]))
    estimator.forget(np.array([False, True]))
    assert estimator.score(np.array([[3.0], [3.0]])) == pytest.approx([math.log(4), 0])


def literal_bonus(estimator: EntropyEstimator, memory: list[np.ndarray], new: np.ndarray) -> float:
    """Algorithm 1 lines 3-9 as it reads."""
    if isinstance(estimator, VisitCount):
        code = estimator.quantize(new)
        return 1 / (1 + sum((estimator.quantize(old) == code).all() for old in memory))
    distances = sorted(np.linalg.norm(new.astype(float) - old) for old in memory)
    return math.log(distances[: estimator.k][-1] + 1) if distances else 0.0


@pytest.mark.parametrize(
    "estimator",
    [
        VisitCount(),
        VisitCount(quantization=3, empty=0.0, high=4.0),
        NearestNeighbor(1),
        NearestNeighbor(5),
    ],
)
@pytest.mark.parametrize("size", [1, 7, 33])
def test_agrees_with_algorithm_1_as_it_reads_at_random_episode_ends(estimator, size):
    rng = np.random.default_rng(size)
    estimator.reset(3)
    memories: list[list[np.ndarray]] = [[], [], []]
    for _ in range(250):  # episodes of 100 steps on average: memories grow beyond 64 rows
        new = np.maximum(rng.integers(-3, 6, (3, size)), -1).astype(np.float32)
        expected = [literal_bonus(estimator, memories[s], new[s]) for s in range(3)]
        assert estimator.score(new) == pytest.approx(expected, rel=1e-5)
        ended = rng.random(3) < 0.01
        estimator.forget(ended)
        memories = [[] if ended[s] else [*memories[s], new[s]] for s in range(3)]


def test_memories_grow_with_the_episode():
    estimator = NearestNeighbor(1000)
    bonuses = score_one(estimator, *[[float(t)] for t in range(300)])
    assert bonuses == pytest.approx([math.log(t + 1) for t in range(300)], rel=1e-5)
    assert score_one(VisitCount(), *[[1.0]] * 300)[-1] == pytest.approx(1 / 300)


def test_a_pickled_estimator_goes_on_where_it_was(estimator: EntropyEstimator):
    score_one(estimator, [1.0], [4.0], [2.0])
    restored = pickle.loads(pickle.dumps(estimator))
    new = np.array([[9.0]])
    # three visits to "something" make 1/4; the nearest of 1, 4 and 2 is 5 away
    expected = 1 / 4 if isinstance(estimator, VisitCount) else pytest.approx(math.log(6))
    assert restored.score(new) == estimator.score(new) == expected


def test_what_is_remembered_does_not_change_with_the_array_that_was_scored(estimator):
    estimator.reset(1)
    observations = np.array([[1.0, -1.0]], np.float32)
    estimator.score(observations)
    assert observations.tolist() == [[1.0, -1.0]]
    observations[:] = 7.0
    again = estimator.score(np.array([[1.0, -1.0]]))
    assert again == (1 / 2 if isinstance(estimator, VisitCount) else 0)


@pytest.mark.parametrize("k", [0, -1, 2.0, "5", True, None])
def test_k_must_be_a_positive_integer(k):
    with pytest.raises(ValueError, match=r"k must be an integer of at least 1, got"):
        NearestNeighbor(k)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"quantization": 0}, "quantization must be an integer of at least 1, got 0"),
        ({"quantization": 2}, "quantization=2 sorts values .* no `high` was given"),
        ({"quantization": 2, "high": 0.0}, "high must be greater than 0, got 0.0"),
        ({"high": "large"}, "high must be a finite number, got 'large'"),
        ({"empty": math.nan}, "empty must be a finite number, got nan"),
        ({"empty": None}, "empty must be a finite number, got None"),
    ],
)
def test_visit_count_explains_bad_arguments(kwargs, message):
    with pytest.raises(ValueError, match=message):
        VisitCount(**kwargs)


def test_batches_of_the_wrong_shape_are_refused(estimator: EntropyEstimator):
    with pytest.raises(ValueError, match=r"call reset\(n_slots\) before score"):
        estimator.score(np.zeros((2, 3)))
    estimator.reset(2)
    estimator.score(np.zeros((2, 3)))
    for wrong in np.zeros((1, 3)), np.zeros(2), np.zeros((2, 3, 1)), np.zeros((2, 0)):
        with pytest.raises(ValueError, match=r"Expected observations of shape \(2, D\)"):
            estimator.score(wrong)
    with pytest.raises(ValueError, match="had 3 numbers before and now have 4"):
        estimator.score(np.zeros((2, 4)))
    estimator.reset(2)
    estimator.score(np.zeros((2, 4)))
