"""What each lane of a group plays: where its values are, and how it begins and ends an episode.

The episodes of all seeds are numbered, and the job has the next number. ``@begin(job, memory,
lane)`` gives a lane the next episode that is played, if there is one; ``@finish``, of the same
arguments, writes down how a lane's episode ended and then gives it the next. ``@settle(job, memory,
lane, iterations)`` counts the steps that a lane waited for others behind its last episode.
"""

from pathlib import Path
from string import Template
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import DTypeLike

from mjx_reinforce.engine.cpu import handler
from mjx_reinforce.engine.play.native_step import NOT_PLAYED

#: The bytes of the widest lane vector, 16 numbers of 8 bytes: a vector begins at a multiple of its
#: size, as LLVM takes for granted.
ALIGNMENT = 128
#: The buffers of a call: so many arguments of its own, those of the actor and the state, the
#: results, of which so many are records of steps.
NUM_CONTROLS, NUM_RECORDS = 3, 3
_LENGTH, _BROKEN = 3, 4
_QUEUE = Path(__file__).with_name("queue.ll")


class Field(NamedTuple):
    """Lane vectors that lie one after the other.

    offset: where they begin, in bytes.
    dtype: of their entries.
    entries: how many there are.
    """

    offset: int
    dtype: np.dtype
    entries: int


class VectorLayout(NamedTuple):
    """Where everything is.

    inputs: the leaves of the arguments of a step: actor, state, keys, t, deterministic, alive.
    actor: those of the actor that are not empty.
    state: those of the state that are not empty.
    key: the key [2] of an episode; behind it lies that of its present chunk.
    step: how many steps an episode has taken.
    deterministic: 1 where actions are the mode.
    alive: 1 where an episode is running.
    broken: 1 where an episode left the finite numbers.
    limit: how many steps an episode has at most.
    seed: which seed a lane plays for.
    episode: which of its episodes.
    counted: the steps of the episodes that it has ended.
    size: of all, in bytes.
    """

    inputs: list[Field]
    actor: list[Field]
    state: list[Field]
    key: Field
    step: Field
    deterministic: Field
    alive: Field
    broken: Field
    limit: Field
    seed: Field
    episode: Field
    counted: Field
    size: int


def layout(leaves: list[Any], num_actor: int, lanes: int) -> VectorLayout:
    """Returns where the lanes' values are.

    Args:
      leaves: shape and dtype of each leaf of the arguments of a step.
      num_actor: how many of them, the first ones, are the actor's.
      lanes: how many lanes there are.

    Raises:
      TypeError: numbers of another size than 4 or 8 bytes.
    """
    for leaf in leaves:
        if np.dtype(leaf.dtype).itemsize not in (4, 8):
            raise TypeError(f"its state has numbers of {leaf.dtype}, not of 32 or 64 bits")
    end = 0

    def field(dtype: DTypeLike, entries: int) -> Field:
        nonlocal end
        vector = np.dtype(dtype).itemsize * lanes
        begin = -(-end // vector) * vector
        end = begin + entries * vector
        return Field(begin, np.dtype(dtype), entries)

    inputs = [field(x.dtype, int(np.prod(x.shape, dtype=int))) for x in leaves]
    others = [field(x, 1) for x in (np.int32, np.int32, np.int64, np.int64, np.int64)]
    *state, keys, step, deterministic, alive = inputs[num_actor:]
    actor, state = ([x for x in part if x.entries] for part in (inputs[:num_actor], state))
    key = keys._replace(entries=2)
    return VectorLayout(inputs, actor, state, key, step, deterministic, alive, *others, size=end)


def queue_text(places: VectorLayout, lanes: int) -> str:
    """Returns ``@begin``, ``@finish`` and ``@settle`` for lanes whose values are at ``places``."""
    actor, state = places.actor, places.state
    first_state = NUM_CONTROLS + len(actor)
    first_result = first_state + len(state)
    values = {name: f"i32 0, i32 {number}" for number, name in enumerate(handler.FIELDS)}
    values |= {
        "lanes": str(lanes),
        "alive_at": _lane("%alive.at", places.alive),
        "seed_at": _lane("%seed.at", places.seed),
        "episode_at": _lane("%episode.at", places.episode),
        "step_at": _lane("%step.at", places.step),
        "limit_at": _lane("%limit.at", places.limit),
        "broken_at": _lane("%broken.at", places.broken),
        "counted_at": _lane("%counted.at", places.counted),
        "deterministic_at": _lane("%mode.lane", places.deterministic),
        "plays_arg": str(handler.PLAYS),
        "not_played": str(NOT_PLAYED),
        "length_data": str(first_result + _LENGTH),
        "broken_data": str(first_result + _BROKEN),
        "simulated_data": str(first_result + handler.SIMULATED),
        "copy_actor": "\n".join(
            _copy(f"actor{i}", field, NUM_CONTROLS + i, "%index") for i, field in enumerate(actor)
        ),
        "copy_state": "\n".join(
            [
                *(_copy(f"state{i}", x, first_state + i, "%item") for i, x in enumerate(state)),
                _copy("keys", places.key, handler.KEYS, "%item"),
            ]
        ),
    }
    return Template(_QUEUE.read_text("utf-8")).substitute(values)


def _lane(name: str, field: Field) -> str:
    """Returns the instructions that point to a lane's entry of a field's first vector."""
    return "\n  ".join(
        [
            f"{name}.k = mul i64 %lane, {field.dtype.itemsize}",
            f"{name}.o = add i64 {name}.k, {field.offset}",
            f"{name} = getelementptr inbounds i8, ptr %memory, i64 {name}.o",
        ]
    )


def _copy(name: str, field: Field, buffer: int, row: str) -> str:
    """Returns the instructions that copy a row of a buffer into a lane's column of a field."""
    size = field.dtype.itemsize
    lines = [
        f"%{name}.buffer.at = getelementptr inbounds ptr, ptr %data, i64 {buffer}",
        f"%{name}.buffer = load ptr, ptr %{name}.buffer.at",
        f"%{name}.from.k = mul i64 {row}, {field.entries * size}",
        f"%{name}.from = getelementptr inbounds i8, ptr %{name}.buffer, i64 %{name}.from.k",
        _lane(f"%{name}.to", field),
        f"call void @copy{size}(ptr %{name}.to, ptr %{name}.from, i64 {field.entries})",
    ]
    return "\n".join(f"  {line}" for line in lines)
