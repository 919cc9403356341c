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
    is_kept: list[bool] | None = None,
) -> Loop:
    """Builds a loop.

    Every carry is first assumed to keep its initial value. The body is evaluated on that
    assumption, carries that break it are dropped from it, and so on until it holds: then it holds
    in every iteration. The same is done for 'all lanes agree'. Where this loop was built before, as
    part of an outer loop's body, it begins with the assumptions that held then.

    Args:
      graph: where the loop is made.
      step: evaluates one iteration in the graph's innermost scope.
      inits: what the carry starts from.
      length: the number of iterations, or None for no limit.
      active: the position in the carry of the bool that ends the loop when no lane has it.
      xs: for each element, its value in each iteration.
      is_kept: which of the carry keep their values, where that is known of the variables; then
        the others are assumed to vary.
    """
    make_loop = functools.partial(Loop, graph.scope, 0, length, list(inits), active, list(xs))
    place = (graph.path, active)
    count = len(inits)
    initial = Assumption(is_kept or [True] * count, [is_kept is not None] * count)
    fixed, varying = graph.findings.get(place, initial)
    varying = [v or varies(init) for v, init in zip(varying, inits, strict=True)]
    # Assumptions are only ever dropped, so this ends.
    while True:
        loop = _trace_body(graph, step, make_loop, fixed, varying)
        is_moved = [f and not same(n, i) for f, n, i in zip(fixed, loop.nexts, inits, strict=True)]
        is_widened = [varies(n) and not v for n, v in zip(loop.nexts, varying, strict=True)]
        fixed = [f and not m for f, m in zip(fixed, is_moved, strict=True)]
        varying = [v or d for v, d in zip(varying, is_widened, strict=True)]
        # Whether lanes agree on a carry that keeps its value is decided by that value alone.
        is_broken = [*is_moved, *(d and not f for d, f in zip(is_widened, fixed, strict=True))]
        if not any(is_broken):
            graph.findings[place] = Assumption(fixed, varying)
            return _close(graph, loop, varying)


def varies(scalar: Scalar) -> bool:
    """Returns whether each lane has a value of its own."""
    return isinstance(scalar, Node) and scalar.varying


def _trace_body(
    graph: Graph,
    step: Iteration,
    make_loop: Callable[[Scope], Loop],
    fixed: list[bool],
    varying: list[bool],
) -> Loop:
    """Evaluates one iteration under the present assumptions."""
    with graph.loop_body() as body:
        loop = make_loop(body)
        # What is the same in every iteration has no leaf: it folds and simplifies as it is.
        state = []
        for i, (init, is_fixed, v) in enumerate(zip(loop.inits, fixed, varying, strict=True)):
            leaf = None
            if not is_fixed:
                leaf = graph.leaf(init.dtype, v, loop, ("carry", i))
            loop.carries.append(leaf)
            state.append(leaf or init)
        elements = []
        for j, row in enumerate(loop.xs):
            leaf = None
            if not all(same(x, row[0]) for x in row):
                leaf = graph.leaf(row[0].dtype, any(map(varies, row)), loop, ("element", j))
            loop.elements.append(leaf)
            elements.append(leaf or row[0])
        # Where all lanes are done, no iteration runs.
        is_active = None
        if loop.active is not None:
            is_active = state[loop.active]
        with graph.assuming(is_active):
            loop.nexts, loop.ys = step(state, elements)
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
        leaves = []
        # What lies outside of the body is the same in every iteration, and needs no leaves.
        if isinstance(y, Node) and y.scope is loop.body:
            iterations = range(loop.length or 0)
            leaves = [graph.leaf(y.dtype, y.varying, loop, ("y", j, t)) for t in iterations]
        loop.stacked.append(leaves)
    return loop


def has_loops(program: jaxprs.Program) -> bool:
    """Returns whether a program has loops, in the programs that it calls too."""
    return any(
        eqn.primitive.name in ("scan", "while")
        or any(map(has_loops, jaxprs.subprograms(eqn.params.values())))
        for eqn in program.jaxpr.eqns
    )


def keeps(body: jaxprs.Program, start: int, count: int) -> list[bool]:
    """Returns which variables of the carry an iteration hands on as they are.

    Args:
      body: of the loop; its leading results are the carry.
      start: the position of the carry among its arguments.
      count: how many variables the carry has.
    """
    sources = _sources(body)
    return [sources[k] == start + k for k in range(count)]


def _sources(program: jaxprs.Program) -> list[int | None]:
    """Returns for each result of a program the argument that it is, or None."""
    sources: dict[Any, int] = {variable: k for k, variable in enumerate(program.jaxpr.invars)}
    for eqn in program.jaxpr.eqns:
        for out, position in zip(eqn.outvars, _operands_returned(eqn), strict=False):
            if position is None or jaxprs.is_literal(eqn.invars[position]):
                continue
            operand = eqn.invars[position]
            if operand in sources:
                sources[out] = sources[operand]
    outs = program.jaxpr.outvars
    return [None if jaxprs.is_literal(out) else sources.get(out) for out in outs]


def _operands_returned(eqn: Any) -> list[int | None]:
    """Returns for the leading results of an equation the operand that each is, or None."""
    name = eqn.primitive.name
    params = eqn.params
    if name == "scan":
        start, count = jaxprs.scan_parts(eqn)
        return _where_kept(keeps(jaxprs.program(params["jaxpr"]), start, count), start)
    if name == "while":
        # Among the body's arguments, the carry comes behind the body's constants. Among the
        # equation's operands, it comes behind those of the condition, too.
        start = params["body_nconsts"]
        is_kept = keeps(jaxprs.program(params["body_jaxpr"]), start, len(eqn.outvars))
        return _where_kept(is_kept, params["cond_nconsts"] + start)
    if name == "cond":
        # All branches must return the same argument. The first operand is the number of the branch.
        positions: list[int | None] = []
        for sources in zip(*(_sources(jaxprs.program(b)) for b in params["branches"]), strict=True):
            source = sources[0]
            if source is None or len(set(sources)) > 1:
                positions.append(None)
            else:
                positions.append(1 + source)
        return positions
    program = jaxprs.callee(eqn) if name in _CALLS else None
    if program is None:
        return []
    return list(_sources(program))


def _where_kept(is_kept: list[bool], start: int) -> list[int | None]:
    """Returns the position of each carry that keeps its value, the first at ``start``."""
    return [start + k if keeps_value else None for k, keeps_value in enumerate(is_kept)]
