"""JAX's random numbers from any count on: Threefry's known answers, and JAX's own numbers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_reinforce.engine.play import counter

KEY = jax.random.key(7)
WORDS = jax.random.key_data(KEY)


def test_the_known_answer():
    """Of the authors' test vectors, that of zeros."""
    zeros = jnp.zeros(2, jnp.uint32)
    assert [hex(x) for x in counter.hash_pair(zeros, zeros[0])] == ["0x6b200159", "0x99ba4efe"]


def test_keys_split_as_jax_splits_them():
    np.testing.assert_array_equal(counter.split(WORDS), jax.random.key_data(jax.random.split(KEY)))


def test_numbers_from_a_count_on_are_those_of_a_longer_draw():
    whole = jax.random.normal(KEY, (12,))
    for first in (0, 3, 10):
        from_there = counter.at_counter(WORDS, jnp.uint32(first))
        np.testing.assert_array_equal(jax.random.normal(from_there, (2,)), whole[first : first + 2])


def test_bits_of_any_width_and_shape_and_doubles():
    for dtype in (np.uint8, np.uint16, np.uint32):
        ours = jax.random.bits(counter.key_of(WORDS), (2, 3), dtype)
        np.testing.assert_array_equal(ours, jax.random.bits(KEY, (2, 3), dtype))
        assert ours.dtype == dtype
    with jax.enable_x64(True):
        ours = jax.random.normal(counter.key_of(WORDS), (4,), np.float64)
        np.testing.assert_array_equal(ours, jax.random.normal(KEY, (4,), np.float64))


def test_keys_made_of_keys():
    ours, theirs = counter.key_of(WORDS), KEY
    for _ in range(2):
        ours, theirs = jax.random.split(ours, 3)[2], jax.random.split(theirs, 3)[2]
        ours, theirs = jax.random.fold_in(ours, 5), jax.random.fold_in(theirs, 5)
    np.testing.assert_array_equal(jax.random.key_data(ours), jax.random.key_data(theirs))


def test_a_key_that_skips_numbers_is_not_split():
    with pytest.raises(NotImplementedError, match="more than one key"):
        jax.random.split(counter.at_counter(WORDS, jnp.uint32(1)))
