"""What a thread of a GPU runs: long programs together with its block.

A long program does not fit into the instruction caches of a multiprocessor. Threads that read it
at different places wait for instructions most of the time; in step, one reads them for all.
"""

import contextlib
from collections.abc import Iterator, Sequence

from mjx_reinforce.engine.llvm.emit import LLVM, Value
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


def some_of_block(text: Text, flag: str) -> str:
    """Writes a meeting of all threads of a block; returns an i1: whether one has the flag set."""
    number = text.let(f"zext i1 {flag} to i32")
    found = text.let(f'call i32 asm sideeffect "{_SOME}", "=r,r"(i32 {number}) convergent')
    return text.let(f"icmp ne i32 {found}, 0")


def operations(body: Schedule) -> int:
    """Returns how many operations a schedule has."""
    return sum(operations(x.body) if isinstance(x, LiveGate | LiveLoop) else 1 for x in body)


class Lockstep(LLVM):
    """Writes LLVM IR for one of the threads of a block, all of which run what it writes."""

    BACK = f", !llvm.loop {LOOP}"
    _together = True

    def some(self, mask: str) -> str:
        """Returns an i1: whether a thread goes on, or where all do, whether one must."""
        return some_of_block(self._text, mask) if self._together else mask

    def gate(self, gate: LiveGate, values: dict[Node, Value]) -> Sequence[Value]:
        """Writes a branch: a long one is taken by all threads if one needs it."""
        with self._going_through(gate.body):
            return super().gate(gate, values)

    def loop(self, loop: LiveLoop, values: dict[Node, Value]) -> Sequence[Value]:
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
