"""The program that every thread runs: it plays episodes in the lanes of vectors.

A lane whose episode is over takes the next one (``lanes``), so no lane waits for a longer episode
beside it, whatever the seeds do. What a lane computes depends on its own episode alone: results are
the same for any number of lanes and threads.
"""

from typing import Any

import numpy as np

from mjx_reinforce.engine.cpu import handler
from mjx_reinforce.engine.cpu.handler import Flush
from mjx_reinforce.engine.cpu.lanes import (
    ALIGNMENT,
    NUM_CONTROLS,
    NUM_RECORDS,
    Field,
    VectorLayout,
    layout,
    queue_text,
)
from mjx_reinforce.engine.llvm.emit import LLVM, Input
from mjx_reinforce.engine.llvm.text import Text
from mjx_reinforce.engine.scalar import scalarized

_INT, _LONG = np.dtype(np.int32), np.dtype(np.int64)


def player_text(step: scalarized.Scalarized, num_actor: int, lanes: int, flush: Flush) -> str:
    """Returns the LLVM IR of ``@work(job)``.

    Args:
      step: of ``step.step_function``, written out.
      num_actor: how many leaves of its arguments are the actor's.
      lanes: how many lanes a vector has.
      flush: what makes all threads round alike.
    """
    places = layout(step.in_avals, num_actor, lanes)
    work = _Work(Text(lanes), places, num_actor).write(step, flush)
    return flush.declarations + queue_text(places, lanes) + work


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

    def write(self, step: scalarized.Scalarized, flush: Flush) -> str:
        """Returns the function that plays with a step."""
        text, memory = self.text, self.memory
        text.line(flush.begin)
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
        text.line(flush.end)
        text.line(f"call void @free(ptr {self.room})")
        text.line("ret void")
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
        with text.unless_none(ended):
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
