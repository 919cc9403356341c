"""Rules that move elements about: on constants what JAX computes, and on lanes no operation."""

import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from mapped import assert_folds, count

X = np.arange(12, dtype=np.float32).reshape(3, 4)
MOVES = {
    "slice": lambda x: lax.slice(x, (0, 1), (3, 4), (2, 1)),
    "slice_without_strides": lambda x: lax.slice(x, (1, 1), (3, 3)),
    "reshape": lambda x: x.reshape(2, 6),
    "squeeze": lambda x: lax.squeeze(x[:1], (0,)),
    "expand_dims": lambda x: lax.expand_dims(x, (0, 2)),
    "broadcast_in_dim": lambda x: lax.broadcast_in_dim(x, (3, 2, 4), (0, 2)),
    "transpose": lambda x: lax.transpose(x, (1, 0)),
    "rev": lambda x: lax.rev(x, (1,)),
    "tile": lambda x: jnp.tile(x, (2, 3)),
    "concatenate": lambda x: lax.concatenate([x, x[:1]], 0),
    "stack": lambda x: jnp.stack([x, 2 * X], axis=1),
    "split": lambda x: lax.split(x, (1, 3), axis=1),
    "pad": lambda x: lax.pad(x, jnp.float32(9), ((1, 0, 2), (0, 2, 0))),
    "pad_less": lambda x: lax.pad(x, jnp.float32(9), ((-1, 1, 1), (2, -3, 0))),
    "iota": lambda x: lax.broadcasted_iota(jnp.int32, (2, 3), 1),
    "copy": lambda x: lax.optimization_barrier(jnp.copy(lax.stop_gradient(x))),
}


@pytest.mark.parametrize("name", MOVES)
def test_elements_are_moved(name):
    assert_folds(MOVES[name], X)


@pytest.mark.parametrize("name", set(MOVES) - {"stack"})  # which multiplies
def test_nothing_is_computed(name):
    assert count(MOVES[name], jnp.asarray(X)) == 0


def test_the_default_of_a_choice_by_platform_is_taken():
    def choose(x):
        return lax.platform_dependent(x, tpu=lambda x: x, default=lambda x: x[::-1])

    assert_folds(choose, X)
