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
from mjx_reinforce.engine.gpu.source import Launch, Source
from mjx_reinforce.engine.llvm.emit import LLVM, Input, Value
from mjx_reinforce.engine.llvm.text import Text
from mjx_reinforce.engine.scalar import scalarized
from mjx_reinforce.engine.scalar.jaxprs import num_entries
from mjx_reinforce.engine.scalar.nodes import Node
from mjx_reinforce.engine.scalar.passes import liveness
from mjx_reinforce.engine.scalar.passes.liveness import LiveGate, LiveLoop, Schedule

_INT32 = np.dtype(np.int32)
#: The kernel's name. Its attributes are #0.
ENTRY = "play"
#: What a kernel reads before the actor and the state, by name; see ``kernel_text``.
CONTROLS = ("sizes", "limits", "keys")
#: What it writes.
RESULTS = ("observation", "action", "reward", "length", "broken", "simulated", "next")
#: The arguments of a step behind the actor and the state: keys, t, deterministic.
_NUM_OTHERS = 3
#: For programs that fit into a multiprocessor's instruction caches: a thread has 128 registers.
_SHORT_LAUNCH = Launch(threads=32, blocks=16)
#: For longer ones: a thread has 255 registers.
_LONG_LAUNCH = Launch(threads=256, blocks=1)
#: XLA's buffers begin at multiples of more bytes. A thread loads as many at once.
_BUFFER_ALIGN = 16
#: Denormals are zero, as in machine code for CPUs.
_ATTRIBUTES = """attributes #0 = {{ "denormal-fp-math-f32"="preserve-sign"
  "nvvm.maxntid"="{launch.threads}" "nvvm.minctasm"="{launch.blocks}" }}
"""


#: Gates and loops of more operations are entered by all threads of a block at once.
LONG_BODY = 3_000
#: The name of what LLVM is told of a loop: NVIDIA's assembler, which would write out the loop over
#: all contacts of a Humanoid, leaves it a loop.
LOOP_ID = "!0"
LOOP_METADATA = f"""{LOOP_ID} = distinct !{{{LOOP_ID}, !1}}
!1 = !{{!"llvm.loop.unroll.disable"}}
"""
#: The threads of a warp come together before they meet the others of their block: where they came
#: to a barrier one by one, an H200 waited forever.
_WARP_SYNC = "bar.warp.sync 0xffffffff;"
_BLOCK_SYNC = f"{_WARP_SYNC} bar.sync 0;"
_ANY = (
    f"{{{{ .reg .pred p, q; setp.ne.b32 p, $1, 0; {_WARP_SYNC} bar.red.or.pred q, 0, p; "
    "selp.b32 $0, 1, 0, q; }}"
)


def some_of_block(text: Text, flag: str) -> str:
    """Writes a meeting of all threads of a block; returns an i1: whether one has the flag set."""
    flag_word = text.let(f"zext i1 {flag} to i32")
    # "convergent": else LLVM may copy the barrier into the sides of a branch, where threads of one
    # block would wait at different barriers.
    any_word = text.let(f'call i32 asm sideeffect "{_ANY}", "=r,r"(i32 {flag_word}) convergent')
    return text.let(f"icmp ne i32 {any_word}, 0")


def _is_long(body: Schedule) -> bool:
    return sum(1 for _ in liveness.nodes(body)) > LONG_BODY


class Lockstep(LLVM):
    """Writes LLVM IR for one of the threads of a block, all of which run what it writes."""

    LOOP_HINT = f", !llvm.loop {LOOP_ID}"
    _is_lockstep = True

    def some(self, mask: str) -> str:
        """Returns an i1: whether a thread goes on, or where all do, whether one must."""
        return some_of_block(self._text, mask) if self._is_lockstep else mask

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
        if self._is_lockstep and active is None:
            self._text.line(f'call void asm sideeffect "{_BLOCK_SYNC}", ""() convergent')
        return super().goes_on(loop, count, active)

    def may_skip(self, active: str | None) -> tuple[str, str] | None:
        """Writes the branch of threads that only wait for others in a loop."""
        if not self._is_lockstep or active is None:
            return None
        text = self._text
        entry_block = text.block
        work_label, end_label = text.label(), text.label()
        text.line(f"br i1 {active}, label %{work_label}, label %{end_label}")
        text.start(work_label)
        # Until the loop's end: only some threads are in the branch, and a barrier in it would wait
        # for the others forever.
        self._is_lockstep = False
        return entry_block, end_label

    @contextlib.contextmanager
    def _going_through(self, body: Schedule) -> Iterator[None]:
        """Lets all threads enter a body at once if it is long, and is not within a short one."""
        is_lockstep = self._is_lockstep
        self._is_lockstep = is_lockstep and _is_long(body)
        yield
        self._is_lockstep = is_lockstep


