"""The kernels that every thread of a GPU runs, to play one episode after the other, or to map.

A thread whose episode is over takes the next one, of whatever seed, so few threads wait for longer
episodes beside theirs. What a thread computes depends on its episode alone: results are the same
for any number of threads.

A long program does not fit into the instruction caches of a multiprocessor. Threads that read it
at different places wait for instructions most of the time; in step, one reads them for all.
"""

import contextlib
import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from mjx_reinforce.engine.episode import NOT_PLAYED
from mjx_reinforce.engine.gpu.source import Facts, Source
from mjx_reinforce.engine.llvm.emit import LLVM, Input, Value
from mjx_reinforce.engine.llvm.text import Text
from mjx_reinforce.engine.scalar import scalarized
from mjx_reinforce.engine.scalar.jaxprs import num_entries
from mjx_reinforce.engine.scalar.nodes import Node
from mjx_reinforce.engine.scalar.passes import liveness
from mjx_reinforce.engine.scalar.passes.liveness import LiveGate, LiveLoop, Schedule

_INT = np.dtype(np.int32)
#: The kernel's name. Its attributes are #0.
ENTRY = "play"
#: What a kernel reads before the actor and the state, by name; see ``kernel_text``.
CONTROLS = ("sizes", "limits", "keys")
#: What it writes.
RESULTS = ("observation", "action", "reward", "length", "broken", "simulated", "next")
#: The arguments of a step behind the actor and the state: keys, t, deterministic.
_NUM_OTHERS = 3
#: For programs that fit into a multiprocessor's instruction caches: a thread has 128 registers.
_SHORT = Facts(threads=32, blocks=16)
#: For longer ones: a thread has 255 registers.
_LONG = Facts(threads=256, blocks=1)
#: XLA's buffers begin at multiples of more bytes. A thread loads as many at once.
_BUFFER_ALIGN = 16
#: Denormals are zero, as in machine code for CPUs.
_ATTRIBUTES = """attributes #0 = {{ "denormal-fp-math-f32"="preserve-sign"
  "nvvm.maxntid"="{facts.threads}" "nvvm.minctasm"="{facts.blocks}" }}
"""


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
    flag_word = text.let(f"zext i1 {flag} to i32")
    # "convergent": else LLVM may copy the barrier into the sides of a branch, where threads of one
    # block would wait at different barriers.
    any_word = text.let(f'call i32 asm sideeffect "{_SOME}", "=r,r"(i32 {flag_word}) convergent')
    return text.let(f"icmp ne i32 {any_word}, 0")


def _is_long(body: Schedule) -> bool:
    return sum(1 for _ in liveness.nodes(body)) > LONG


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
        text = self._text
        before = text.block
        work, after = text.label(), text.label()
        text.line(f"br i1 {active}, label %{work}, label %{after}")
        text.start(work)
        # Until the loop's end: only some threads are in the branch, and a barrier in it would wait
        # for the others forever.
        self._together = False
        return before, after

    @contextlib.contextmanager
    def _going_through(self, body: Schedule) -> Iterator[None]:
        """Lets all threads enter a body at once if it is long, and is not within a short one."""
        before = self._together
        self._together = before and _is_long(body)
        yield
        self._together = before


def entry_source(text: Text, parameters: Sequence[str], written: scalarized.Scalarized) -> Source:
    """Returns the kernel of a body, with the bounds of its threads."""
    facts = _LONG if _is_long(written.schedule) else _SHORT
    kernel = text.function(f"ptx_kernel void @{ENTRY}({', '.join(parameters)}) #0")
    return Source("llvm", kernel + _ATTRIBUTES.format(facts=facts) + LOOP_FACTS, facts)


class _Leaf(NamedTuple):
    """An argument of a step: where it is, the dtype and the number of its entries."""

    pointer: str
    dtype: np.dtype
    size: int


def kernel_text(step: scalarized.Scalarized, num_actor: int) -> Source:
    """Returns the LLVM IR of ``@play``, without a target.

    Its arguments are pointers to: sizes [3] int32 (seeds S, episodes N, steps T), limits [S, N]
    int32 (of ``episode.signed_limits``), keys [S, N, 2] uint32, the leaves of the actor [S, ...]
    and of the state [S, N, ...] that are not empty; as many again as there are results, which it
    does not read; and the results, which are zero when it starts: observation [S, T, O, N], action
    [S, T, A, N], reward [S, T, N], length [S, N] int32, broken [S, N] int32, simulated [S] int32
    and next [1] int32, the item to be fetched next. Item k is episode k % N of seed k / N. A thread
    counts the steps that it waits for others in its block as simulated for the seed it played last,
    if there is one.

    Args:
      step: of ``program.step_function`` where an episode is running, written out.
      num_actor: how many leaves of its arguments are the actor's.
    """
    return _Kernel(step, num_actor).write()


