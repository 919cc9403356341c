"""The kernels in which every thread plays one episode after the other, or maps a function."""

import math
from collections.abc import Iterable
from pathlib import Path

from mjx_reinforce.engine.gpu import loops
from mjx_reinforce.engine.gpu.loops import Leaf, StepArguments
from mjx_reinforce.engine.gpu.source import Launch, Source
from mjx_reinforce.engine.gpu.thread_text import ThreadText, is_long
from mjx_reinforce.engine.scalar import scalarized

#: For programs that fit into a multiprocessor's instruction caches: a thread has 128 registers.
_SHORT_LAUNCH = Launch(threads=32, blocks=16)
#: For longer ones: a thread has 255 registers.
_LONG_LAUNCH = Launch(threads=256, blocks=1)
#: XLA's buffers begin at multiples of more bytes. A thread loads as many at once.
_BUFFER_ALIGN = 16
_GPU = Path(__file__).parent
_DEVICE = _GPU.parent / "team" / "device"
_HEADERS = (_DEVICE / "lanes.h", _DEVICE / "scalar.h", _GPU / "thread.h")


def player_text(program: scalarized.Scalarized, num_actor: int) -> Source:
    """Returns the C++ of a kernel that plays; its arguments are those of ``loops.play_loop``.

    A thread counts the steps that it waits for others in its block as simulated for the seed it
    played last, if there is one.

    Args:
      program: of ``program.step_function`` where an episode is running, written out.
      num_actor: how many leaves of its arguments are the actor's.
    """
    arguments = loops.step_arguments(program, num_actor)
    rows = {f"in{k}": leaf for k, leaf in enumerate(arguments.leaves[:num_actor]) if leaf.size}
    groups = {name: _group_size(leaf) for name, leaf in rows.items()}
    pointers = []
    for name, leaf in rows.items():
        kind = f"const Group<{leaf.type}, {groups[name]}>*"
        row = f"actor{name.removeprefix('in')} + size_t(seed) * {leaf.size}"
        pointers.append(f"{kind} {name} = reinterpret_cast<{kind}>({row});")
    text = ThreadText(arguments.name, groups)
    values = text.compile(program.schedule, program.outputs)
    *records, (is_alive,), (is_broken,) = values[:5]
    text.line(f"const bool alive = {is_alive} != 0;")
    text.line(f"const int is_broken = {is_broken};")
    record = [
        f"{field}[(row * {len(entries)} + {i}) * episodes + column] = {x};"
        for field, entries in zip(loops.RESULTS, records, strict=False)
        for i, x in enumerate(entries)
    ]
    worker = loops.Worker(
        room=[*_room(arguments), "int waited = 0;"],
        begin=_begin(arguments),
        met="waited++;",
        step=[*pointers, *text.lines],
        record=[*record, *_carry_on(arguments, values[5:])],
        steps="taken(waited)",
        end="  if (at != 0) t.add(simulated + item / episodes, waited);\n",
    )
    return _source(program, loops.play_loop(program, num_actor, worker))


def mapping_text(program: scalarized.Scalarized) -> Source:
    """Returns the C++ of a kernel that maps; its arguments are those of ``loops.map_loop``."""
    text = ThreadText(lambda number: f"in{number}", {})
    values = text.compile(program.schedule, program.outputs)
    kinds = [leaf.type for leaf in loops.leaves(program.out_avals)]
    stores = []
    # All is read before any of it is written over.
    for number, entries in enumerate(values):
        for i, x in enumerate(entries):
            text.line(f"const {kinds[number]} next{number}_{i} = {x};")
            stores.append(f"out{number}[{i}] = next{number}_{i};")
    # Where the results are the arguments, a thread without an example leaves them to its owner.
    text.lines += ["if (item < sizes[0]) {", *stores, "}"]
    return _source(program, loops.map_loop(program, text.lines))


def _group_size(leaf: Leaf) -> int:
    """Returns how many entries of a leaf a thread loads at once, in every row of it."""
    return math.gcd(_BUFFER_ALIGN, leaf.itemsize * leaf.size) // leaf.itemsize


def _room(arguments: StepArguments) -> list[str]:
    """Returns the arrays in which a thread keeps an episode, from one step to the next."""
    sized_leaves = [(k, arguments.leaves[k]) for k in arguments.carried if arguments.leaves[k].size]
    return [f"{leaf.type} in{k}[{leaf.size}];" for k, leaf in sized_leaves]


def _begin(arguments: StepArguments) -> list[str]:
    """Returns how a thread begins episode k."""
    lines = []
    for number in arguments.carried:
        array, size = arguments.start(number)
        lines += [f"in{number}[{i}] = {array}[size_t(k) * {size} + {i}];" for i in range(size)]
    return lines


def _carry_on(arguments: StepArguments, values: Iterable[list[str]]) -> list[str]:
    """Returns how a thread keeps what the next step reads."""
    copies = []
    stores = []
    # All is read before any of it changes.
    for number, entries in zip(arguments.carried, values, strict=True):
        for i, x in enumerate(entries):
            if x != (place := f"in{number}[{i}]"):
                copies.append(f"const {arguments.leaves[number].type} next{number}_{i} = {x};")
                stores.append(f"{place} = next{number}_{i};")
    return copies + stores


def _source(program: scalarized.Scalarized, loop: str) -> Source:
    """Returns the kernel of a loop, with the bounds of its threads."""
    launch = _LONG_LAUNCH if is_long(program.schedule) else _SHORT_LAUNCH
    headers = [path.read_text("utf-8").replace("#pragma once", "") for path in _HEADERS]
    return Source("\n".join([f"#define BLOCKS {launch.blocks}", *headers, loop]), launch)
