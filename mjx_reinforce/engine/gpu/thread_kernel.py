"""The kernel of ``gpu.kernel.kernel_text`` as CUDA C++: a thread plays one episode after the other.

An experiment: the same program as LLVM IR, statement by statement.
"""

import contextlib
import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mjx_reinforce.engine.gpu.kernel import (
    _BUFFER_ALIGN,
    _LONG_LAUNCH,
    _NUM_OTHERS,
    _SHORT_LAUNCH,
    CONTROLS,
    RESULTS,
    _is_long,
)
from mjx_reinforce.engine.gpu.source import Source
from mjx_reinforce.engine.scalar import scalarized
from mjx_reinforce.engine.scalar.backend import Backend
from mjx_reinforce.engine.scalar.nodes import Node, Scalar, is_constant
from mjx_reinforce.engine.scalar.passes import liveness
from mjx_reinforce.engine.scalar.passes.liveness import LiveGate, LiveLoop, Schedule
from mjx_reinforce.engine.team.operations import expression, literal, type_of
from mjx_reinforce.engine.team.text import _qualifier

_DEVICE = Path(__file__).parent.parent / "team" / "device"
_HEAD = """
template <class T, int N> struct alignas(N * sizeof(T)) Group {{ T x[N]; }};
#ifdef __CUDACC__
#define KERNEL __global__ void __launch_bounds__({threads}, {blocks})
// All threads of a block meet; whether one of them has the flag set.
DEV bool some_of_block(bool flag) {{
  int some;
  asm volatile("{{ .reg .pred p, q; setp.ne.b32 p, %1, 0; bar.warp.sync 0xffffffff;"
               " bar.red.or.pred q, 0, p; selp.b32 %0, 1, 0, q; }}" : "=r"(some) : "r"(int(flag)));
  return some;
}}
DEV bool meet_then(bool flag) {{
  asm volatile("bar.warp.sync 0xffffffff; bar.sync 0;");
  return flag;
}}
#else
#define KERNEL void
inline bool some_of_block(bool flag) {{ return flag; }}
inline bool meet_then(bool flag) {{ return flag; }}
inline int atomicAdd(int* sum, int x) {{ const int before = *sum; *sum += x; return before; }}
#endif
"""
_PLAY = """
extern "C" KERNEL play({parameters}) {{
  const int seeds = sizes[0], episodes = sizes[1], horizon = sizes[2], items = seeds * episodes;
  int waited = 0, item = 0, limit = 0;
  bool asks = true, running = false;
{carried}
  auto begin = [&](int k, int steps, bool is_running) {{
{begin}
    at[0] = 0; mode[0] = steps < 0; limit = steps < 0 ? -steps : steps;
    item = k; running = is_running;
  }};
  begin(0, 0, false);
  LOOP while (true) {{
    if (!running) {{
      LOOP while (asks) {{
        const int k = atomicAdd(next, 1);
        if (k >= items) {{ asks = false; break; }}
        if (limits[k] == 0) continue;
        begin(k, limits[k], true);
        break;
      }}
    }}
    if (!some_of_block(running)) break;
    waited++;
    const int seed = item / episodes;
{step}
    if (running) {{
      const size_t row = size_t(seed) * horizon + at[0], column = item % episodes;
{record}
      at[0]++;
      if (at[0] >= limit || {alive} == 0) {{
        length[item] = at[0]; broken[item] = {broken}; running = false;
        atomicAdd(simulated + seed, waited); waited = 0;
      }}
    }}
  }}
  if (at[0] != 0) atomicAdd(simulated + item / episodes, waited);
}}
"""


