"""What a thread of a GPU runs: long programs together with its block, long arrays apart.

A long program does not fit into the instruction caches of a multiprocessor. Threads that read it
at different places wait for instructions most of the time; in step, one reads them for all.

CUDA sets local memory aside for as many threads as a GPU can hold, whatever a kernel uses: the
arrays of Humanoid's contacts, 48 kB a thread, would take 12.5 GB of an H200. A buffer of XLA's for
the threads that run takes 1.6 GB.
"""

import contextlib
from collections.abc import Callable, Iterator, Sequence

import numpy as np
from numpy.typing import DTypeLike

from mjx_reinforce.engine.llvm.emit import LLVM, Input, Value
from mjx_reinforce.engine.llvm.text import Text
from mjx_reinforce.engine.scalar.nodes import Node
from mjx_reinforce.engine.scalar.passes.liveness import LiveGate, LiveLoop, Schedule

#: Gates and loops of more operations are entered by all threads of a block at once.
LONG = 3_000
#: The name of what LLVM is told of a loop: NVIDIA's assembler, which would write out the loop over
#: all contacts of a Humanoid, leaves it a loop.
LOOP = "!0"
LOOP_FACTS = f"""{LOOP} = distinct !{{{LOOP}, !1}}
!1 = !{{!"llvm.loop.unroll.disable"}}
"""
#: The threads of a warp come together before they meet the others of their block: where they came
#: to a barrier one by one, an H200 waited forever.
_TOGETHER = "bar.warp.sync 0xffffffff;"
_MEET = f"{_TOGETHER} bar.sync 0;"
_SOME = (
    f"{{{{ .reg .pred p, q; setp.ne.b32 p, $1, 0; {_TOGETHER} bar.red.or.pred q, 0, p; "
    "selp.b32 $0, 1, 0, q; }}"
)

#: Threads of a warp. They have their words side by side.
WARP = 32
#: Bytes of a word.
_WORD = 4
#: On a GPU loops over so many contacts are written out. The arrays of longer loops are long.
WRITTEN_OUT = 25


def some_of_block(text: Text, flag: str) -> str:
    """Writes a meeting of all threads of a block; returns an i1: whether one has the flag set."""
    number = text.let(f"zext i1 {flag} to i32")
    found = text.let(f'call i32 asm sideeffect "{_SOME}", "=r,r"(i32 {number}) convergent')
    return text.let(f"icmp ne i32 {found}, 0")


def operations(body: Schedule) -> int:
    """Returns how many operations a schedule has."""
    return sum(operations(x.body) if isinstance(x, LiveGate | LiveLoop) else 1 for x in body)


class ScratchText(Text):
    """Text for one thread of a GPU, whose long arrays are in the kernel's argument ``%scratch``.

    words: how many words of it each thread has, so far.
    """

    def __init__(self):
        """Starts an empty body."""
        super().__init__(1)
        self.words = 0
        self._apart: set[str] = set()

    def function(self, signature: str) -> str:
        """Returns a module with a function, and with the number of words as "scratch", if any."""
        if not self.words:
            return super().function(signature)
        self._reserved[:0] = self._place_of_thread()
        return f"@scratch = constant i32 {self.words}\n{super().function(signature)}"

    def reserve_long(self, dtype: DTypeLike, count: int) -> str:
        """Returns what ``reserve`` does, in the buffer if the array is long; ``at`` reads it."""
        if count <= WRITTEN_OUT or np.dtype(dtype).itemsize > _WORD:
            return self.reserve(dtype, count)
        name = self.name()
        first = self.words * _WORD * WARP
        self._reserved.append(f"  {name} = getelementptr inbounds i8, ptr %own, i64 {first}")
        self.words += count
        self._apart.add(name)
        return name

    def at(self, pointer: str, dtype: DTypeLike, index: int | str) -> str:
        """Returns the pointer to an entry of an array."""
        if pointer not in self._apart:
            return super().at(pointer, dtype, index)
        step = _WORD * WARP
        offset = index * step if isinstance(index, int) else self.let(f"mul i64 {index}, {step}")
        return self.let(f"getelementptr inbounds i8, ptr {pointer}, i64 {offset}")

    def asked(self, number: str) -> str:
        """Returns the call that asks for a number of the thread: tid, ctaid or ntid."""
        call = f"i32 @llvm.nvvm.read.ptx.sreg.{number}.x()"
        self.declared.add(f"declare {call}")
        return f"call {call}"

    def _place_of_thread(self) -> list[str]:
        """Returns what finds the first word of the thread, ``%own``."""
        lines = (
            f"%thread = {self.asked('tid')}",
            f"%block = {self.asked('ctaid')}",
            f"%threads = {self.asked('ntid')}",
            "%before = mul i32 %block, %threads",
            "%number = add i32 %before, %thread",
            f"%lane = and i32 %number, {WARP - 1}",
            "%others = sub i32 %number, %lane",
            "%others.wide = zext i32 %others to i64",
            "%lane.wide = zext i32 %lane to i64",
            f"%warp.first = mul i64 %others.wide, {self.words}",
            "%first = add i64 %warp.first, %lane.wide",
            "%own = getelementptr inbounds i32, ptr %scratch, i64 %first",
        )
        return [f"  {line}" for line in lines]


class Lockstep(LLVM):
    """Writes LLVM IR for one of the threads of a block, all of which run what it writes."""

    BACK = f", !llvm.loop {LOOP}"

    def __init__(self, text: ScratchText, inputs: Callable[[int], Input]):
        """Arguments are those of ``LLVM``."""
        super().__init__(text, inputs)
        self._scratch = text
        self._together = True

    def reserve(self, dtype: np.dtype, count: int) -> str:
        """Returns a pointer to room for an array: a long one is in XLA's buffer."""
        return self._scratch.reserve_long(dtype, count)

    def some(self, mask: str) -> str:
        """Returns an i1: whether a thread goes on, or where all do, whether one must."""
        return some_of_block(self._text, mask) if self._together else mask

    def gate(self, gate: LiveGate, values: dict[Node, Value]) -> Sequence[Value]:
        """Writes a branch: a long one is taken by all threads if one needs it."""
        with self._going_through(gate.body):
            return super().gate(gate, values)

    def loop(
        self, loop: LiveLoop, values: dict[Node, Value]
    ) -> tuple[Sequence[Value], Sequence[Sequence[Value]]]:
        """Writes a loop: a long one goes on for all threads until none needs it."""
        with self._going_through(loop.body):
            return super().loop(loop, values)

    def goes_on(self, loop: LiveLoop, count: str, active: str | None) -> str:
        """Returns an i1: whether another iteration runs; all threads of a long loop meet here."""
        if self._together and active is None:
            self._text.line(f'call void asm sideeffect "{_MEET}", ""() convergent')
        return super().goes_on(loop, count, active)

    def may_skip(self, active: str | None) -> tuple[str, str] | None:
        """Writes the branch of threads that only wait for others in a loop."""
        if not self._together or active is None:
            return None
        text, before = self._text, self._text.block
        work, after = text.label(), text.label()
        text.line(f"br i1 {active}, label %{work}, label %{after}")
        text.start(work)
        self._together = False  # until the loop's end
        return before, after

    @contextlib.contextmanager
    def _going_through(self, body: Schedule) -> Iterator[None]:
        before = self._together
        self._together = before and operations(body) > LONG
        yield
        self._together = before
