"""The kernels that step environments on a GPU, run on this CPU."""

import gpu_on_cpu
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toys import Busy, Drifting

from mjx_reinforce import Box, make_vec
from mjx_reinforce.engine.gpu import lockstep, ptx
from mjx_reinforce.engine.play import available, choice, objects

if reason := available.unavailable():
    pytest.skip(reason, allow_module_level=True)

SPACE = Box(np.array([-3.0]), np.array([1.0]))
TOY = Drifting(SPACE)


def play(env, steps=25, num=5, engine="native"):
    vec = make_vec(env, num, max_episode_steps=9, autoreset="same_step", engine=engine)
    reset, step = jax.jit(vec.reset), jax.jit(vec.step)
    state, found = reset(jax.random.key(0)), []
    for t in range(steps):
        state = step(state, vec.sample_actions(jax.random.key(t)))
        found.append(jax.tree.map(np.asarray, state))
    return jax.tree.map(lambda *x: np.stack(x), *found)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("env", "threads"),
    [(TOY, 8), ("InvertedPendulum-v5", 3), ("CartPole-v1", 1)],
    ids=["toy", "pendulum", "cart"],
)
def test_the_same_steps_as_on_a_cpu(monkeypatch, env, threads):
    """Also where threads have several environments each, or none."""
    want = play(env)
    gpu_on_cpu.emulate(monkeypatch, threads)
    got = play(env)
    assert np.any(got.truncated)
    for x, y in zip(jax.tree.leaves(got), jax.tree.leaves(want), strict=True):
        np.testing.assert_allclose(x, y, rtol=2e-5, atol=2e-5)


def test_threads_of_a_block_meet(monkeypatch):
    """In loops and branches that all of them go through together, also those that have no more."""
    env = Busy(SPACE)
    want = play(env, steps=12)
    meetings = []
    for long in (10**9, 0):
        block = gpu_on_cpu.Block(3)
        gpu_on_cpu.emulate(monkeypatch, block=block)
        monkeypatch.setattr(lockstep, "LONG", long)
        got = play(env, steps=12)
        assert block.apart is None
        meetings.append(block.meetings)
        np.testing.assert_allclose(got.obs, want.obs, rtol=2e-5, atol=2e-5)
    assert 12 < meetings[0] < meetings[1]


def test_mapped_over_it_remains_one_launch(monkeypatch):
    gpu_on_cpu.emulate(monkeypatch, 2)
    vec = make_vec(TOY, 4, engine="native")
    keys = jax.random.split(jax.random.key(3), 2)
    both = jax.jit(jax.vmap(vec.reset))(keys)
    after = jax.jit(jax.vmap(vec.step))(both, jnp.ones((2, 4, 1)))
    one = jax.jit(vec.step)(jax.tree.map(lambda x: x[1], both), jnp.ones((4, 1)))
    np.testing.assert_array_equal(after.obs[1], one.obs)
    text = str(jax.make_jaxpr(jax.vmap(vec.step))(both, jnp.ones((2, 4, 1))))
    assert text.count("pure_callback[") == 1


def test_machine_code_for_a_gpu_is_chosen_where_a_step_is_large(monkeypatch):
    gpu_on_cpu.emulate(monkeypatch)
    engine = make_vec(TOY, 4).engine
    assert engine.name == "fused"
    assert "XLA's kernels are the fastest" in engine.why
    monkeypatch.setattr(choice, "_SMALL", 10)
    assert make_vec(TOY, 4).engine.name == "native"


@pytest.mark.slow
def test_llvm_makes_ptx_of_it(monkeypatch):
    """For the real target, where this LLVM has it."""
    kept = {}
    monkeypatch.setattr(objects, "folder", lambda: None)
    monkeypatch.setattr(available, "platform", lambda: "gpu")
    monkeypatch.setattr(available.gpu, "kernels_unavailable", lambda: None)
    monkeypatch.setattr(available.gpu, "compute_capability", lambda: "9.0")
    compile_ptx = ptx._compile
    monkeypatch.setattr(ptx, "_compile", lambda *x: kept.setdefault("text", compile_ptx(*x)))
    make_vec("InvertedPendulum-v5", 4, engine="native")
    assert ".visible .entry play(" in kept["text"]
    assert ".maxntid" in kept["text"]