class _Kernel:
    """Writes ``@play``."""

    def __init__(self, step: scalarized.Scalarized, num_actor: int):
        """Reserves a thread's memory; see ``kernel_text``."""
        self.text = Text(1)
        self.step = step
        avals = [(np.dtype(x.dtype), num_entries(x)) for x in step.in_avals]
        actor = avals[:num_actor]
        carried = avals[num_actor:]
        state = carried[: len(carried) - _NUM_OTHERS]
        # XLA passes no empty array: such a leaf has no parameter, and nothing reads it.
        self.parameters = {
            kind: [f"%{kind}{k}" for k, (_, size) in enumerate(leaves) if size]
            for kind, leaves in (("actor", actor), ("state", state))
        }
        self.actor = [
            _Leaf(f"%actor{k}" if size else "null", dtype, size)
            for k, (dtype, size) in enumerate(actor)
        ]
        # A thread keeps these from one step to the next, in its local memory.
        self.carried = [
            _Leaf(self.text.reserve(dtype, size), dtype, size) for dtype, size in carried
        ]
        self.state = self.carried[: len(state)]
        self.keys, self.at, self.mode = self.carried[len(state) :]
        self.row, self.limit, self.asks, self.waited, self.running = (
            self.text.reserve(_INT, 1) for _ in range(5)
        )

    def write(self) -> Source:
        """Returns the kernel."""
        text = self.text
        self.seeds, self.episodes, self.horizon = (
            text.load(text.at("%sizes", _INT, k), _INT) for k in range(3)
        )
        items = text.let(f"mul i32 {self.seeds}, {self.episodes}")
        text.store("0", self.waited, _INT)
        text.store("1", self.asks, _INT)
        # A thread without an episode goes through the same steps as others of its block: it has the
        # values of the first episode, so that it computes sound numbers that nothing keeps.
        self._begin("0", "0", "0", "0")
        head, body, end = text.label(), text.label(), text.label()
        text.line(f"br label %{head}")
        text.start(head)
        idle = text.let(f"icmp eq i32 {text.load(self.running, _INT)}, 0")
        with text.when(idle):
            self._fetch(items)
        # The block plays on while one of its threads has an episode: all meet in long loops.
        running = text.let(f"icmp ne i32 {text.load(self.running, _INT)}, 0")
        some = some_of_block(text, running)
        text.line(f"br i1 {some}, label %{body}, label %{end}")
        text.start(body)
        waited = text.let(f"add i32 {text.load(self.waited, _INT)}, 1")
        text.store(waited, self.waited, _INT)
        self._play(running)
        text.line(f"br label %{head}")
        text.start(end)
        played = text.let(f"icmp ne i32 {text.load(self.at.pointer, _INT)}, 0")
        with text.when(played):
            self._count_steps()
        text.line("ret void")
        leaves = self.parameters["actor"] + self.parameters["state"]
        parameters = [f"ptr noalias readonly %{name}" for name in CONTROLS]
        parameters += [f"ptr noalias readonly {leaf}" for leaf in leaves]
        # XLA passes the zeros that the results are written over as arguments, too.
        parameters += [f"ptr %zero.{name}" for name in RESULTS]
        parameters += [f"ptr %{name}" for name in RESULTS]
        return entry_source(text, parameters, self.step)

    def _fetch(self, items: str) -> None:
        """Writes how a thread takes the next episode that is played, if there is one."""
        text = self.text
        head, look, fill, end = (text.label() for _ in range(4))
        text.line(f"br label %{head}")
        text.start(head)
        # A thread that has found no more does not ask again.
        asks = text.let(f"icmp ne i32 {text.load(self.asks, _INT)}, 0")
        ask = text.label()
        text.line(f"br i1 {asks}, label %{ask}, label %{end}")
        text.start(ask)
        item = text.let("atomicrmw add ptr %next, i32 1 monotonic")
        some = text.let(f"icmp ult i32 {item}, {items}")
        none = text.label()
        text.line(f"br i1 {some}, label %{look}, label %{none}")
        text.start(none)
        text.store("0", self.asks, _INT)
        text.line(f"br label %{end}")
        text.start(look)
        signed = text.load(text.at("%limits", _INT, self._wide(item)), _INT)
        is_played = text.let(f"icmp ne i32 {signed}, {NOT_PLAYED}")
        text.line(f"br i1 {is_played}, label %{fill}, label %{head}")
        text.start(fill)
        is_mode = text.let(f"icmp slt i32 {signed}, 0")
        negated = text.let(f"sub i32 0, {signed}")
        limit = text.let(f"select i1 {is_mode}, i32 {negated}, i32 {signed}")
        self._begin(item, text.let(f"zext i1 {is_mode} to i32"), limit, "1")
        text.line(f"br label %{end}")
        text.start(end)

    def _begin(self, item: str, mode: str, limit: str, running: str) -> None:
        """Writes how a thread begins an episode of so many steps at most."""
        text = self.text
        place = self._wide(item)
        leaves = [leaf for leaf in self.state if leaf.size]
        for leaf, parameter in zip(leaves, self.parameters["state"], strict=True):
            _copy(text, parameter, place, leaf, leaf.size)
        _copy(text, "%keys", place, self.keys, 2)
        text.store(mode, self.mode.pointer, _INT)
        text.store("0", self.at.pointer, _INT)
        text.store(item, self.row, _INT)
        text.store(limit, self.limit, _INT)
        text.store(running, self.running, _INT)

    def _play(self, running: str) -> None:
        """Writes a step of the thread's episode, which counts if it is running, and its end."""
        text = self.text
        seed = text.let(f"udiv i32 {text.load(self.row, _INT)}, {self.episodes}")
        leaves = [self._row(leaf, seed) for leaf in self.actor]
        leaves += [Input(leaf.pointer, leaf.dtype) for leaf in self.carried]
        emit = Lockstep(text, leaves.__getitem__)
        values = emit.compile(self.step.schedule, self.step.outputs)
        *records, (goes_on,), (broken,) = values[:5]
        # All threads of the block computed the step; only those with an episode keep it.
        with text.when(running):
            self._keep(records, seed, values[5:])
            self._end(goes_on, broken)

    def _keep(self, records: list[list[Any]], seed: str, carried: list[list[Any]]) -> None:
        """Writes what a step leaves: records, and what the next step reads."""
        text = self.text
        self._record(records, seed)
        # A step returns the state and the keys; t and the mode, the last of ``carried``, stay.
        for values, leaf in zip(carried, self.carried, strict=False):
            for k, value in enumerate(values):
                text.store(value, text.at(leaf.pointer, leaf.dtype, k), leaf.dtype)

    def _end(self, goes_on: str, broken: str) -> None:
        """Writes the end of an episode, if it has come."""
        text = self.text
        steps = text.let(f"add i32 {text.load(self.at.pointer, _INT)}, 1")
        text.store(steps, self.at.pointer, _INT)
        late = text.let(f"icmp sge i32 {steps}, {text.load(self.limit, _INT)}")
        ends = text.let(f"icmp eq i32 {goes_on}, 0")
        with text.when(text.let(f"or i1 {late}, {ends}")):
            row = self._wide(text.load(self.row, _INT))
            text.store(steps, text.at("%length", _INT, row), _INT)
            text.store(broken, text.at("%broken", _INT, row), _INT)
            text.store("0", self.running, _INT)
            self._count_steps()

    def _row(self, leaf: _Leaf, seed: str) -> Input:
        """Returns a seed's row of a leaf of the actor."""
        first = self.text.let(f"mul i64 {self._wide(seed)}, {leaf.size}")
        align = math.gcd(_BUFFER_ALIGN, leaf.dtype.itemsize * leaf.size)
        return Input(self.text.at(leaf.pointer, leaf.dtype, first), leaf.dtype, align)

    def _record(self, records: list[list[Any]], seed: str) -> None:
        """Writes observation, action and reward."""
        text = self.text
        row = text.load(self.row, _INT)
        at = text.load(self.at.pointer, _INT)
        episode = self._wide(text.let(f"urem i32 {row}, {self.episodes}"))
        episodes = self._wide(self.episodes)
        before = text.let(f"mul i64 {self._wide(seed)}, {self._wide(self.horizon)}")
        before = text.let(f"add i64 {before}, {self._wide(at)}")
        # Episodes are the last axis: threads side by side write to places side by side.
        for values, name, aval in zip(records, RESULTS, self.step.out_avals, strict=False):
            first = text.let(f"mul i64 {before}, {len(values)}")
            for k, value in enumerate(values):
                index = text.let(f"add i64 {first}, {k}")
                index = text.let(f"mul i64 {index}, {episodes}")
                index = text.let(f"add i64 {index}, {episode}")
                text.store(value, text.at(f"%{name}", aval.dtype, index), aval.dtype)

    def _count_steps(self) -> None:
        """Writes the addition of the steps since the last one to those of the present seed."""
        text = self.text
        seed = text.let(f"udiv i32 {text.load(self.row, _INT)}, {self.episodes}")
        place = text.at("%simulated", _INT, self._wide(seed))
        text.let(f"atomicrmw add ptr {place}, i32 {text.load(self.waited, _INT)} monotonic")
        text.store("0", self.waited, _INT)

    def _wide(self, number: str) -> str:
        return self.text.let(f"zext i32 {number} to i64")


