"""JAX's random numbers, one step of a chunk at a time.

JAX draws the noise of a chunk of steps at once. Its generator hashes a key and a counter (Threefry
2x32, Salmon et al. 2011), so the numbers of one step can be had alone: they start at another count.
Written for ``jax_threefry_partitionable``, JAX's default.
"""

import functools
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax.extend import random
from jax.typing import ArrayLike

_ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))
_PARITY = 0x1BD11BDA


def hash_pair(key: jax.Array, count: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Returns Threefry 2x32 with 20 rounds of the counters (0, count), two words of each.

    Args:
      key: [2] uint32.
      count: [...] uint32.
    """
    keys = (key[0], key[1], key[0] ^ key[1] ^ jnp.uint32(_PARITY))
    # The high word of the counter is 0, so nothing is added to the first word of the key.
    x = jnp.broadcast_to(keys[0], count.shape)
    y = count + keys[1]
    for group in range(5):
        for rotation in _ROTATIONS[group % 2]:
            x = x + y
            y = x ^ ((y << jnp.uint32(rotation)) | (y >> jnp.uint32(32 - rotation)))
        # After four rounds a part of the key is injected, and the number of the injection.
        x = x + keys[(group + 1) % 3]
        y = y + keys[(group + 2) % 3] + jnp.uint32(group + 1)
    return x, y


def split(key: jax.Array) -> jax.Array:
    """Returns the data [2, 2] of the two keys that ``jax.random.split`` makes of a key [2]."""
    return _split(key, (2,))


def at_counter(key: jax.Array, count: jax.Array) -> jax.Array:
    """Returns a key whose numbers are those that another key gives from a count on.

    Args:
      key: [2] uint32, the data of the other key.
      count: [] uint32, how many numbers are skipped.
    """
    impl = _generator(3, "threefry2x32 from a count", "count", _refuse, _refuse)
    return jax.random.wrap_key_data(jnp.append(key, count), impl=impl)


def key_of_words(words: jax.Array) -> jax.Array:
    """Returns a key that draws what JAX's draws, and can be split, within what is written out.

    Args:
      words: [2] uint32, the data of JAX's key.
    """
    impl = _generator(2, "threefry2x32 written out", "written", _split, _fold_in)
    return jax.random.wrap_key_data(words, impl=impl)


def _bits(data: jax.Array, width: int, shape: tuple[int, ...]) -> jax.Array:
    """Draws random bits, as JAX's generator does for arrays of any shape.

    Args:
      data: [2 or 3] uint32, a key and, if there is a third, how many numbers are skipped.
      width: bits of a number.
      shape: of the result.
    """
    count = jnp.arange(math.prod(shape), dtype=jnp.uint32)
    if data.size == 3:
        count = count + data[2]
    x, y = hash_pair(data[:2], count)
    # JAX takes both words for a number of 64 bits, and of a shorter one the low bits of their xor.
    if width == 64:
        bits = (x.astype(jnp.uint64) << jnp.uint64(32)) | y.astype(jnp.uint64)
    else:
        bits = (x ^ y).astype(f"uint{width}")
    return bits.reshape(shape)


def _split(key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """Returns the data [*shape, 2] of the keys that JAX's generator makes of a key [2]."""
    count = jnp.arange(math.prod(shape), dtype=jnp.uint32)
    return jnp.stack(hash_pair(key, count), axis=-1).reshape(*shape, 2)


def _fold_in(key: jax.Array, data: ArrayLike) -> jax.Array:
    """Returns the data [2] of a key [2] with a number [] folded in."""
    return jnp.stack(hash_pair(key, jnp.asarray(data, jnp.uint32)))


def _refuse(*_: object) -> jax.Array:
    raise NotImplementedError("noise that is drawn with more than one key")


@functools.cache
def _generator(words: int, name: str, tag: str, split: Callable, fold_in: Callable) -> object:
    """Returns JAX's generator of keys of so many words, in operations that can be written out."""
    return random.define_prng_impl(
        key_shape=(words,),
        seed=_refuse,
        split=split,
        random_bits=_bits,
        fold_in=fold_in,
        name=name,
        tag=tag,
    )
