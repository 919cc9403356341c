"""Values that lie evenly spaced in one input: a loop can read them by their number."""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

from mjx_reinforce.fused.nodes import Node, Scalar


class Places(NamedTuple):
    """Evenly spaced elements of one input."""

    leaf: int
    start: int
    stride: int


def evenly_spaced(row: Sequence[Scalar]) -> Places | None:
    """Returns where the elements of a row are, if they are evenly spaced in one input."""
    if not all(isinstance(x, Node) and x.op is None and x.owner is None for x in row):
        return None
    leaves = {x.position[0] for x in row}
    strides = {b.position[1] - a.position[1] for a, b in itertools.pairwise(row)}
    if len(leaves) != 1 or len(strides) != 1:
        return None
    return Places(leaves.pop(), row[0].position[1], strides.pop())
