"""Random keys as the plain numbers that files and the host hold."""

from typing import Any

import jax

from mjx_reinforce.types import PyTree


def is_key(leaf: Any) -> bool:
    """Returns whether a leaf, or its shape, is of random keys."""
    return jax.numpy.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def plain(tree: PyTree) -> Any:
    """Returns a pytree with the data of its keys in their place."""
    return jax.tree.map(lambda x: jax.random.key_data(x) if is_key(x) else x, tree)


def with_keys(tree: PyTree, like: PyTree) -> Any:
    """Returns a pytree from ``plain`` with keys where ``like`` has them."""
    return jax.tree.map(
        lambda x, old: jax.random.wrap_key_data(x) if is_key(old) else x, tree, like
    )
