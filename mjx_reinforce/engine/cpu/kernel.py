"""The program that every thread runs: it plays episodes in the lanes of vectors.

A lane whose episode is over takes the next one, so no lane waits for a longer episode beside it,
whatever the seeds do. What a lane computes depends on its own episode alone: results are the same
for any number of lanes and threads.

The episodes of all seeds are numbered, and the job has the next number. ``@begin(job, memory,
lane)`` gives a lane the next episode that is played, if there is one; ``@finish``, of the same
arguments, writes down how a lane's episode ended and then gives it the next. ``@settle(job, memory,
lane, iterations)`` counts the steps that a lane waited for others behind its last episode.

A function is mapped likewise: a thread takes as many examples at once as a vector has lanes. Lanes
of the last group that have no example compute the last one again, and leave nothing.
"""

from pathlib import Path
from string import Template
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import DTypeLike

from mjx_reinforce.engine.cpu import handler
from mjx_reinforce.engine.episode import NOT_PLAYED
from mjx_reinforce.engine.llvm.emit import LLVM, Input
from mjx_reinforce.engine.llvm.text import Text
from mjx_reinforce.engine.scalar import scalarized
from mjx_reinforce.engine.scalar.jaxprs import num_entries

#: The bytes of the widest lane vector, 16 numbers of 8 bytes: a vector begins at a multiple of its
#: size, as LLVM takes for granted.
ALIGNMENT = 128
#: Loops of a large model hold more between them than a thread's stack has room for.
_MOST_ON_STACK = 2**20


#: The buffers of a call: so many arguments of its own, those of the actor and the state, the
#: results, of which so many are records of steps.
NUM_CONTROLS, NUM_RECORDS = 3, 3


_LENGTH, _BROKEN = 3, 4


#: What the queue looks at of a lane.
_OF_LANES = ("alive", "seed", "episode", "step", "limit", "broken", "counted")
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
        "deterministic_at": _lane("%mode.lane", places.deterministic),
        **{f"{x}_at": _lane(f"%{x}.at", getattr(places, x)) for x in _OF_LANES},
        "limits_arg": str(handler.LIMITS),
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


_INT, _LONG = np.dtype(np.int32), np.dtype(np.int64)


def kernel_text(step: scalarized.Scalarized, num_actor: int, lanes: int) -> str:
    """Returns the LLVM IR of ``@work(job)``.

    Args:
      step: of ``program.step_function``, written out.
      num_actor: how many leaves of its arguments are the actor's.
      lanes: how many lanes a vector has.
    """
    places = layout(step.in_avals, num_actor, lanes)
    return queue_text(places, lanes) + _Work(Text(lanes, _MOST_ON_STACK), places, num_actor).write(
        step
    )