def entry_source(text: Text, parameters: Sequence[str], program: scalarized.Scalarized) -> Source:
    """Returns the kernel of a body, with the bounds of its threads."""
    launch = _LONG_LAUNCH if _is_long(program.schedule) else _SHORT_LAUNCH
    kernel = text.function(f"ptx_kernel void @{ENTRY}({', '.join(parameters)}) #0")
    return Source("llvm", kernel + _ATTRIBUTES.format(launch=launch) + LOOP_METADATA, launch)


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
        carry_avals = avals[num_actor:]
        state = carry_avals[: len(carry_avals) - _NUM_OTHERS]
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
            _Leaf(self.text.reserve(dtype, size), dtype, size) for dtype, size in carry_avals
        ]
        self.state = self.carried[: len(state)]
        self.keys, self.at, self.mode = self.carried[len(state) :]
        self.row, self.limit, self.asks, self.waited, self.running = (
            self.text.reserve(_INT32, 1) for _ in range(5)
        )

    def write(self) -> Source:
        """Returns the kernel."""
        text = self.text
        self.seeds, self.episodes, self.horizon = (
            text.load(text.at("%sizes", _INT32, k), _INT32) for k in range(3)
        )
        num_items = text.let(f"mul i32 {self.seeds}, {self.episodes}")
        text.store("0", self.waited, _INT32)
        text.store("1", self.asks, _INT32)
        # A thread without an episode goes through the same steps as others of its block: it has the
        # values of the first episode, so that it computes sound numbers that nothing keeps.
        self._begin("0", "0", "0", "0")
        head, body, end = text.label(), text.label(), text.label()
        text.line(f"br label %{head}")
        text.start(head)
        is_idle = text.let(f"icmp eq i32 {text.load(self.running, _INT32)}, 0")
        with text.when(is_idle):
            self._fetch(num_items)
        # The block plays on while one of its threads has an episode: all meet in long loops.
        is_running = text.let(f"icmp ne i32 {text.load(self.running, _INT32)}, 0")
        has_running = some_of_block(text, is_running)
        text.line(f"br i1 {has_running}, label %{body}, label %{end}")
        text.start(body)
        num_waits = text.let(f"add i32 {text.load(self.waited, _INT32)}, 1")
        text.store(num_waits, self.waited, _INT32)
        self._play(is_running)
        text.line(f"br label %{head}")
        text.start(end)
        has_steps = text.let(f"icmp ne i32 {text.load(self.at.pointer, _INT32)}, 0")
        with text.when(has_steps):
            self._count_steps()
        text.line("ret void")
        leaves = self.parameters["actor"] + self.parameters["state"]
        parameters = [f"ptr noalias readonly %{name}" for name in CONTROLS]
        parameters += [f"ptr noalias readonly {leaf}" for leaf in leaves]
        # XLA passes the zeros that the results are written over as arguments, too.
        parameters += [f"ptr %zero.{name}" for name in RESULTS]
        parameters += [f"ptr %{name}" for name in RESULTS]
        return entry_source(text, parameters, self.step)

    def _fetch(self, num_items: str) -> None:
        """Writes how a thread takes the next episode that is played, if there is one."""
        text = self.text
        head, poll, fill, end = (text.label() for _ in range(4))
        text.line(f"br label %{head}")
        text.start(head)
        # A thread that has found no more does not ask again.
        is_asking = text.let(f"icmp ne i32 {text.load(self.asks, _INT32)}, 0")
        ask = text.label()
        text.line(f"br i1 {is_asking}, label %{ask}, label %{end}")
        text.start(ask)
        item_index = text.let("atomicrmw add ptr %next, i32 1 monotonic")
        has_item = text.let(f"icmp ult i32 {item_index}, {num_items}")
        empty = text.label()
        text.line(f"br i1 {has_item}, label %{poll}, label %{empty}")
        text.start(empty)
        text.store("0", self.asks, _INT32)
        text.line(f"br label %{end}")
        text.start(poll)
        signed = text.load(text.at("%limits", _INT32, self._wide(item_index)), _INT32)
        is_played = text.let(f"icmp ne i32 {signed}, {NOT_PLAYED}")
        text.line(f"br i1 {is_played}, label %{fill}, label %{head}")
        text.start(fill)
        is_mode = text.let(f"icmp slt i32 {signed}, 0")
        negative = text.let(f"sub i32 0, {signed}")
        limit = text.let(f"select i1 {is_mode}, i32 {negative}, i32 {signed}")
        self._begin(item_index, text.let(f"zext i1 {is_mode} to i32"), limit, "1")
        text.line(f"br label %{end}")
        text.start(end)

    def _begin(self, item_index: str, mode: str, limit: str, is_running: str) -> None:
        """Writes how a thread begins an episode of so many steps at most."""
        text = self.text
        place = self._wide(item_index)
        leaves = [leaf for leaf in self.state if leaf.size]
        for leaf, parameter in zip(leaves, self.parameters["state"], strict=True):
            _copy(text, parameter, place, leaf, leaf.size)
        _copy(text, "%keys", place, self.keys, 2)
        text.store(mode, self.mode.pointer, _INT32)
        text.store("0", self.at.pointer, _INT32)
        text.store(item_index, self.row, _INT32)
        text.store(limit, self.limit, _INT32)
        text.store(is_running, self.running, _INT32)

    def _play(self, is_running: str) -> None:
        """Writes a step of the thread's episode, which counts if it is running, and its end."""
        text = self.text
        seed = text.let(f"udiv i32 {text.load(self.row, _INT32)}, {self.episodes}")
        leaves = [self._row(leaf, seed) for leaf in self.actor]
        leaves += [Input(leaf.pointer, leaf.dtype) for leaf in self.carried]
        emit = Lockstep(text, leaves.__getitem__)
        values = emit.compile(self.step.schedule, self.step.outputs)
        *records, (is_alive,), (is_broken,) = values[:5]
        # All threads of the block computed the step; only those with an episode keep it.
        with text.when(is_running):
            self._keep(records, seed, values[5:])
            self._end(is_alive, is_broken)

    def _keep(self, records: list[list[Any]], seed: str, carries: list[list[Any]]) -> None:
        """Writes what a step leaves: records, and what the next step reads."""
        text = self.text
        self._record(records, seed)
        # A step returns the state and the keys; t and the mode, the last of ``carries``, stay.
        for values, leaf in zip(carries, self.carried, strict=False):
            for k, value in enumerate(values):
                text.store(value, text.at(leaf.pointer, leaf.dtype, k), leaf.dtype)

    def _end(self, is_alive: str, is_broken: str) -> None:
        """Writes the end of an episode, if it has come."""
        text = self.text
        steps = text.let(f"add i32 {text.load(self.at.pointer, _INT32)}, 1")
        text.store(steps, self.at.pointer, _INT32)
        is_late = text.let(f"icmp sge i32 {steps}, {text.load(self.limit, _INT32)}")
        is_end = text.let(f"icmp eq i32 {is_alive}, 0")
        with text.when(text.let(f"or i1 {is_late}, {is_end}")):
            row = self._wide(text.load(self.row, _INT32))
            text.store(steps, text.at("%length", _INT32, row), _INT32)
            text.store(is_broken, text.at("%broken", _INT32, row), _INT32)
            text.store("0", self.running, _INT32)
            self._count_steps()

    def _row(self, leaf: _Leaf, seed: str) -> Input:
        """Returns a seed's row of a leaf of the actor."""
        row_start = self.text.let(f"mul i64 {self._wide(seed)}, {leaf.size}")
        align = math.gcd(_BUFFER_ALIGN, leaf.dtype.itemsize * leaf.size)
        return Input(self.text.at(leaf.pointer, leaf.dtype, row_start), leaf.dtype, align)

    def _record(self, records: list[list[Any]], seed: str) -> None:
        """Writes observation, action and reward."""
        text = self.text
        row = text.load(self.row, _INT32)
        step_index = text.load(self.at.pointer, _INT32)
        episode = self._wide(text.let(f"urem i32 {row}, {self.episodes}"))
        episodes = self._wide(self.episodes)
        seed_start = text.let(f"mul i64 {self._wide(seed)}, {self._wide(self.horizon)}")
        seed_start = text.let(f"add i64 {seed_start}, {self._wide(step_index)}")
        # Episodes are the last axis: threads side by side write to places side by side.
        for values, name, aval in zip(records, RESULTS, self.step.out_avals, strict=False):
            record_start = text.let(f"mul i64 {seed_start}, {len(values)}")
            for k, value in enumerate(values):
                index = text.let(f"add i64 {record_start}, {k}")
                index = text.let(f"mul i64 {index}, {episodes}")
                index = text.let(f"add i64 {index}, {episode}")
                text.store(value, text.at(f"%{name}", aval.dtype, index), aval.dtype)

    def _count_steps(self) -> None:
        """Writes the addition of the steps since the last one to those of the present seed."""
        text = self.text
        seed = text.let(f"udiv i32 {text.load(self.row, _INT32)}, {self.episodes}")
        place = text.at("%simulated", _INT32, self._wide(seed))
        text.let(f"atomicrmw add ptr {place}, i32 {text.load(self.waited, _INT32)} monotonic")
        text.store("0", self.waited, _INT32)

    def _wide(self, number: str) -> str:
        return self.text.let(f"zext i32 {number} to i64")


