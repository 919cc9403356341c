"""Which runs are moved side by side, and their states as rows of bytes.

A compiled program moves a fixed number of runs at once, a slot, and takes about as long as the
longest episode in it, whether the others still train or not. So before a block of updates the
runs that still train are sorted by the length of their episodes and packed into slots again. Runs
whose budget is used lie aside. The packing follows from what a checkpoint holds, so that a resumed
run packs as it would have.

What goes between the host and its devices is one array: a state has dozens of leaves, and each
costs as much to choose, to send and to fetch as all of them in one array.
"""

from collections.abc import Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from mjx_reinforce.engine.base import PyTree, plain, with_keys


class StateRows:
    """Writes the states of runs as rows [R, B] of bytes, and reads them; no bit changes."""

    def __init__(self, like: PyTree):
        """Takes the states of any number of runs, or their shapes."""
        self._like = like
        leaves, self._structure = jax.tree.flatten(jax.eval_shape(plain, like))
        self._shapes = [leaf.shape[1:] for leaf in leaves]
        self._types = [np.dtype(leaf.dtype) for leaf in leaves]
        sizes = [
            int(np.prod(shape)) * kind.itemsize
            for shape, kind in zip(self._shapes, self._types, strict=True)
        ]
        *self._ends, self.size = np.cumsum(sizes).tolist()

    def shapes(self, num_runs: int) -> Any:
        """Returns the shapes of so many runs, as ``rows`` takes them."""
        shapes = zip(self._shapes, self._types, strict=True)
        leaves = [jax.ShapeDtypeStruct((num_runs, *shape), kind) for shape, kind in shapes]
        return jax.tree.unflatten(self._structure, leaves)

    def rows(self, states: PyTree) -> np.ndarray:
        """Returns the rows of states on the host, which have the data of keys as leaves."""
        leaves = [np.ascontiguousarray(leaf) for leaf in jax.tree.leaves(states)]
        return np.concatenate([_flat(leaf).view(np.uint8) for leaf in leaves], axis=1)

    def states(self, rows: np.ndarray) -> Any:
        """Returns the states of rows on the host, as ``rows`` takes them."""
        parts = map(np.ascontiguousarray, np.split(rows, self._ends, axis=1))
        return self._shaped(part.view(kind) for part, kind in zip(parts, self._types, strict=True))

    def traced_rows(self, states: PyTree) -> jax.Array:
        """Returns the rows of states, in a program."""

        def as_bytes(leaf: jax.Array) -> jax.Array:
            if leaf.dtype.itemsize == 1:
                return _flat(leaf.astype(jnp.uint8))
            return _flat(lax.bitcast_convert_type(leaf, jnp.uint8))

        return jnp.concatenate([as_bytes(leaf) for leaf in jax.tree.leaves(plain(states))], axis=1)

    def traced_states(self, rows: jax.Array) -> Any:
        """Returns the states of rows, in a program."""

        def read(part: jax.Array, kind: np.dtype) -> jax.Array:
            if kind.itemsize == 1:
                return part.astype(kind)
            numbers = part.reshape(len(part), part.shape[1] // kind.itemsize, kind.itemsize)
            return lax.bitcast_convert_type(numbers, kind)

        parts = jnp.split(rows, self._ends, axis=1)
        leaves = (read(*each) for each in zip(parts, self._types, strict=True))
        return with_keys(self._shaped(leaves), self._like)

    def _shaped(self, leaves: Iterable[np.ndarray] | Iterable[jax.Array]) -> Any:
        """Returns states of leaves [R, numbers], with the data of keys as leaves."""
        shaped = [
            leaf.reshape(len(leaf), *shape)
            for leaf, shape in zip(leaves, self._shapes, strict=True)
        ]
        return jax.tree.unflatten(self._structure, shaped)


def _flat(leaf: PyTree) -> Any:
    """Returns a leaf as [R, numbers]."""
    return leaf.reshape(len(leaf), int(np.prod(leaf.shape[1:])))


def pack_slots(
    chosen: np.ndarray, lengths: np.ndarray, widths: Sequence[int], num_devices: int
) -> np.ndarray:
    """Returns the runs of each slot.

    Args:
      chosen: [R] which runs are packed, at least one.
      lengths: [R] about how long their episodes are; runs of equal lengths share a slot.
      widths: that slots may have, multiples of the number of devices, the most first. The first of
        which these runs fill more than a quarter of a slot is taken, or else the last: on an H200
        the wider slot takes as long as two of an eighth of its width.
      num_devices: among which a slot is divided; each gets as many runs as the others, or one less.

    Returns:
      [slots, width], the number of the run in each lane, -1 where there is none.
    """
    runs = np.flatnonzero(chosen)
    runs = runs[np.argsort(lengths[runs], kind="stable")]
    width = next((width for width in widths if len(runs) > width // 4), widths[-1])
    lanes = np.full((-(-len(runs) // width), width), -1)
    lanes.flat[: len(runs)] = runs
    dealt = lanes.reshape(len(lanes), width // num_devices, num_devices)
    return dealt.swapaxes(1, 2).reshape(lanes.shape)