class _Work(handler.JobText):
    """Writes ``@work``; pointers are to the lane vectors of its memory."""

    def __init__(self, text: Text, places: VectorLayout, num_actor: int):
        super().__init__(text)
        self.places, self.num_actor = places, num_actor
        self.room, self.memory = self._allocate()
        self.inputs = [self._pointer(field) for field in places.inputs]
        self.seed, self.episode = self._pointer(places.seed), self._pointer(places.episode)
        self.step, self.broken = self._pointer(places.step), self._pointer(places.broken)
        self.limit, self.alive = self._pointer(places.limit), self._pointer(places.alive)
        self.horizon, self.episodes = self.job("horizon", "i64"), self.job("episodes", "i64")
        first = NUM_CONTROLS + len(places.actor) + len(places.state)
        data = self.job("data", "ptr")
        self.records = [self.element(data, first + k) for k in range(NUM_RECORDS)]

    def write(self, step: scalarized.Scalarized) -> str:
        """Returns the function that plays with a step."""
        text, memory = self.text, self.memory
        text.line("%control = call i64 @flush()")
        text.store(text.constant(np.int64(-1)), self.seed, _LONG)  # a lane's first seed is new
        for lane in range(text.lanes):
            text.line(f"call void @begin(ptr %job, ptr {memory}, i64 {lane})")
        before, head, body, end = text.block, text.label(), text.label(), text.label()
        text.line(f"br label %{head}")
        text.start(head)
        iterations = text.hole()
        alive = self._is_set(text.load(self.alive, _INT))
        text.line(f"br i1 {text.any(alive)}, label %{body}, label %{end}")
        text.start(body)
        self._finish(self._play(step, alive))
        more = text.let(f"add i64 {iterations.name}, 1")
        text.fill(iterations, f"phi i64 [0, %{before}], [{more}, %{text.block}]")
        text.line(f"br label %{head}")
        text.start(end)
        for lane in range(text.lanes):
            lane_of = f"ptr %job, ptr {memory}, i64 {lane}"
            text.line(f"call void @settle({lane_of}, i64 {iterations.name})")
        text.line("call void @unflush(i64 %control)")
        text.line(f"call void @free(ptr {self.room})")
        text.leave()
        return text.function("void @work(ptr %job)")

    def _play(self, step: scalarized.Scalarized, alive: str) -> str:
        """Writes a step of all lanes; returns which of them have ended their episode by it."""
        text, fields = self.text, self.places.inputs
        emit = LLVM(text, lambda number: Input(self.inputs[number], fields[number].dtype))
        values = emit.compile(step.schedule, step.outputs)
        self._record(values[:NUM_RECORDS], step.out_avals, alive)
        (goes_on,), (broken,), *carried = values[NUM_RECORDS:]
        first = self.num_actor
        for leaf, to, field in zip(carried, self.inputs[first:], fields[first:], strict=False):
            for k, value in enumerate(leaf):
                text.store(value, text.at(to, field.dtype, k), field.dtype)
        kind = text.type(_INT)
        one = text.constant(np.int32(1))
        steps = text.let(f"add {kind} {text.load(self.step, _INT)}, {one}")
        text.store(steps, self.step, _INT)
        text.store(broken, self.broken, _INT)
        late = text.let(f"icmp sge {kind} {steps}, {text.load(self.limit, _INT)}")
        bools, true = text.type(bool), text.constant(np.True_)
        stops = text.let(f"xor {bools} {self._is_set(goes_on)}, {true}")
        stops = text.let(f"or {bools} {stops}, {late}")
        return text.let(f"and {bools} {stops}, {alive}")

    def _record(self, records: list[Any], avals: list[Any], alive: str) -> None:
        """Writes observation, action and reward into results [S, T, N, ...]."""
        text, kind = self.text, self.text.type(_LONG)
        seed, episode = text.load(self.seed, _LONG), text.load(self.episode, _LONG)
        step = text.let(f"sext {text.type(_INT)} {text.load(self.step, _INT)} to {kind}")
        horizon, episodes = (text.broadcast("i64", x) for x in (self.horizon, self.episodes))
        row = text.let(f"mul {kind} {seed}, {horizon}")
        row = text.let(f"add {kind} {row}, {step}")
        row = text.let(f"mul {kind} {row}, {episodes}")
        row = text.let(f"add {kind} {row}, {episode}")
        for values, result, aval in zip(records, self.records, avals, strict=False):
            first = text.let(f"mul {kind} {row}, {text.constant(np.int64(len(values)))}")
            for k, value in enumerate(values):
                index = text.let(f"add {kind} {first}, {text.constant(np.int64(k))}")
                text.scatter(value, result, index, alive, aval.dtype)

    def _finish(self, ended: str) -> None:
        """Writes what is done for the lanes whose episode has ended."""
        text = self.text
        with text.when(text.any(ended)):
            mask = text.mask(ended)
            for lane in range(text.lanes):
                with text.when(text.bit(mask, lane)):
                    text.line(f"call void @finish(ptr %job, ptr {self.memory}, i64 {lane})")

    def _allocate(self) -> tuple[str, str]:
        """Returns what is to be freed, and the aligned memory in it, all zero."""
        text, size = self.text, self.places.size
        room = text.let(f"call ptr @malloc(i64 {size + ALIGNMENT})")
        number = text.let(f"ptrtoint ptr {room} to i64")
        number = text.let(f"add i64 {number}, {ALIGNMENT - 1}")
        number = text.let(f"and i64 {number}, {-ALIGNMENT}")
        memory = text.let(f"inttoptr i64 {number} to ptr")
        text.line(f"call void @llvm.memset.p0.i64(ptr {memory}, i8 0, i64 {size}, i1 false)")
        return room, memory

    def _pointer(self, field: Field) -> str:
        return self.text.let(f"getelementptr inbounds i8, ptr {self.memory}, i64 {field.offset}")

    def _is_set(self, flag: str) -> str:
        zero = self.text.constant(np.int32(0))
        return self.text.let(f"icmp ne {self.text.type(_INT)} {flag}, {zero}")


