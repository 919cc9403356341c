"""Rules for windows of an array: gather, scatter, dynamic slices; at known and unknown places."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from mapped import assert_folds, assert_same, batch_of, count

X = np.arange(12, dtype=np.float32).reshape(3, 4)
PLACES = np.array([2, -1, 7, 0], np.int32)  # of which two are outside an axis of three


@pytest.mark.parametrize("mode", ["clip", "fill"])
def test_a_row_outside_is_the_nearest_or_the_fill_value(mode):
    assert_folds(lambda x: x.at[PLACES].get(mode=mode), X)
    assert_folds(lambda x: x.at[PLACES, 1].get(mode=mode, fill_value=7.0), X)
    assert_folds(lambda x: x.at[:, PLACES].get(mode=mode), X.astype(np.int32))


@pytest.mark.parametrize("dtype", [np.int32, np.uint8, bool, np.float32])
def test_the_fill_value_of_a_dtype(dtype):
    assert_folds(lambda x: x.at[np.array([5])].get(mode="fill"), np.ones(3, dtype))


@pytest.mark.parametrize("change", ["set", "add", "subtract", "multiply", "min", "max"])
@pytest.mark.parametrize("mode", ["clip", "drop"])
def test_an_entry_is_changed_where_it_is_inside(change, mode):
    places = np.array([1, 4, 2], np.int32)
    assert_folds(lambda x: getattr(x.at[places], change)(2.5, mode=mode), jnp.asarray(X))


def test_an_entry_that_is_named_twice_is_changed_twice():
    assert_folds(lambda x: x.at[np.array([1, 1])].add(1.0), jnp.asarray(X))


@pytest.mark.parametrize("start", [(0, 0), (1, 2), (9, -9)])
def test_a_window_is_moved_inside(start):
    assert_folds(lambda x: lax.dynamic_slice(x, start, (2, 3)), X)
    assert_folds(lambda x: lax.dynamic_update_slice(x, -X[:2, :3], start), X)


@pytest.mark.parametrize("mode", ["clip", "fill"])
def test_a_place_that_a_lane_knows_alone_is_selected(mode):
    places = jnp.arange(6, dtype=jnp.int32) - 1  # -1 to 4, of an axis of three

    def read(x, i):
        return x.at[i].get(mode=mode), lax.dynamic_slice(x, (i,), (2,))

    assert_same(read, batch_of(3), places)


@pytest.mark.parametrize("change", ["set", "add", "max"])
@pytest.mark.parametrize("mode", ["clip", "drop"])
def test_a_place_that_a_lane_knows_alone_is_changed(change, mode):
    places = jnp.arange(6, dtype=jnp.int32) + jnp.int32(-1)

    def write(x, i):
        return getattr(x.at[i], change)(0.5, mode=mode)

    assert_same(write, batch_of(3), jnp.maximum(places, 0))


def test_known_places_cost_nothing():
    assert count(lambda x: x[np.array([2, 0, 1])], jnp.ones(3)) == 0
    assert count(lambda x, i: x[i], jnp.ones(3), jnp.int32(0)) > 0


def test_rows_of_a_batch_are_read_each_by_its_own():
    rows, columns = np.arange(3), np.array([3, 0, 2])
    assert_folds(lambda x: jnp.take_along_axis(x, columns[:, None], axis=1), X)
    assert_folds(jax.vmap(lambda x, i: x[i]), X, columns)
    assert_folds(lambda x: x[rows, columns], X)
