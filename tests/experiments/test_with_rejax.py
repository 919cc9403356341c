"""The example with rejax: one environment, mapped, is one call."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_reinforce import make_vec
from mjx_reinforce.engine.vector.for_brax import BraxVectorEnv


@pytest.mark.filterwarnings("ignore")
def test_rejax_maps_one_environment_in_one_call():
    pytest.importorskip("rejax")
    from experiments.examples.with_rejax import OneOfMany

    task = "InvertedPendulum-v5"
    one, many = OneOfMany(task), BraxVectorEnv(make_vec(task, 3, autoreset="same_step"))
    keys = jax.random.split(jax.random.PRNGKey(0), 3)
    first = jax.vmap(lambda key: jax.random.fold_in(key, 0))(keys)
    (obs, state), other = jax.vmap(one.reset)(keys), many.reset(first)
    np.testing.assert_array_equal(obs, other.obs)
    mapped = jax.jit(jax.vmap(one.step))
    assert str(jax.make_jaxpr(mapped)(keys, state, jnp.zeros((3, 1)))).count("ffi_call[") == 1
    ended = 0
    for _ in range(20):
        action = jnp.array([[1.0], [-1.0], [0.1]])
        obs, state, reward, done, _ = mapped(keys, state, action)
        other = many.step(other, action)
        for found, expected in ((obs, other.obs), (reward, other.reward), (done, other.done)):
            np.testing.assert_array_equal(found, expected)
        ended += int(done.sum())
    assert ended > 1