#: The number of threads comes first, then the leaves.
MAPPED = handler.Positions(threads=0, items=1, steps=0)


def mapping_text(written: scalarized.Scalarized, lanes: int) -> str:
    """Returns the LLVM IR of ``@work(job)``.

    Its arguments are the threads [] int32 and the leaves [N, ...] of the function's arguments that
    are not empty; its results the leaves of its result.

    Args:
      written: the function.
      lanes: how many lanes a vector has.
    """
    return _Map(Text(lanes, _MOST_ON_STACK), written).write()


class _Map(handler.JobText):
    """Writes ``@work``."""

    def __init__(self, text: Text, written: scalarized.Scalarized):
        super().__init__(text)
        self.written, self.inputs = written, written.in_avals

    def write(self) -> str:
        """Returns the function."""
        text, lanes = self.text, self.text.lanes
        text.line("%control = call i64 @flush()")
        total, data = self.job("total", "i64"), self.job("data", "ptr")
        next_at = self.field("next")
        given = [x for x in self.inputs if num_entries(x)]
        made = [x for x in self.written.out_avals if num_entries(x)]
        buffers = [self.element(data, k) for k in range(1 + len(given) + len(made))]
        arguments, results = buffers[1 : 1 + len(given)], buffers[1 + len(given) :]
        columns = [
            text.reserve(x.dtype, num_entries(x)) if num_entries(x) else "null" for x in self.inputs
        ]
        head, body, end = text.label(), text.label(), text.label()
        text.line(f"br label %{head}")
        text.start(head)
        first = text.let(f"atomicrmw add ptr {next_at}, i64 {lanes} monotonic")
        some = text.let(f"icmp ult i64 {first}, {total}")
        text.line(f"br i1 {some}, label %{body}, label %{end}")
        text.start(body)
        item, mask = self._items(first, total)
        for aval, source, column in zip(
            given, arguments, (x for x in columns if x != "null"), strict=True
        ):
            for k, index in enumerate(self._indices(item, num_entries(aval))):
                value = text.gather(source, index, aval.dtype)
                text.store(value, text.at(column, aval.dtype, k), aval.dtype)
        emit = LLVM(text, lambda k: Input(columns[k], np.dtype(self.inputs[k].dtype)))
        outputs = emit.compile(self.written.schedule, self.written.outputs)
        for aval, target, values in zip(made, results, (x for x in outputs if x), strict=True):
            for value, index in zip(values, self._indices(item, num_entries(aval)), strict=True):
                text.scatter(value, target, index, mask, aval.dtype)
        text.line(f"br label %{head}")
        text.start(end)
        text.line("call void @unflush(i64 %control)")
        text.leave()
        return text.function("void @work(ptr %job)")

    def _items(self, first: str, total: str) -> tuple[str, str]:
        """Returns the example of each lane, and which lanes have one of their own."""
        text, kind = self.text, self.text.type(_LONG)
        lanes = ", ".join(f"i64 {lane}" for lane in range(text.lanes))
        offsets = "0" if text.lanes == 1 else f"<{lanes}>"
        item = text.let(f"add {kind} {text.broadcast('i64', first)}, {offsets}")
        count = text.broadcast("i64", total)
        mask = text.let(f"icmp ult {kind} {item}, {count}")
        last = text.let(f"sub {kind} {count}, {text.constant(np.int64(1))}")
        bools = text.type(bool)
        return text.let(f"select {bools} {mask}, {kind} {item}, {kind} {last}"), mask

    def _indices(self, item: str, size: int) -> list[str]:
        """Returns where in an array [N, size] each lane's entries are."""
        text, kind = self.text, self.text.type(_LONG)
        first = text.let(f"mul {kind} {item}, {text.constant(np.int64(size))}")
        return [text.let(f"add {kind} {first}, {text.constant(np.int64(k))}") for k in range(size)]
