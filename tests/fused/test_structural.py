"""Rules that move elements about: what JAX computes, without an operation."""

import jax.numpy as jnp
import numpy as np
from jax import lax
from mapped import assert_all_same, batch_of, count

MOVES = {
    "slice": lambda x: lax.slice(x, (0, 1), (3, 4), (2, 1)),
    "slice without strides": lambda x: lax.slice(x, (1, 1), (3, 3)),
    "reshape": lambda x: x.reshape(2, 6),
    "squeeze": lambda x: lax.squeeze(x[:1], (0,)),
    "expand_dims": lambda x: lax.expand_dims(x, (0, 2)),
    "broadcast_in_dim": lambda x: lax.broadcast_in_dim(x, (3, 2, 4), (0, 2)),
    "transpose": lambda x: lax.transpose(x, (1, 0)),
    "rev": lambda x: lax.rev(x, (1,)),
    "tile": lambda x: jnp.tile(x, (2, 3)),
    "concatenate": lambda x: lax.concatenate([x, jnp.ones((1, 4)), x[:1]], 0),
    "stack": lambda x: jnp.stack([x, np.ones((3, 4), np.float32)], axis=1),
    "unstack": list,
    "split": lambda x: lax.split(x, (1, 3), axis=1),
    "pad": lambda x: lax.pad(x, jnp.float32(9), ((1, 0, 2), (0, 2, 0))),
    "pad less": lambda x: lax.pad(x, jnp.float32(9), ((-1, 1, 1), (2, -3, 0))),
    "iota": lambda x: lax.broadcasted_iota(jnp.int32, (2, 3), 1),
    "copy": lambda x: lax.optimization_barrier(jnp.copy(lax.stop_gradient(x))),
    "results of any kind": lambda x: {"a": x, "b": (x[0], None, jnp.ones(2))},
}


def test_elements_are_moved_and_nothing_is_computed():
    assert_all_same(MOVES, batch_of(3, 4), rtol=0, atol=0)
    assert [name for name, fn in MOVES.items() if count(fn, jnp.ones((3, 4)))] == []
