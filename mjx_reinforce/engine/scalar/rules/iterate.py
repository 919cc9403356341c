"""Builds loops of the scalar graph, whose carry is only what changes.

``iterate`` finds that out scalar by scalar, and writes the body two to four times for it. Of a body
with loops inside that takes most of the time, and the variables of its jaxpr say as much: see
``keeps``.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from mjx_reinforce.engine.scalar import jaxprs
from mjx_reinforce.engine.scalar.graph import Graph
from mjx_reinforce.engine.scalar.nodes import Loop, Node, Scalar, Scope, same

#: (carry, elements of xs) -> (carry after one iteration, ys)
Iteration = Callable[[list[Scalar], list[Scalar]], tuple[list[Scalar], list[Scalar]]]
#: The equations that call a program and return its results as they are.
_CALLS = ("pjit", "jit", "closed_call", "custom_jvp_call", "custom_vjp_call", "remat2")


class Assumption(NamedTuple):
    """What is assumed of each carry.

    fixed: whether it keeps its initial value
    varying: whether each lane has its own
    """

    fixed: list[bool]
    varying: list[bool]


def iterate(
    graph: Graph,
    step: Iteration,
    inits: Sequence[Scalar],
    *,
    length: int | None = None,
    active: int | None = None,
    xs: Sequence[list[Scalar]] = (),
    kept: list[bool] | None = None,
) -> Loop:
    """Builds a loop.

    Every carry is first assumed to keep its initial value. The body is evaluated on that
    assumption, carries that break it are dropped from it, and so on until it holds: then it holds
    in every iteration. The same is done for 'all lanes agree'. Where this loop was built before, as
    part of an outer loop's body, that begins with what was found then.

    Args:
      graph: where the loop is made.
      step: evaluates one iteration in the graph's innermost scope.
      inits: what the carry starts from.
      length: the number of iterations, or None for no limit.
      active: the position in the carry of the bool that ends the loop when no lane has it.
      xs: for each element, its value in each iteration.
      kept: which of the carry keep their values, where that is known of the variables; then the
        others are assumed to vary.
    """
    make = functools.partial(Loop, graph.scope, 0, length, list(inits), active, list(xs))
    place, count = (graph.path, active), len(inits)
    first = Assumption(kept or [True] * count, [kept is not None] * count)
    fixed, varying = graph.learned.get(place, first)
    varying = [v or varies(init) for v, init in zip(varying, inits, strict=True)]
    while True:
        loop = _trace_body(graph, step, make, fixed, varying)
        moved = [f and not same(n, i) for f, n, i in zip(fixed, loop.nexts, inits, strict=True)]
        differs = [varies(n) and not v for n, v in zip(loop.nexts, varying, strict=True)]
        fixed = [f and not m for f, m in zip(fixed, moved, strict=True)]
        varying = [v or s for v, s in zip(varying, differs, strict=True)]
        if not any(moved) and not any(s and not f for s, f in zip(differs, fixed, strict=True)):
            graph.learned[place] = Assumption(fixed, varying)
            return _close(graph, loop, varying)


def varies(scalar: Scalar) -> bool:
    """Returns whether each lane has a value of its own."""
    return isinstance(scalar, Node) and scalar.varying


def _trace_body(
    graph: Graph,
    step: Iteration,
    make: Callable[[Scope], Loop],
    fixed: list[bool],
    varying: list[bool],
) -> Loop:
    """Evaluates one iteration under the present assumptions."""
    with graph.loop_body() as body:
        loop = make(body)
        for i, (init, is_fixed, v) in enumerate(zip(loop.inits, fixed, varying, strict=True)):
            leaf = None if is_fixed else graph.leaf(init.dtype, v, loop, ("carry", i))
            loop.carries.append(leaf)
        for j, row in enumerate(loop.xs):
            same_throughout = all(same(x, row[0]) for x in row)
            v = any(map(varies, row))
            leaf = None if same_throughout else graph.leaf(row[0].dtype, v, loop, ("element", j))
            loop.elements.append(leaf)
        state = [init if c is None else c for init, c in zip(loop.inits, loop.carries, strict=True)]
        parts = [row[0] if e is None else e for row, e in zip(loop.xs, loop.elements, strict=True)]
        # Where all lanes are done, no iteration runs.
        with graph.assuming(None if loop.active is None else state[loop.active]):
            loop.nexts, loop.ys = step(state, parts)
    return loop


def _close(graph: Graph, loop: Loop, varying: list[bool]) -> Loop:
    """Gives the loop its place and its results."""
    loop.index = graph.number()
    graph.scope.has_loop = True
    loop.outs = [
        None if carry is None else graph.leaf(carry.dtype, v, loop, ("out", i))
        for i, (carry, v) in enumerate(zip(loop.carries, varying, strict=True))
    ]
    for j, y in enumerate(loop.ys):
        inside = isinstance(y, Node) and y.scope is loop.body
        times = range(loop.length or 0) if inside else ()
        leaves = [graph.leaf(y.dtype, y.varying, loop, ("y", j, t)) for t in times]
        loop.stacked.append(leaves)
    return loop


def has_loops(program: jaxprs.Program) -> bool:
    """Returns whether a program has loops, in the programs that it calls too."""
    return any(
        eqn.primitive.name in ("scan", "while")
        or any(map(has_loops, jaxprs.subprograms(eqn.params.values())))
        for eqn in program.jaxpr.eqns
    )


def keeps(body: jaxprs.Program, first: int, count: int) -> list[bool]:
    """Returns which variables of the carry an iteration hands on as they are.

    Args:
      body: of the loop; its leading results are the carry.
      first: the position of the carry among its arguments.
      count: how many variables the carry has.
    """
    sources = _sources(body)
    return [sources[k] == first + k for k in range(count)]


def _sources(program: jaxprs.Program) -> list[int | None]:
    """Returns for each result of a program the argument that it is, or None."""
    found: dict[Any, int] = {variable: k for k, variable in enumerate(program.jaxpr.invars)}
    for eqn in program.jaxpr.eqns:
        for out, position in zip(eqn.outvars, _operands_returned(eqn), strict=False):
            operand = None if position is None else eqn.invars[position]
            if operand is not None and not jaxprs.is_literal(operand) and operand in found:
                found[out] = found[operand]
    outs = program.jaxpr.outvars
    return [None if jaxprs.is_literal(out) else found.get(out) for out in outs]


def _operands_returned(eqn: Any) -> list[int | None]:
    """Returns for the leading results of an equation the operand that each is, or None."""
    name, params = eqn.primitive.name, eqn.params
    if name == "scan":
        first, count = jaxprs.scan_parts(eqn)
        kept = keeps(jaxprs.program(params["jaxpr"]), first, count)
        return [first + k if keep else None for k, keep in enumerate(kept)]
    if name == "while":
        first, count = params["body_nconsts"], len(eqn.outvars)
        kept = keeps(jaxprs.program(params["body_jaxpr"]), first, count)
        first += params["cond_nconsts"]
        return [first + k if keep else None for k, keep in enumerate(kept)]
    if name == "cond":
        columns = zip(*(_sources(jaxprs.program(b)) for b in params["branches"]), strict=True)
        return [None if each[0] is None or len(set(each)) > 1 else 1 + each[0] for each in columns]
    called = jaxprs.callee(eqn) if name in _CALLS else None
    return [] if called is None else list(_sources(called))
