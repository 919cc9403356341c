"""A kernel that plays nothing: each item says which it is. For tests of the way to it."""

import ctypes
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np

from mjx_reinforce.engine.cpu import handler, machine, seam

N, T = 3, 5
_FIELD = {name: number for number, name in enumerate(handler.FIELDS)}
_TEXT = """
define void @work(ptr %job) {
entry:
  %next.at = getelementptr %Job, ptr %job, i32 0, i32 NEXT
  %total.at = getelementptr %Job, ptr %job, i32 0, i32 TOTAL
  %total = load i64, ptr %total.at
  %episodes.at = getelementptr %Job, ptr %job, i32 0, i32 EPISODES
  %episodes = load i64, ptr %episodes.at
  %horizon.at = getelementptr %Job, ptr %job, i32 0, i32 HORIZON
  %horizon = load i64, ptr %horizon.at
  %data.at = getelementptr %Job, ptr %job, i32 0, i32 DATA
  %data = load ptr, ptr %data.at
  %limits = load ptr, ptr %data
  %expected.at = getelementptr ptr, ptr %data, i64 3
  %expected.data = load ptr, ptr %expected.at
  %expected = load i32, ptr %expected.data
  %reward.at = getelementptr ptr, ptr %data, i64 6
  %reward = load ptr, ptr %reward.at
  %length.at = getelementptr ptr, ptr %data, i64 7
  %length = load ptr, ptr %length.at
  %simulated.at = getelementptr ptr, ptr %data, i64 9
  %simulated = load ptr, ptr %simulated.at
  %entered = atomicrmw add ptr %simulated, i32 1 monotonic
  br label %fetch
fetch:
  %k = atomicrmw add ptr %next.at, i64 1 monotonic
  %some = icmp ult i64 %k, %total
  br i1 %some, label %look, label %done
look:
  %limit.at = getelementptr i32, ptr %limits, i64 %k
  %flag = load i32, ptr %limit.at
  %skipped = icmp eq i32 %flag, 0
  br i1 %skipped, label %fetch, label %wait
wait:
  %tries = phi i64 [0, %look], [%tried, %yield]
  %threads = load atomic i32, ptr %simulated monotonic, align 4
  %all = icmp sge i32 %threads, %expected
  %patient = icmp ult i64 %tries, 20000
  %not.all = xor i1 %all, true
  %go.on = and i1 %not.all, %patient
  br i1 %go.on, label %yield, label %play
yield:
  %tried = add i64 %tries, 1
  %yielded = call i32 @sched_yield()
  br label %wait
play:
  %seed = udiv i64 %k, %episodes
  %episode = urem i64 %k, %episodes
  %one.up = add i64 %k, 1
  %named = trunc i64 %one.up to i32
  %length.to = getelementptr i32, ptr %length, i64 %k
  store i32 %named, ptr %length.to
  %value = sitofp i64 %one.up to float
  %rows.before = mul i64 %seed, %horizon
  %rows.to = add i64 %rows.before, %horizon
  %last.row = sub i64 %rows.to, 1
  %steps = mul i64 %last.row, %episodes
  %step = add i64 %steps, %episode
  %reward.to = getelementptr float, ptr %reward, i64 %step
  store float %value, ptr %reward.to
  br label %fetch
done:
  ret void
}
"""


def text(lanes=1):
    """A module whose kernel says item + 1 as its length and, in its last step, as its reward.

    The steps simulated for the first seed are the threads that took part. An item waits until there
    are as many as argument 3 says, or for some time.
    """
    work = _TEXT
    for field in ("next", "total", "episodes", "horizon", "data"):
        work = work.replace(f"i32 0, i32 {field.upper()}", f"i32 0, i32 {_FIELD[field]}")
    return handler.handler_text(4, [4] * 6, lanes) + work


def load(folder=None, lanes=1, level=None):
    return machine.load_module(
        text(lanes), lambda: text(lanes), handler.NAMES, machine.this_machine(level), folder
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