def _copy(text: Text, source: str, row: str, leaf: _Leaf, count: int) -> None:
    """Writes the copy of a row [count] of an array into a leaf of the thread's own."""
    start = text.at(source, leaf.dtype, text.let(f"mul i64 {row}, {count}"))
    for k in range(count):
        value = text.load(text.at(start, leaf.dtype, k), leaf.dtype)
        text.store(value, text.at(leaf.pointer, leaf.dtype, k), leaf.dtype)


def mapping_text(written: scalarized.Scalarized) -> Source:
    """Returns the LLVM IR of ``@play``, without a target.

    Its arguments are pointers to: sizes [2] int32 (examples N, threads in all), the leaves [N, ...]
    of the function's arguments that are not empty, and those of its result, likewise. Thread k
    computes the examples k, k + threads and so on.

    Args:
      written: the function.
    """
    text = Text(1)
    leaves = []
    for aval in written.in_avals:
        dtype = np.dtype(aval.dtype)
        size = num_entries(aval)
        leaves.append(_Leaf(text.reserve(dtype, size) if size else "null", dtype, size))
    arguments = [k for k, leaf in enumerate(leaves) if leaf.size]
    results = [k for k, aval in enumerate(written.out_avals) if num_entries(aval)]
    registers = [f"i32 @llvm.nvvm.read.ptx.sreg.{x}.x()" for x in ("tid", "ctaid", "ntid")]
    text.declared |= {f"declare {x}" for x in registers}
    in_block, block, threads = (text.let(f"call {x}") for x in registers)
    block_start = text.let(f"mul i32 {block}, {threads}")
    number = text.let(f"add i32 {block_start}, {in_block}")
    total, stride = (text.load(text.at("%sizes", _INT, k), _INT) for k in range(2))
    before = text.block
    head, body, end = (text.label() for _ in range(3))
    text.line(f"br label %{head}")
    text.start(head)
    item = text.hole()
    running = text.let(f"icmp ult i32 {item.name}, {total}")
    text.line(f"br i1 {some_of_block(text, running)}, label %{body}, label %{end}")
    text.start(body)
    # A thread without an example computes the first one beside the others, and keeps nothing of it.
    row = text.let(f"select i1 {running}, i32 {item.name}, i32 0")
    row = text.let(f"zext i32 {row} to i64")
    for k in arguments:
        _copy(text, f"%argument{k}", row, leaves[k], leaves[k].size)
    emit = Lockstep(text, lambda k: Input(leaves[k].pointer, leaves[k].dtype))
    values = emit.compile(written.schedule, written.outputs)
    with text.when(running):
        for k in results:
            aval = written.out_avals[k]
            start = text.let(f"mul i64 {row}, {num_entries(aval)}")
            pointer = text.at(f"%result{k}", aval.dtype, start)
            for entry, value in enumerate(values[k]):
                text.store(value, text.at(pointer, aval.dtype, entry), aval.dtype)
    following = text.let(f"add i32 {item.name}, {stride}")
    text.fill(item, f"phi i32 [{number}, %{before}], [{following}, %{text.block}]")
    text.line(f"br label %{head}")
    text.start(end)
    text.line("ret void")
    parameters = ["ptr noalias readonly %sizes"]
    parameters += [f"ptr noalias readonly %argument{k}" for k in arguments]
    parameters += [f"ptr %result{k}" for k in results]
    return entry_source(text, parameters, written)
