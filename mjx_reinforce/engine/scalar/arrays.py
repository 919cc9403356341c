"""Arrays of scalars: numeric where every element is a constant, of dtype object otherwise."""

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from mjx_reinforce.engine.scalar.nodes import is_constant

#: Numbers and nodes, see the module.
Array = np.ndarray
#: What a rule returns: the arrays of an equation's results.
Results = list[Array]


def is_numeric(array: Array) -> bool:
    """Returns whether every element is a constant."""
    return array.dtype != object


def elements(array: Array) -> list[Any]:
    """Returns the scalars in row-major order."""
    return list(array.flat)


def pack(scalars: Iterable[Any], shape: Sequence[int], dtype: DTypeLike) -> Array:
    """Returns the array of these scalars."""
    scalars = list(scalars)
    if dtype is not object and all(map(is_constant, scalars)):
        return np.array(scalars, dtype).reshape(shape)
    return np.fromiter(scalars, object, len(scalars)).reshape(shape)


def lift(array: Array) -> Array:
    """Returns the array with dtype object."""
    if not is_numeric(array):
        return array
    # Assigning to an object array would turn NumPy scalars into Python ones and lose the dtype.
    return np.fromiter(array.flat, object, array.size).reshape(array.shape)


def settle(array: Array, dtype: DTypeLike) -> Array:
    """Returns the array as a numeric one if every element is a constant."""
    if is_numeric(array):
        return array
    return pack(array.flat, array.shape, dtype)


def together(arrays: Sequence[Array]) -> list[Array]:
    """Returns arrays of which either all are numeric or all have dtype object."""
    if all(map(is_numeric, arrays)):
        return list(arrays)
    return [lift(array) for array in arrays]


def zeros(aval: Any) -> Array:
    """Returns zeros of an abstract value's shape and dtype."""
    return np.zeros(aval.shape, aval.dtype)


def map_elements(function: Callable, shape: Sequence[int], dtype: DTypeLike, *arrays: Any) -> Array:
    """Applies a scalar function element by element; axes of size 1 are shared."""
    columns = [elements(np.broadcast_to(array, shape)) for array in arrays]
    return pack(map(function, *columns), shape, dtype)


class Layout:
    """How arrays divide into scalars and back."""

    def __init__(self, avals: Sequence[Any]):
        self._avals = list(avals)
        self._sizes = [math.prod(aval.shape) for aval in self._avals]

    def pack(self, scalars: Sequence[Any]) -> list[Array]:
        """Makes the arrays of these scalars."""
        values = iter(scalars)
        packed_arrays = []
        for aval, size in zip(self._avals, self._sizes, strict=True):
            packed_arrays.append(pack([next(values) for _ in range(size)], aval.shape, aval.dtype))
        return packed_arrays

    def repeat(self, facts: Sequence[Any]) -> list[Any]:
        """Lists what is known of each array once for each of its scalars."""
        layout_facts = zip(facts, self._sizes, strict=True)
        return [fact for fact, size in layout_facts for _ in range(size)]

    def unpack(self, packed: Sequence[Array]) -> list[Any]:
        """Lists the scalars of these arrays."""
        return [scalar for array in packed for scalar in elements(array)]
