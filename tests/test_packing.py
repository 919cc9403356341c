"""Packing: every run that trains is in one lane, beside its like, and each device has its share."""

import itertools

import jax
import numpy as np
import pytest

from mjx_reinforce.learners.learner import TrainState
from mjx_reinforce.runs.config import MAX_COUNT
from mjx_reinforce.runs.packing import pack, put_back, spread, take, training
from mjx_reinforce.runs.state import Budget, RunState


def states(env_steps, updates):
    count = len(env_steps)
    return RunState(
        train_states=TrainState(
            key=np.arange(2 * count, dtype=np.uint32).reshape(count, 2),
            num_updates=np.array(updates, np.int32),
            actor=np.arange(3.0 * count).reshape(count, 3),
            opt_state=(),
            estimator_state=(),
        ),
        env_steps=np.array(env_steps, np.int32),
    )


def test_a_run_trains_until_one_of_its_budgets_is_used():
    runs = states([0, 99, 100, 300, 5], [3, 8, 2, 1, 9])
    assert training(runs, Budget(100, 9)).tolist() == [True, True, False, False, False]


@pytest.mark.parametrize("num_devices", [1, 2, 8])
@pytest.mark.parametrize("active", [1, 7, 8, 9, 40, 61, 100])
def test_each_run_has_one_lane_and_each_device_its_share(num_devices, active):
    random = np.random.default_rng(active)
    chosen = random.permutation(100) < active
    lengths = random.integers(1, 21, 100)
    lanes = pack(chosen, lengths, [16, 8], num_devices)
    assert lanes.shape == ((1, 8) if active <= 8 else (-(-active // 16), 16))
    assert sorted(lanes[lanes >= 0]) == np.flatnonzero(chosen).tolist()
    shares = (lanes.reshape(len(lanes), num_devices, -1) >= 0).sum(axis=-1)
    assert np.all(shares.max(axis=1) - shares.min(axis=1) <= 1)
    each = [lengths[slot[slot >= 0]] for slot in lanes]
    assert all(a.max() <= b.min() for a, b in itertools.pairwise(each))


def test_runs_of_equal_lengths_stay_in_order():
    """So that a resumed run packs as it would have."""
    lanes = pack(np.ones(40, bool), np.full(40, 3), [16], 1)
    assert lanes[lanes >= 0].tolist() == list(range(40))


def test_states_go_to_their_lanes_and_back():
    before = states([10, 20, 30, 40, 50], range(5))
    lanes = np.array([[3, 0], [4, -1]])
    slots = [take(before, runs) for runs in lanes]
    assert slots[1].env_steps.tolist() == [50, MAX_COUNT]
    moved = [jax.tree.map(lambda x: x + 1, slot) for slot in slots]
    after = put_back(before, lanes, moved)
    for old, new in zip(jax.tree.leaves(before), jax.tree.leaves(after), strict=True):
        assert np.array_equal(new[[0, 3, 4]], old[[0, 3, 4]] + 1)
        assert np.array_equal(new[[1, 2]], old[[1, 2]])
    assert before.env_steps.tolist() == [10, 20, 30, 40, 50]


def test_measurements_go_to_their_runs():
    lanes = np.array([[3, 0], [2, -1]])
    slots = [{"x": np.array([[1, 2], [3, 4]])}, {"x": np.array([[5, 6], [7, 8]])}]
    assert spread(5, lanes, slots)["x"].tolist() == [[2, 0, 5, 1, 0], [4, 0, 7, 3, 0]]
