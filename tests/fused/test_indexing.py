"""Rules for windows of an array: gather, scatter, dynamic slices; at known and unknown places."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from mapped import assert_all_same, batch_of, count

PLACES = np.array([2, -1, 7, 0], np.int32)  # of which two are outside an axis of three
TWICE = np.array([0, 0, 2])


def taken(x, i, mode):
    return x.at[i].get(mode=mode), x.at[:, i].get(mode=mode), x.at[i, 1].get(mode=mode)


#: Functions of x [3, 4] and of a place that a lane knows alone.
CASES = {
    f"take, {mode}": lambda x, i, mode=mode: (taken(x, PLACES, mode), taken(x, i, mode))
    for mode in ("clip", "fill")
}
CASES |= {
    f"{change}, {mode}": lambda x, i, change=change, mode=mode: (
        getattr(x.at[PLACES[:3]], change)(2.5, mode=mode),
        getattr(x.at[i], change)(0.5, mode=mode),
    )
    for change, mode in itertools.product(
        ("set", "add", "subtract", "multiply", "min", "max"), ("clip", "drop")
    )
}
CASES |= {
    f"a window at {start}": lambda x, i, start=start: (
        lax.dynamic_slice(x, start, (2, 3)),
        lax.dynamic_update_slice(x, -x[:2, :3], start),
    )
    for start in ((0, 0), (1, 2), (9, -9))
}
CASES |= {
    "the fill value of a dtype": lambda x, i: [
        x.astype(kind).at[np.array([5])].get(mode="fill")
        for kind in (np.int32, np.uint8, bool, np.float32)
    ],
    "a fill value": lambda x, i: x.at[PLACES].get(mode="fill", fill_value=7.0),
    "a window at a place": lambda x, i: lax.dynamic_slice(x, (i, i), (2, 2)),
    "a window is written": lambda x, i: lax.dynamic_update_slice(x, x[:1, :2], (i, i)),
    "two places": lambda x, i: (x[i, i + 1], x[i, :2], x.at[1:3, i].max(0.2)),
    "columns": lambda x, i: x.at[:, i].add(x[:, 0]),
    "an entry that is named twice": lambda x, i: (x.at[TWICE].add(1.0), x.at[TWICE, 1].mul(3.0)),
    "no place": lambda x, i: (x.at[TWICE[:0]].set(1.0), x.at[TWICE[:0], 1].add(1.0)),
    "each row its own": lambda x, i: (
        jnp.take_along_axis(x, TWICE[:, None], axis=1),
        jax.vmap(lambda row, k: row[k])(x, TWICE),
        x[np.arange(3), TWICE],
    ),
}


def test_windows_are_read_and_changed():
    assert_all_same(CASES, batch_of(3, 4), jnp.int32([-5, -1, 0, 1, 2, 7]))


def test_known_places_cost_nothing():
    assert count(lambda x: x[np.array([2, 0, 1])], jnp.ones(3)) == 0
    assert count(lambda x, i: x[i], jnp.ones(3), jnp.int32(0)) > 0
