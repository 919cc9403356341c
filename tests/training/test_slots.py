"""Packing: every run that trains is in one lane, beside its like, and each device has its share."""

import itertools
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_reinforce.training.slots import Stopwatch, _of_slots, pack_slots, started
from mjx_reinforce.training.state import StateRows


@pytest.mark.parametrize("num_devices", [1, 2, 8])
@pytest.mark.parametrize("active", [1, 7, 8, 9, 16, 17, 24, 25, 40, 61, 100])
def test_each_run_has_one_lane_and_each_device_its_share(num_devices, active):
    random = np.random.default_rng(active)
    chosen = random.permutation(100) < active
    lengths = random.integers(1, 21, 100)
    lanes = pack_slots(chosen, lengths, 32, num_devices)
    assert lanes.shape == (-(-active // 32), 32)
    assert sorted(lanes[lanes >= 0]) == np.flatnonzero(chosen).tolist()
    shares = (lanes.reshape(len(lanes), num_devices, -1) >= 0).sum(axis=-1)
    assert np.all(shares.max(axis=1) - shares.min(axis=1) <= 1)
    each = [lengths[slot[slot >= 0]] for slot in lanes]
    assert all(a.max() <= b.min() for a, b in itertools.pairwise(each))


def test_runs_of_equal_lengths_stay_in_order():
    """So that a resumed run packs as it would have."""
    lanes = pack_slots(np.ones(40, bool), np.full(40, 3), 16, 1)
    assert lanes[lanes >= 0].tolist() == list(range(40))


def test_what_is_measured_is_in_the_order_of_the_runs():
    """On several devices the lanes are dealt; a run's files have its seeds in order."""
    lanes = pack_slots(np.ones(7, bool), np.zeros(7), 4, 2)
    assert lanes.tolist() == [[0, 2, 1, 3], [4, 6, 5, -1]]
    slots = [({"steps": np.stack([each, -each])}, {"return": each}) for each in lanes]
    runs, metrics, eval_metrics = _of_slots(lanes, slots)
    assert runs.tolist() == eval_metrics["return"].tolist() == list(range(7))
    assert metrics["steps"].tolist() == [[*range(7)], [*range(0, -7, -1)]]


def test_no_bit_of_a_state_changes_on_its_way():
    random = np.random.default_rng(0)
    states = {
        "key": random.integers(0, 2**32, (5, 2), np.uint32),
        "number": random.integers(-(2**31), 2**31, 5).astype(np.int32),
        "matrix": random.integers(0, 2**32, (5, 3, 2), np.uint32).view(np.float32),  # NaNs too
        "which": random.random((5, 3)) < 0.5,
        "nothing": np.zeros((5, 0), np.float32),
    }
    layout = StateRows(states)
    rows = layout.rows(states)
    assert rows.shape == (5, 8 + 4 + 24 + 3)
    moved = jax.jit(layout.traced_rows)(jax.jit(layout.traced_states)(rows))
    assert np.array_equal(moved, rows)
    some = layout.states(rows[[3, 1]])
    for name, old in states.items():
        assert some[name].dtype == old.dtype
        assert some[name].tobytes() == old[[3, 1]].tobytes()
    inside = jax.jit(lambda x: jax.tree.map(jnp.asarray, layout.traced_states(x)))(rows)
    assert np.array_equal(inside["number"], states["number"])
    assert np.array_equal(inside["which"], states["which"])
    assert np.array_equal(inside["matrix"].view(jnp.uint32), states["matrix"].view(np.uint32))


def test_keys_are_keys_again():
    keys = jax.random.split(jax.random.key(0), 3)
    layout = StateRows({"key": keys})
    rows = layout.rows({"key": keys})
    for read in (layout.states, layout.traced_states):
        assert np.array_equal(jax.random.bits(read(rows)["key"][1]), jax.random.bits(keys[1]))
    assert np.array_equal(layout.traced_rows({"key": keys}), rows)


def test_waiting_for_a_program_is_compiling():
    clock = Stopwatch()
    assert clock.wait(started(lambda: time.sleep(0.2) or "program").result) == "program"
    assert clock.compiling > 0
    assert clock.running() < 0.1
