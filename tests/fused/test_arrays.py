"""Arrays of scalars: numeric where every element is a constant, of dtype object otherwise."""

import jax
import numpy as np
import pytest

from mjx_reinforce.fused import arrays
from mjx_reinforce.fused.graph import Graph, Limits


@pytest.fixture
def node():
    return Graph(400, Limits()).leaf(np.dtype(np.float32), True, position=(0, 0))


def test_constants_are_packed_into_numbers_and_nodes_are_not(node):
    numbers = arrays.pack([np.float32(1), np.float32(2)], (2, 1), np.float32)
    assert arrays.is_numeric(numbers)
    assert (numbers.shape, numbers.dtype) == ((2, 1), np.float32)
    mixed = arrays.pack([np.float32(1), node], (2,), np.float32)
    assert not arrays.is_numeric(mixed)
    assert mixed[1] is node


def test_what_is_lifted_keeps_the_dtypes_of_its_elements():
    lifted = arrays.lift(np.arange(3, dtype=np.int8))
    assert lifted.dtype == object
    assert [type(x) for x in lifted] == [np.int8] * 3


def test_what_has_only_constants_settles(node):
    lifted = arrays.lift(np.arange(4, dtype=np.int16).reshape(2, 2))
    settled = arrays.settle(lifted, np.int16)
    assert settled.dtype == np.int16
    assert settled.tolist() == [[0, 1], [2, 3]]
    lifted[0, 0] = node
    assert arrays.settle(lifted, np.int16).dtype == object


def test_arrays_are_of_one_kind_together(node):
    numbers, nodes = np.zeros(2), arrays.pack([node], (1,), np.float32)
    assert arrays.together([numbers, numbers])[0] is numbers
    assert [x.dtype for x in arrays.together([numbers, nodes])] == [object, object]


def test_elements_are_taken_by_their_places_in_row_major_order():
    taken = arrays.take(np.arange(6).reshape(2, 3) * 10, np.array([[5, 0], [1, 4]]))
    assert taken.tolist() == [[50, 0], [10, 40]]


def test_a_function_is_applied_to_pairs_and_what_has_one_entry_is_shared():
    sums = arrays.map_elements(
        lambda x, y: x + y, (2, 3), np.float32, np.ones((2, 1), np.float32), np.arange(3.0)
    )
    assert sums.tolist() == [[1, 2, 3], [1, 2, 3]]


def test_a_layout_takes_arrays_apart_and_puts_them_together():
    shapes = [jax.ShapeDtypeStruct((2, 2), np.float32), jax.ShapeDtypeStruct((), np.int32)]
    layout = arrays.Layout(shapes)
    scalars = [*np.arange(4, dtype=np.float32), np.int32(7)]
    matrix, number = layout.pack(scalars)
    assert (matrix.tolist(), number.tolist()) == ([[0, 1], [2, 3]], 7)
    assert (matrix.dtype, number.dtype) == (np.float32, np.int32)
    assert layout.unpack([matrix, number]) == scalars
