"""A player that plays nothing: each item says which it is. For tests of the way to it."""

import jax
import jax.numpy as jnp
import numpy as np

from mjx_reinforce.engines.native.cpu import handler, machine, seam

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
  %simulated.at = getelementptr %Job, ptr %job, i32 0, i32 SIMULATED
  %active.at = getelementptr %Job, ptr %job, i32 0, i32 ACTIVE
  %active = load ptr, ptr %active.at
  %data.at = getelementptr %Job, ptr %job, i32 0, i32 DATA
  %data = load ptr, ptr %data.at
  %expected.at = getelementptr ptr, ptr %data, i64 4
  %expected.data = load ptr, ptr %expected.at
  %expected.32 = load i32, ptr %expected.data
  %expected = sext i32 %expected.32 to i64
  %reward.at = getelementptr ptr, ptr %data, i64 7
  %reward = load ptr, ptr %reward.at
  %length.at = getelementptr ptr, ptr %data, i64 8
  %length = load ptr, ptr %length.at
  %entered = atomicrmw add ptr %simulated.at, i64 1 monotonic
  br label %fetch
fetch:
  %k = atomicrmw add ptr %next.at, i64 1 monotonic
  %some = icmp ult i64 %k, %total
  br i1 %some, label %wait, label %done
wait:
  %tries = phi i64 [0, %fetch], [%tried, %yield]
  %threads = load atomic i64, ptr %simulated.at monotonic, align 8
  %all = icmp sge i64 %threads, %expected
  %patient = icmp ult i64 %tries, 20000
  %not.all = xor i1 %all, true
  %go.on = and i1 %not.all, %patient
  br i1 %go.on, label %yield, label %play
yield:
  %tried = add i64 %tries, 1
  %yielded = call i32 @sched_yield()
  br label %wait
play:
  %place = udiv i64 %k, %episodes
  %episode = urem i64 %k, %episodes
  %seed.at = getelementptr i64, ptr %active, i64 %place
  %seed = load i64, ptr %seed.at
  %row = mul i64 %seed, %episodes
  %item = add i64 %row, %episode
  %one.up = add i64 %item, 1
  %named = trunc i64 %one.up to i32
  %length.to = getelementptr i32, ptr %length, i64 %item
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
    """A module whose player says item + 1 as its length and, in its last step, as its reward.

    The lane steps are the threads that took part. An item waits until there are as many as argument
    4 says, or for some time.
    """
    work = _TEXT
    for field in ("next", "total", "episodes", "horizon", "simulated", "active", "data"):
        work = work.replace(f"i32 0, i32 {field.upper()}", f"i32 0, i32 {_FIELD[field]}")
    return handler.handler_text(5, [4] * 6, lanes) + work


def load(folder=None, lanes=1, level=None):
    return machine.load(
        text(lanes), lambda: text(lanes), handler.NAMES, machine.this_machine(level), folder
    )


def shapes(batch):
    made = ((T, N, 2), (T, N, 1), (T, N), (N,), (N,), ())
    return [
        jax.ShapeDtypeStruct((*batch, *shape), jnp.float32 if i < 3 else jnp.int32)
        for i, shape in enumerate(made)
    ]


def play(code, active, threads=0, expected=0):
    """Calls the code for seeds [*B]."""
    active = jnp.asarray(active, jnp.int32)
    same = lambda value: jnp.full_like(active, value)  # noqa: E731
    keys = jnp.zeros((*active.shape, N, 2), jnp.uint32)
    args = (active, same(threads), same(0), keys, same(expected))
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
    assert not simulated[active == 0].any()
    if threads is not None:
        assert simulated.sum() == threads
        assert np.ptp(simulated[active != 0]) <= 1
        assert (np.diff(simulated[active != 0].ravel()) <= 0).all()
