"""A network as loops over its units computes what the network computes."""

import jax
import jax.numpy as jnp
import numpy as np

from mjx_reinforce.engine.play import units
from mjx_reinforce.learning.policy import MLP


def both(sizes, x, outputs=2):
    """The results of a network as it is, and unit by unit."""
    network = MLP(sizes, outputs)
    params = network.init(jax.random.key(0), x)
    params = jax.tree.map(lambda p: p + 0.1, params)  # biases, too
    plain = network.apply(params, x)
    with units.one_at_a_time():
        return plain, network.apply(params, x), jax.make_jaxpr(network.apply)(params, x)


def test_what_a_network_computes():
    """Also where two pairs of layers have the same shapes."""
    for sizes in ((), (8,), (8, 6), (5, 8, 12), (3,) * 4):
        plain, looped, jaxpr = both(sizes, jnp.arange(3.0))
        np.testing.assert_allclose(looped, plain, rtol=1e-5, atol=1e-6)
        assert str(jaxpr).count("scan[") == (len(sizes) + 1) // 2


def test_a_batch_is_left_as_it_is():
    plain, same, jaxpr = both((8,), jnp.ones((4, 3)))
    np.testing.assert_array_equal(same, plain)
    assert "scan" not in str(jaxpr)


def test_units_of_one_iteration_are_as_many_as_divide_the_layer():
    _, _, jaxpr = both((8,), jnp.ones(3))
    assert "length=2" in str(jaxpr)
    _, _, jaxpr = both((7,), jnp.ones(3))
    assert "length=7" in str(jaxpr)
