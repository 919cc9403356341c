"""The kernel that every thread of a GPU runs to map a function: an example at a time."""

import math

import numpy as np

from mjx_reinforce.engine.gpu.kernel import entry_text
from mjx_reinforce.engine.gpu.lockstep import Lockstep, ScratchText, some_of_block
from mjx_reinforce.engine.llvm.emit import Input
from mjx_reinforce.engine.scalar import jaxprs, scalarized

_INT = np.dtype(np.int32)


def mapping_text(written: scalarized.Scalarized) -> str:
    """Returns the LLVM IR of ``@play``, without a target.

    Its arguments are pointers to: sizes [2] int32 (examples N, threads in all), the leaves [N, ...]
    of the function's arguments that are not empty; as many again as there are results, which it
    does not read; and the results, the leaves of the function's result that are not empty; and, if
    there are long arrays, the buffer of ``ScratchText``. Thread k computes the examples k,
    k + threads and so on.

    Args:
      written: the function.
    """
    text = ScratchText()
    given = [k for k, leaf in enumerate(written.in_avals) if _size(leaf)]
    made = [k for k, leaf in enumerate(written.out_avals) if _size(leaf)]
    own = [text.reserve(x.dtype, _size(x)) if _size(x) else "null" for x in written.in_avals]
    in_block, block, threads = (text.let(text.asked(x)) for x in ("tid", "ctaid", "ntid"))
    number = text.let(f"add i32 {text.let(f'mul i32 {block}, {threads}')}, {in_block}")
    total, stride = (text.load(text.at("%sizes", _INT, k), _INT) for k in range(2))
    before, head, body, end = text.block, text.label(), text.label(), text.label()
    text.line(f"br label %{head}")
    text.start(head)
    item = text.hole()
    running = text.let(f"icmp ult i32 {item.name}, {total}")
    text.line(f"br i1 {some_of_block(text, running)}, label %{body}, label %{end}")
    text.start(body)
    row = text.let(f"select i1 {running}, i32 {item.name}, i32 0")  # waits with another's numbers
    row = text.let(f"zext i32 {row} to i64")
    for k in given:
        leaf = written.in_avals[k]
        start = text.at(f"%given{k}", leaf.dtype, text.let(f"mul i64 {row}, {_size(leaf)}"))
        for entry in range(_size(leaf)):
            value = text.load(text.at(start, leaf.dtype, entry), leaf.dtype)
            text.store(value, text.at(own[k], leaf.dtype, entry), leaf.dtype)
    emit = Lockstep(text, lambda k: Input(own[k], np.dtype(written.in_avals[k].dtype)))
    results = emit.compile(written.schedule, written.outputs)
    with text.when(running):
        for k in made:
            leaf = written.out_avals[k]
            start = text.at(f"%made{k}", leaf.dtype, text.let(f"mul i64 {row}, {_size(leaf)}"))
            for entry, value in enumerate(results[k]):
                text.store(value, text.at(start, leaf.dtype, entry), leaf.dtype)
    following = text.let(f"add i32 {item.name}, {stride}")
    text.fill(item, f"phi i32 [{number}, %{before}], [{following}, %{text.block}]")
    text.line(f"br label %{head}")
    text.start(end)
    text.line("ret void")
    parameters = ["ptr noalias readonly %sizes"]
    parameters += [f"ptr noalias readonly %given{k}" for k in given]
    parameters += [*(f"ptr %zero{k}" for k in made), *(f"ptr %made{k}" for k in made)]
    return entry_text(text, parameters, written)


def _size(leaf: jaxprs.Shape) -> int:
    return math.prod(leaf.shape)
