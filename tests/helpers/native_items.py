"""A kernel that plays nothing: each item says which it is. For tests of the way to it."""

import ctypes
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from mjx_reinforce.engine.cpu import handler, machine, seam

N, T = 3, 5
_FIELD = {name: number for number, name in enumerate(handler.JOB)}


def text(lanes=1):
    """A module whose kernel says item + 1 as its length and, in its last step, as its reward.

    The steps simulated for the first seed are the threads that took part. An item waits until there
    are as many as argument 3 says, or for some time.
    """
    work = Path(__file__).with_suffix(".ll").read_text("utf-8")
    for field in ("next", "total", "episodes", "horizon", "data"):
        work = work.replace(f"i32 0, i32 {field.upper()}", f"i32 0, i32 {_FIELD[field]}")
    return handler.handler_text(4, [4] * 6, lanes) + work


def load(folder=None, lanes=1, level=None):
    return machine.load_module(
        text(lanes), lambda: text(lanes), handler.SYMBOLS, machine.this_machine(level), folder
    )


def shapes(batch):
    made = ((T, N, 2), (T, N, 1), (T, N), (N,), (N,), ())
    return [
        jax.ShapeDtypeStruct((*batch, *shape), jnp.float32 if i < 3 else jnp.int32)
        for i, shape in enumerate(made)
    ]


def play(code, active, threads=0, expected=0):
    """Calls the code for seeds [*B], of which some are active."""
    active = jnp.asarray(active, jnp.int32)
    same = lambda value: jnp.full_like(active, value)  # noqa: E731
    limits = jnp.repeat(active[..., None], N, -1)
    args = (limits, same(threads), jnp.zeros((*limits.shape, 2), jnp.uint32), same(expected))
    return seam.call(code, shapes(active.shape), *args)


def check(results, active, threads=None):
    """Asserts that the results are those of the active seeds [*B], and zero elsewhere."""
    active = np.asarray(active)
    observation, action, reward, length, broken, simulated = map(np.asarray, results)
    items = (1 + np.arange(active.size * N)).reshape(*active.shape, N) * (active != 0)[..., None]
    np.testing.assert_array_equal(length, items)
    np.testing.assert_array_equal(reward[..., -1, :], items)
    assert not reward[..., :-1, :].any()
    assert not any(x.any() for x in (observation, action, broken))
    assert not simulated.ravel()[1:].any()
    if threads is not None:
        assert simulated.sum() == threads


def function(code, name, num_pointers, num_integers=0):
    """A function of machine code for Python to call; it returns a pointer."""
    kinds = [ctypes.c_void_p] * num_pointers + [ctypes.c_int64] * num_integers
    return ctypes.CFUNCTYPE(ctypes.c_void_p, *kinds)(code.addresses[name])


def by_hand(text, given, made, sizes, threads=3):
    """Fills arrays by the functions that a handler is made of, in threads that are not XLA's.

    The sizes are those of a job: seeds, episodes and steps.
    """
    names, target = ("open", "share", "close"), machine.this_machine()
    code = machine.load_module(text, lambda: text, names, target, None)
    data = [x.ctypes.data for x in [*given, *made]]
    bytes_ = (ctypes.c_int64 * len(made))(*(x.nbytes for x in made))
    job = function(code, "open", 2, 3)((ctypes.c_void_p * len(data))(*data), bytes_, *sizes)
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(function(code, "share", 1), [job] * threads))
    function(code, "close", 1)(job)
