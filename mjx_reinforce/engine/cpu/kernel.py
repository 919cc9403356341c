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
_MAX_STACK = 2**20


#: The buffers of a call: so many arguments of its own, those of the actor and the state, the
#: results, of which so many are records of steps.
NUM_CONTROLS = 3
NUM_RECORDS = 3
#: The results behind the records that ``@finish`` writes.
_LENGTH_RESULT = 3
_BROKEN_RESULT = 4
#: What the queue looks at of a lane.
_LANE_FIELDS = ("alive", "seed", "episode", "step", "limit", "broken", "counted")
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
        """Returns the next field; it begins at a multiple of the size of its vectors."""
        nonlocal end
        vector_bytes = np.dtype(dtype).itemsize * lanes
        offset = -(-end // vector_bytes) * vector_bytes
        end = offset + entries * vector_bytes
        return Field(offset, np.dtype(dtype), entries)

    inputs = [field(x.dtype, int(np.prod(x.shape, dtype=int))) for x in leaves]
    *state, keys, step, deterministic, alive_mask = inputs[num_actor:]
    return VectorLayout(
        inputs=inputs,
        actor=[x for x in inputs[:num_actor] if x.entries],
        state=[x for x in state if x.entries],
        # The queue writes the episode's key; that of a chunk is split from it in its first step.
        key=keys._replace(entries=2),
        step=step,
        deterministic=deterministic,
        alive=alive_mask,
        broken=field(np.int32, 1),
        limit=field(np.int32, 1),
        seed=field(np.int64, 1),
        episode=field(np.int64, 1),
        counted=field(np.int64, 1),
        # Last, for each field above has moved the end.
        size=end,
    )


def queue_text(places: VectorLayout, lanes: int) -> str:
    """Returns ``@begin``, ``@finish`` and ``@settle`` for lanes whose values are at ``places``."""
    # Buffers are numbered: the controls, the actor, the state, the results.
    first_state = NUM_CONTROLS + len(places.actor)
    first_result = first_state + len(places.state)
    copies_of_actor = [
        # All episodes of a seed have the same actor.
        _copy(f"actor{i}", field, NUM_CONTROLS + i, "%index")
        for i, field in enumerate(places.actor)
    ]
    copies_of_state = [
        _copy(f"state{i}", field, first_state + i, "%item") for i, field in enumerate(places.state)
    ]
    copies_of_state.append(_copy("keys", places.key, handler.KEYS, "%item"))
    values = {name: f"i32 0, i32 {number}" for number, name in enumerate(handler.JOB)}
    values |= {
        "lanes": str(lanes),
        "deterministic_at": _lane("%mode.lane", places.deterministic),
        **{f"{x}_at": _lane(f"%{x}.at", getattr(places, x)) for x in _LANE_FIELDS},
        "limits_arg": str(handler.LIMITS),
        "not_played": str(NOT_PLAYED),
        "length_data": str(first_result + _LENGTH_RESULT),
        "broken_data": str(first_result + _BROKEN_RESULT),
        "simulated_data": str(first_result + handler.SIMULATED),
        "copy_actor": "\n".join(copies_of_actor),
        "copy_state": "\n".join(copies_of_state),
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
    # A lane's entries lie ``lanes`` numbers apart, its column: ``@copy4`` and ``@copy8`` stride.
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


_INT32 = np.dtype(np.int32)
_INT64 = np.dtype(np.int64)


def kernel_text(step: scalarized.Scalarized, num_actor: int, lanes: int) -> str:
    """Returns the LLVM IR of ``@work(job)``.

    Args:
      step: of ``program.step_function``, written out.
      num_actor: how many leaves of its arguments are the actor's.
      lanes: how many lanes a vector has.
    """
    places = layout(step.in_avals, num_actor, lanes)
    writer = _Work(Text(lanes, _MAX_STACK), places, num_actor)
    return queue_text(places, lanes) + writer.write(step)


class _Work(handler.JobText):
    """Writes ``@work``; pointers are to the lane vectors of its memory."""

    def __init__(self, text: Text, places: VectorLayout, num_actor: int):
        """Writes what a thread does once: it takes memory for its lanes, and finds all in it."""
        super().__init__(text)
        self.places = places
        self.num_actor = num_actor
        self.room, self.memory = self._allocate()
        self.inputs = [self._pointer(field) for field in places.inputs]
        self.seed = self._pointer(places.seed)
        self.episode = self._pointer(places.episode)
        self.step = self._pointer(places.step)
        self.broken = self._pointer(places.broken)
        self.limit = self._pointer(places.limit)
        self.alive = self._pointer(places.alive)
        self.horizon = self.job("horizon", "i64")
        self.episodes = self.job("episodes", "i64")
        first_result = NUM_CONTROLS + len(places.actor) + len(places.state)
        data = self.job("data", "ptr")
        self.records = [self.element(data, first_result + k) for k in range(NUM_RECORDS)]

    def write(self, step: scalarized.Scalarized) -> str:
        """Returns the function that plays with a step."""
        text = self.text
        text.line("%control = call i64 @flush()")
        text.store(text.constant(np.int64(-1)), self.seed, _INT64)  # a lane's first seed is new
        for lane in range(text.lanes):
            text.line(f"call void @begin(ptr %job, ptr {self.memory}, i64 {lane})")
        entry_block = text.block
        head = text.label()
        body = text.label()
        end = text.label()
        text.line(f"br label %{head}")
        text.start(head)
        # The body may end in another block than it begins in, which is known behind it: the phi
        # that counts iterations is filled in then.
        iterations = text.hole()
        alive_mask = self._is_set(text.load(self.alive, _INT32))
        text.line(f"br i1 {text.any(alive_mask)}, label %{body}, label %{end}")
        text.start(body)
        self._finish(self._play(step, alive_mask))
        next_iterations = text.let(f"add i64 {iterations.name}, 1")
        text.fill(iterations, f"phi i64 [0, %{entry_block}], [{next_iterations}, %{text.block}]")
        text.line(f"br label %{head}")
        text.start(end)
        for lane in range(text.lanes):
            lane_of_job = f"ptr %job, ptr {self.memory}, i64 {lane}"
            text.line(f"call void @settle({lane_of_job}, i64 {iterations.name})")
        text.line("call void @unflush(i64 %control)")
        text.line(f"call void @free(ptr {self.room})")
        text.leave()
        return text.function("void @work(ptr %job)")

    def _play(self, step: scalarized.Scalarized, alive_mask: str) -> str:
        """Writes a step of all lanes; returns which of them have ended their episode by it."""
        text = self.text
        slots = self.places.inputs
        emit = LLVM(text, lambda number: Input(self.inputs[number], slots[number].dtype))
        values = emit.compile(step.schedule, step.outputs)
        # Now, while the lanes' numbers of steps are still those of this step.
        self._record(values[:NUM_RECORDS], step.out_avals, alive_mask)
        (is_going_on,), (is_broken,), *carries = values[NUM_RECORDS:]
        # The state and the keys lie behind the actor, in the order in which a step returns them. A
        # lane without an episode carries on, too: nothing reads it before another one begins.
        pointers = self.inputs[self.num_actor :]
        for leaf, pointer, field in zip(carries, pointers, slots[self.num_actor :], strict=False):
            for k, value in enumerate(leaf):
                text.store(value, text.at(pointer, field.dtype, k), field.dtype)
        kind = text.type(_INT32)
        increment = text.constant(np.int32(1))
        steps = text.let(f"add {kind} {text.load(self.step, _INT32)}, {increment}")
        text.store(steps, self.step, _INT32)
        text.store(is_broken, self.broken, _INT32)
        is_late = text.let(f"icmp sge {kind} {steps}, {text.load(self.limit, _INT32)}")
        bools = text.type(bool)
        true_lanes = text.constant(np.True_)
        is_stopping = text.let(f"xor {bools} {self._is_set(is_going_on)}, {true_lanes}")
        is_stopping = text.let(f"or {bools} {is_stopping}, {is_late}")
        return text.let(f"and {bools} {is_stopping}, {alive_mask}")

    def _record(self, records: list[Any], avals: list[Any], alive_mask: str) -> None:
        """Writes observation, action and reward into results [S, T, N, ...]."""
        text = self.text
        kind = text.type(_INT64)
        seed = text.load(self.seed, _INT64)
        episode = text.load(self.episode, _INT64)
        step = text.let(f"sext {text.type(_INT32)} {text.load(self.step, _INT32)} to {kind}")
        horizon = text.broadcast("i64", self.horizon)
        episodes = text.broadcast("i64", self.episodes)
        # In 64 bits: the numbers of a sweep's records may be more than 2^31.
        row = text.let(f"mul {kind} {seed}, {horizon}")
        row = text.let(f"add {kind} {row}, {step}")
        row = text.let(f"mul {kind} {row}, {episodes}")
        row = text.let(f"add {kind} {row}, {episode}")
        for values, pointer, aval in zip(records, self.records, avals, strict=False):
            start = text.let(f"mul {kind} {row}, {text.constant(np.int64(len(values)))}")
            for k, value in enumerate(values):
                index = text.let(f"add {kind} {start}, {text.constant(np.int64(k))}")
                text.scatter(value, pointer, index, alive_mask, aval.dtype)

    def _finish(self, end_mask: str) -> None:
        """Writes what is done for the lanes whose episode has ended."""
        text = self.text
        # Most steps end no episode: one test of all lanes skips a test of each.
        with text.when(text.any(end_mask)):
            mask = text.mask(end_mask)
            for lane in range(text.lanes):
                with text.when(text.bit(mask, lane)):
                    text.line(f"call void @finish(ptr %job, ptr {self.memory}, i64 {lane})")

    def _allocate(self) -> tuple[str, str]:
        """Returns what is to be freed, and the aligned memory in it, all zero."""
        text = self.text
        size = self.places.size
        # On the heap: of a large model it is more than XLA's threads have on their stacks.
        room = text.let(f"call ptr @malloc(i64 {size + ALIGNMENT})")
        address = text.let(f"ptrtoint ptr {room} to i64")
        address = text.let(f"add i64 {address}, {ALIGNMENT - 1}")
        address = text.let(f"and i64 {address}, {-ALIGNMENT}")
        memory = text.let(f"inttoptr i64 {address} to ptr")
        text.line(f"call void @llvm.memset.p0.i64(ptr {memory}, i8 0, i64 {size}, i1 false)")
        return room, memory

    def _pointer(self, field: Field) -> str:
        return self.text.let(f"getelementptr inbounds i8, ptr {self.memory}, i64 {field.offset}")

    def _is_set(self, flag: str) -> str:
        zero = self.text.constant(np.int32(0))
        return self.text.let(f"icmp ne {self.text.type(_INT32)} {flag}, {zero}")


#: The number of threads comes first, then the leaves.
MAPPING = handler.Positions(threads=0, items=1, steps=0)


def mapping_text(program: scalarized.Scalarized, lanes: int) -> str:
    """Returns the LLVM IR of ``@work(job)``.

    Its arguments are the threads [] int32 and the leaves [N, ...] of the function's arguments that
    are not empty; its results the leaves of its result.

    Args:
      program: the function.
      lanes: how many lanes a vector has.
    """
    return _Map(Text(lanes, _MAX_STACK), program).write()


class _Map(handler.JobText):
    """Writes ``@work``."""

    def __init__(self, text: Text, program: scalarized.Scalarized):
        super().__init__(text)
        self.written = program
        self.inputs = program.in_avals

    def write(self) -> str:
        """Returns the function."""
        text = self.text
        text.line("%control = call i64 @flush()")
        num_items = self.job("total", "i64")
        data = self.job("data", "ptr")
        next_item = self.field("next")
        # Leaves without numbers have no buffer; the first one has the number of threads.
        arguments = [x for x in self.inputs if num_entries(x)]
        avals = [x for x in self.written.out_avals if num_entries(x)]
        buffers = [self.element(data, k) for k in range(1 + len(arguments) + len(avals))]
        argument_buffers = buffers[1 : 1 + len(arguments)]
        result_buffers = buffers[1 + len(arguments) :]
        columns = [
            text.reserve(x.dtype, num_entries(x)) if num_entries(x) else "null" for x in self.inputs
        ]
        columns_of_arguments = [column for column in columns if column != "null"]
        head = text.label()
        body = text.label()
        end = text.label()
        text.line(f"br label %{head}")
        text.start(head)
        # A thread takes a vector's lanes of examples at once; others may have taken all.
        first_item = text.let(f"atomicrmw add ptr {next_item}, i64 {text.lanes} monotonic")
        has_items = text.let(f"icmp ult i64 {first_item}, {num_items}")
        text.line(f"br i1 {has_items}, label %{body}, label %{end}")
        text.start(body)
        items, mask = self._items(first_item, num_items)
        # An example's numbers are a row, a lane's are a column: they are turned on the way in.
        for aval, buffer, column in zip(
            arguments, argument_buffers, columns_of_arguments, strict=True
        ):
            for k, index in enumerate(self._indices(items, num_entries(aval))):
                value = text.gather(buffer, index, aval.dtype)
                text.store(value, text.at(column, aval.dtype, k), aval.dtype)
        emit = LLVM(text, lambda k: Input(columns[k], np.dtype(self.inputs[k].dtype)))
        outputs = emit.compile(self.written.schedule, self.written.outputs)
        full_outputs = [values for values in outputs if values]
        for aval, buffer, values in zip(avals, result_buffers, full_outputs, strict=True):
            for value, index in zip(values, self._indices(items, num_entries(aval)), strict=True):
                text.scatter(value, buffer, index, mask, aval.dtype)
        text.line(f"br label %{head}")
        text.start(end)
        text.line("call void @unflush(i64 %control)")
        text.leave()
        return text.function("void @work(ptr %job)")

    def _items(self, first_item: str, num_items: str) -> tuple[str, str]:
        """Returns the example of each lane, and which lanes have one of their own."""
        text = self.text
        kind = text.type(_INT64)
        lanes = ", ".join(f"i64 {lane}" for lane in range(text.lanes))
        items = text.let(f"add {kind} {text.broadcast('i64', first_item)}, <{lanes}>")
        count = text.broadcast("i64", num_items)
        mask = text.let(f"icmp ult {kind} {items}, {count}")
        last_lane = text.let(f"sub {kind} {count}, {text.constant(np.int64(1))}")
        bools = text.type(bool)
        return text.let(f"select {bools} {mask}, {kind} {items}, {kind} {last_lane}"), mask

    def _indices(self, items: str, size: int) -> list[str]:
        """Returns where in an array [N, size] each lane's entries are."""
        text = self.text
        kind = text.type(_INT64)
        start = text.let(f"mul {kind} {items}, {text.constant(np.int64(size))}")
        return [text.let(f"add {kind} {start}, {text.constant(np.int64(k))}") for k in range(size)]