class ThreadText(Backend[str]):
    """Writes C++ for a thread; a value is a variable, an entry of an array or a literal."""

    def __init__(self, inputs: Sequence[str], groups: dict[str, int]):
        """Says which arrays the inputs are, and of which so many entries are in a ``Group``."""
        self._groups = groups
        self.lines: list[str] = []
        self._inputs = inputs
        self._count = 0
        self._is_lockstep = True
        self._recorded: dict[Scalar, tuple[str, int]] = {}

    def name(self) -> str:
        """Returns a new name."""
        self._count += 1
        return f"v{self._count}"

    def constant(self, number: Any) -> str:
        """A literal."""
        return literal(number)

    def leaf(self, node: Node) -> str:
        """An entry of an input."""
        number, k = node.position
        return self._entry(self._inputs[number], k)

    def _entry(self, array: str, k: int, stride: int = 0, count: str = "") -> str:
        """Returns entry ``k + stride * count``; neighbors of one group are loaded together."""
        group = self._groups.get(array, 1)
        if stride % group:
            return f"{array}->x[{k} + {stride} * {count}]"
        index = f"{k // group} + {stride // group} * {count}" if stride else f"{k // group}"
        return f"{array}[{index}]" + (f".x[{k % group}]" if array in self._groups else "")

    def node(self, node: Node, operands: list[str]) -> str:
        """Writes one operation."""
        assert node.op is not None
        name = self.name()
        formula = expression(node.op, node.dtype, [x.dtype for x in node.args], operands)
        self.lines.append(f"const {type_of(node.dtype)} {name} = {formula};")
        return name

    def gate(self, gate: LiveGate, values: dict[Node, str]) -> Sequence[str]:
        """Writes a branch; a long one is taken by all threads if one needs it."""
        names = [self.name() for _ in gate.outs]
        for name, out in zip(names, gate.outs, strict=True):
            self.lines.append(f"{type_of(out.leaf.dtype)} {name} = {self.value(out.cold, values)};")
        predicate = self.value(gate.predicate, values)
        with self._through(gate.body):
            self.lines.append(f"if ({self._some(predicate)}) {{")
            scope = self.inside(gate.body, values)
            for name, out in zip(names, gate.outs, strict=True):
                self.lines.append(f"{name} = {self.value(out.hot, scope)};")
            self.lines.append("}")
        return names

    def loop(self, loop: LiveLoop, values: dict[Node, str]) -> Sequence[str]:
        """Writes a loop; a long one goes on for all threads until none needs it."""
        carries = [self.name() for _ in loop.carries]
        for name, carry in zip(carries, loop.carries, strict=True):
            self.lines.append(
                f"{type_of(carry.leaf.dtype)} {name} = {self.value(carry.init, values)};"
            )
        rows = [self._row(e.values, values) for e in loop.elements]
        arrays = [self.name() for _ in loop.records]
        for name, record in zip(arrays, loop.records, strict=True):
            self.lines.append(f"{type_of(record.value.dtype)} {name}[{loop.length}];")
        count = self.name()
        leaves = dict(zip((carry.leaf for carry in loop.carries), carries, strict=True))
        active = None if loop.active is None else carries[loop.active]
        with self._through(loop.body):
            conditions = [] if loop.length is None else [f"{count} < {loop.length}"]
            if active is not None:
                conditions.append(self._some(active))
            condition = " & ".join(conditions)
            if self._is_lockstep and active is None:
                condition = f"meet_then({condition})"
            has_iteration = bool(loop.length) and active is None
            head = "do {" if has_iteration else f"while ({condition}) {{"
            self.lines += [f"int {count} = 0;", f"LOOP {head}"]
            skips = self._is_lockstep and active is not None
            if skips:
                self.lines.append(f"if ({active}) {{")
                self._is_lockstep = False
            for element, row in zip(loop.elements, rows, strict=True):
                leaves[element.leaf] = row(count)
            scope = self.inside(loop.body, values, leaves)
            for name, record in zip(arrays, loop.records, strict=True):
                self.lines.append(f"{name}[{count}] = {self.value(record.value, scope)};")
            nexts = [self.value(carry.next, scope) for carry in loop.carries]
            # What is carried to another carry is kept before any of them changes.
            for k, (carry, following) in enumerate(zip(loop.carries, nexts, strict=True)):
                if following in carries and following != carries[k]:
                    nexts[k] = self.name()
                    self.lines.append(
                        f"const {type_of(carry.leaf.dtype)} {nexts[k]} = {following};"
                    )
            for name, following in zip(carries, nexts, strict=True):
                if following != name:
                    self.lines.append(f"{name} = {following};")
            if skips:
                self.lines.append("}")
            self.lines.append(f"{count}++;")
            self.lines.append(f"}} while ({condition});" if has_iteration else "}")
        places = list(carries)
        for name, record in zip(arrays, loop.records, strict=True):
            for k, out in enumerate(record.outs):
                self._recorded[out] = (name, k)
                places.append(f"{name}[{k}]")
        return places

    def _some(self, flag: str) -> str:
        return f"some_of_block({flag})" if self._is_lockstep else flag

    @contextlib.contextmanager
    def _through(self, body: Schedule) -> Iterator[None]:
        """Lets all threads enter a body at once if it is long, and is not within a short one."""
        is_lockstep = self._is_lockstep
        self._is_lockstep = is_lockstep and _is_long(body)
        yield
        self._is_lockstep = is_lockstep

    def _row(self, row: list[Scalar], values: dict[Node, str]) -> Callable[[str], str]:
        """Returns what an element of a loop is in the iteration of a number."""
        spacing = liveness.evenly_spaced([self._place(x) for x in row])
        if spacing:
            array, start, stride = spacing
            return lambda count: self._entry(array, start, stride, count)
        name = self.name()
        entries = ", ".join(self.value(x, values) for x in row)
        self.lines.append(f"{_qualifier(row)} {type_of(row[0].dtype)} {name}[] = {{{entries}}};")
        return lambda count: f"{name}[{count}]"

    def _place(self, x: Scalar) -> tuple[str, int] | None:
        """Returns the array that a scalar is an entry of, and which; None for one in none."""
        if is_constant(x):
            return None
        if x.op is None and x.owner is None:
            return self._inputs[x.position[0]], x.position[1]
        return self._recorded.get(x)


