"""The memory of a group of lanes: what each lane's episode is, entry by entry."""

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

#: The bytes of the widest lane vector, 16 numbers of 8 bytes: a vector begins at a multiple of its
#: size, as LLVM takes for granted.
ALIGNMENT = 128


@dataclasses.dataclass(frozen=True)
class Field:
    """Lane vectors that lie one after the other.

    offset: where they begin, in bytes.
    dtype: of their entries.
    count: how many there are.
    """

    offset: int
    dtype: np.dtype
    count: int


@dataclasses.dataclass(frozen=True)
class VectorLayout:
    """Where everything is.

    inputs: the leaves of the arguments of a step: actor, state, keys, t, deterministic, alive.
    actor: how many of them are the actor's.
    state: how many of them are the state's.
    broken: 1 where an episode left the finite numbers.
    limit: how many steps an episode has at most.
    seed: which seed a lane plays for.
    episode: which of its episodes.
    counted: the steps of the episodes that it has ended.
    size: of all, in bytes.
    """

    inputs: list[Field]
    actor: int
    state: int
    broken: Field
    limit: Field
    seed: Field
    episode: Field
    counted: Field
    size: int

    @property
    def actor_fields(self) -> list[Field]:
        """The actor's leaves that are not empty."""
        return [field for field in self.inputs[: self.actor] if field.count]

    @property
    def state_fields(self) -> list[Field]:
        """The state's leaves that are not empty."""
        leaves = self.inputs[self.actor : self.actor + self.state]
        return [field for field in leaves if field.count]

    @property
    def key(self) -> Field:
        """The key [2] of an episode; behind it lies that of its present chunk."""
        return dataclasses.replace(self.inputs[self.actor + self.state], count=2)

    @property
    def step(self) -> Field:
        """How many steps an episode has taken."""
        return self.inputs[-3]

    @property
    def deterministic(self) -> Field:
        """1 where actions are the mode."""
        return self.inputs[-2]

    @property
    def alive(self) -> Field:
        """1 where an episode is running."""
        return self.inputs[-1]


def layout(leaves: list[Any], actor: int, state: int, lanes: int) -> VectorLayout:
    """Returns where the lanes' values are.

    Args:
      leaves: shape and dtype of each leaf of the arguments of a step.
      actor: how many of them, the first ones, are the actor's.
      state: how many of those after them are the state's.
      lanes: how many lanes there are.

    Raises:
      TypeError: numbers of another size than 4 or 8 bytes.
    """
    for leaf in leaves:
        if np.dtype(leaf.dtype).itemsize not in (4, 8):
            raise TypeError(f"its state has numbers of {leaf.dtype}, not of 32 or 64 bits")
    end = 0

    def field(dtype: DTypeLike, count: int) -> Field:
        nonlocal end
        vector = np.dtype(dtype).itemsize * lanes
        begin = -(-end // vector) * vector
        end = begin + count * vector
        return Field(begin, np.dtype(dtype), count)

    inputs = [field(x.dtype, int(np.prod(x.shape, dtype=int))) for x in leaves]
    others = [field(x, 1) for x in (np.int32, np.int32, np.int64, np.int64, np.int64)]
    return VectorLayout(inputs, actor, state, *others, size=end)