def _copy(text: Text, source: str, row: str, leaf: _Leaf, count: int) -> None:
    """Writes the copy of a row [count] of an array into a leaf of the thread's own."""
    start = text.at(source, leaf.dtype, text.let(f"mul i64 {row}, {count}"))
    for k in range(count):
        value = text.load(text.at(start, leaf.dtype, k), leaf.dtype)
        text.store(value, text.at(leaf.pointer, leaf.dtype, k), leaf.dtype)


def mapping_text(program: scalarized.Scalarized) -> Source:
    """Returns the LLVM IR of ``@play``, without a target.

    Its arguments are pointers to: sizes [2] int32 (examples N, threads in all), the leaves [N, ...]
    of the function's arguments that are not empty, and those of its result, likewise. Thread k
    computes the examples k, k + threads and so on.

    Args:
      program: the function.
    """
    text = Text(1)
    leaves = []
    for aval in program.in_avals:
        dtype = np.dtype(aval.dtype)
        size = num_entries(aval)
        leaves.append(_Leaf(text.reserve(dtype, size) if size else "null", dtype, size))
    arguments = [k for k, leaf in enumerate(leaves) if leaf.size]
    result_indices = [k for k, aval in enumerate(program.out_avals) if num_entries(aval)]
    registers = [f"i32 @llvm.nvvm.read.ptx.sreg.{x}.x()" for x in ("tid", "ctaid", "ntid")]
    text.declared |= {f"declare {x}" for x in registers}
    thread, block, threads = (text.let(f"call {x}") for x in registers)
    block_start = text.let(f"mul i32 {block}, {threads}")
    item_start = text.let(f"add i32 {block_start}, {thread}")
    num_items, stride = (text.load(text.at("%sizes", _INT32, k), _INT32) for k in range(2))
    entry_block = text.block
    head, body, end = (text.label() for _ in range(3))
    text.line(f"br label %{head}")
    text.start(head)
    item_index = text.hole()
    is_running = text.let(f"icmp ult i32 {item_index.name}, {num_items}")
    text.line(f"br i1 {some_of_block(text, is_running)}, label %{body}, label %{end}")
    text.start(body)
    # A thread without an example computes the first one beside the others, and keeps nothing of it.
    row = text.let(f"select i1 {is_running}, i32 {item_index.name}, i32 0")
    row = text.let(f"zext i32 {row} to i64")
    for k in arguments:
        _copy(text, f"%argument{k}", row, leaves[k], leaves[k].size)
    emit = Lockstep(text, lambda k: Input(leaves[k].pointer, leaves[k].dtype))
    values = emit.compile(program.schedule, program.outputs)
    with text.when(is_running):
        for k in result_indices:
            aval = program.out_avals[k]
            start = text.let(f"mul i64 {row}, {num_entries(aval)}")
            pointer = text.at(f"%result{k}", aval.dtype, start)
            for index, value in enumerate(values[k]):
                text.store(value, text.at(pointer, aval.dtype, index), aval.dtype)
    following = text.let(f"add i32 {item_index.name}, {stride}")
    text.fill(item_index, f"phi i32 [{item_start}, %{entry_block}], [{following}, %{text.block}]")
    text.line(f"br label %{head}")
    text.start(end)
    text.line("ret void")
    parameters = ["ptr noalias readonly %sizes"]
    parameters += [f"ptr noalias readonly %argument{k}" for k in arguments]
    parameters += [f"ptr %result{k}" for k in result_indices]
    return entry_source(text, parameters, program)
