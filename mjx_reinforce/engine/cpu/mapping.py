"""The program that every thread runs to map a function: it computes examples in lanes.

A thread takes as many examples at once as a vector has lanes. The lanes of the last group that have
no example compute the last one again, and leave nothing.
"""

import numpy as np

from mjx_reinforce.engine.cpu import handler
from mjx_reinforce.engine.llvm.emit import LLVM, Input
from mjx_reinforce.engine.llvm.text import Text
from mjx_reinforce.engine.scalar import scalarized
from mjx_reinforce.engine.scalar.jaxprs import num_entries

_LONG = np.dtype(np.int64)
#: The number of threads comes first, then the leaves.
POSITIONS = handler.Positions(threads=0, items=1, steps=0)


def mapping_text(written: scalarized.Scalarized, lanes: int) -> str:
    """Returns the LLVM IR of ``@work(job)``.

    Its arguments are the threads [] int32 and the leaves [N, ...] of the function's arguments that
    are not empty; its results the leaves of its result.

    Args:
      written: the function.
      lanes: how many lanes a vector has.
    """
    return _Work(Text(lanes), written).write()


class _Work(handler.JobText):
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
        text.line("ret void")
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