def kernel_text(step: scalarized.Scalarized, num_actor: int) -> Source:
    """Returns what ``gpu.kernel.kernel_text`` does, as CUDA C++."""
    launch = _LONG_LAUNCH if _is_long(step.schedule) else _SHORT_LAUNCH
    leaves = [(type_of(x.dtype), math.prod(x.shape), np.dtype(x.dtype)) for x in step.in_avals]
    keys = len(leaves) - _NUM_OTHERS
    inputs = [f"in{k}" for k in range(keys + 1)] + ["at", "mode"]
    carried = []
    begin = []
    pointers = []
    groups = {}
    parameters = [("int", "sizes"), ("int", "limits"), ("unsigned", "keys")]
    assert tuple(name for _, name in parameters) == CONTROLS
    for number, (kind, size, dtype) in enumerate(leaves):
        name = inputs[number]
        if number >= num_actor:
            carried.append(f"{kind} {name}[{max(size, 1)}];")
        if not size or number > keys:
            continue
        if number < num_actor:
            align = math.gcd(_BUFFER_ALIGN, dtype.itemsize * size)
            group = align // dtype.itemsize
            groups[name] = group
            row = f"actor{number} + size_t(seed) * {size}"
            group_type = f"const Group<{kind}, {group}>*"
            pointers.append(f"{group_type} {name} = reinterpret_cast<{group_type}>({row});")
            parameters.append((kind, f"actor{number}"))
        else:
            source = f"state{number - num_actor}"
            count = size
            if number < keys:
                parameters.append((kind, source))
            else:
                source = "keys"
                count = 2
            begin += [f"{name}[{i}] = {source}[size_t(k) * {count} + {i}];" for i in range(count)]
    text = ThreadText(inputs, groups)
    values = text.compile(step.schedule, step.outputs)
    *records, (alive,), (broken,) = values[:5]
    kinds = [type_of(x.dtype) for x in step.out_avals[:3]]
    record = [
        f"{field}[(row * {len(xs)} + {i}) * episodes + column] = {x};"
        for field, xs in zip(RESULTS, records, strict=False)
        for i, x in enumerate(xs)
    ]
    # All that is carried is read before any of it changes.
    copies = []
    for name, xs, (kind, _, _) in zip(
        inputs[num_actor:], values[5:], leaves[num_actor:], strict=False
    ):
        for i, x in enumerate(xs):
            if x != f"{name}[{i}]":
                record.append(f"const {kind} next_{name}_{i} = {x};")
                copies.append(f"{name}[{i}] = next_{name}_{i};")
    results = [*zip([*kinds, *["int"] * 4], RESULTS, strict=True)]
    parameters += [(kind, f"zero_{name}") for kind, name in results]
    arguments = [f"const {kind}* __restrict__ {name}" for kind, name in parameters]
    arguments += [f"{kind}* {name}" for kind, name in results]
    play = _PLAY.format(
        parameters=", ".join(arguments),
        carried="\n".join(carried),
        begin="\n".join(begin),
        step="\n".join([*pointers, *text.lines]),
        record="\n".join([*record, *copies]),
        alive=alive,
        broken=broken,
    )
    lanes, scalar = ((_DEVICE / name).read_text("utf-8") for name in ("lanes.h", "scalar.h"))
    head = _HEAD.format(threads=launch.threads, blocks=launch.blocks)
    size_type = "typedef decltype(sizeof(0)) size_t;\n"
    body = "\n".join([size_type, lanes, scalar, head, play]).replace("#pragma once", "")
    return Source("cuda", body, launch)
