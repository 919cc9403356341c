"""Rules for what stays a loop or a branch.

``while`` and ``scan`` become loops that end when no lane needs another iteration. Of ``cond``,
cheap branches are both evaluated, and expensive ones skipped if unneeded. Of ``skippable``, nothing
is selected.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from mjx_reinforce.engine.scalar import arrays, jaxprs
from mjx_reinforce.engine.scalar.arrays import Array, Results
from mjx_reinforce.engine.scalar.graph import Graph
from mjx_reinforce.engine.scalar.jaxprs import Equation, num_entries
from mjx_reinforce.engine.scalar.nodes import (
    Call,
    Gate,
    Loop,
    Node,
    Scalar,
    Scope,
    is_constant,
    same,
)
from mjx_reinforce.engine.scalar.rules import iterate
from mjx_reinforce.engine.scalar.rules.iterate import Iteration, varies


def while_rule(graph: Graph, run: Callable, eqn: Equation, live: Any, *operands: Array) -> Results:
    """Makes a loop; a lane that is done keeps its values while others go on."""
    num_cond = eqn.params["cond_nconsts"]
    num_body = eqn.params["body_nconsts"]
    cond_consts = operands[:num_cond]
    body_consts = operands[num_cond : num_cond + num_body]
    carry = arrays.Layout([out.aval for out in eqn.outvars])
    cond = jaxprs.program(eqn.params["cond_jaxpr"])
    body = jaxprs.program(eqn.params["body_jaxpr"])

    def goes_on(state: list[Scalar]) -> Scalar:
        return run(cond, [*cond_consts, *carry.pack(state)])[0][()]

    def step(state: list[Scalar], _: list[Scalar]) -> tuple[list[Scalar], list[Scalar]]:
        """Computes one iteration; whether a lane goes on is the first of the carry."""
        active, *old = state
        new = carry.unpack(run(body, [*body_consts, *carry.pack(old)]))
        # Lanes that share the predicate are done all at once: no iteration runs then.
        if varies(active):
            new = [graph.select(active, n, o) for n, o in zip(new, old, strict=True)]
            return [graph.call("and", active, goes_on(new)), *new], []
        return [goes_on(new), *new], []

    start = carry.unpack(operands[num_cond + num_body :])
    active = goes_on(start)
    if is_constant(active) and not active:
        return carry.pack(start)
    unchanged = None
    if iterate.has_loops(body) or iterate.has_loops(cond):
        unchanged = [False, *carry.repeat(iterate.keeps(body, num_body, len(eqn.outvars)))]
    loop = iterate.iterate(graph, step, [active, *start], active=0, unchanged=unchanged)
    return carry.pack(loop.results()[0][1:])


def scan_rule(graph: Graph, run: Callable, eqn: Equation, live: Any, *operands: Array) -> Results:
    """Writes a short scan out; makes a loop of a longer one, which may end early."""
    length = eqn.params["length"]
    num_consts, num_carry = jaxprs.scan_parts(eqn)
    body = jaxprs.program(eqn.params["jaxpr"])
    split = num_consts + num_carry
    consts = operands[:num_consts]
    init = operands[num_consts:split]
    carry = arrays.Layout([out.aval for out in eqn.outvars[:num_carry]])
    outs = arrays.Layout([out.aval for out in body.jaxpr.outvars[num_carry:]])
    ins = arrays.Layout([var.aval for var in body.jaxpr.invars[split:]])
    order = range(length)
    if eqn.params["reverse"]:
        order = order[::-1]

    def step(state: list[Scalar], row: list[Scalar]) -> tuple[list[Scalar], list[Scalar]]:
        results = run(body, [*consts, *carry.pack(state), *ins.pack(row)])
        return carry.unpack(results[:num_carry]), outs.unpack(results[num_carry:])

    rows = [ins.unpack([x[t : t + 1] for x in operands[split:]]) for t in order]
    # Rows and the table of ys are in the order of the iterations.
    if length <= max(graph.scans, eqn.params["unroll"]):
        final = carry.unpack(init)
        table = []
        for row in rows:
            final, ys = step(final, row)
            table.append(ys)
    else:
        unchanged = None
        if iterate.has_loops(body):
            unchanged = carry.repeat(iterate.keeps(body, num_consts, num_carry))
        final, table = _as_loop(graph, step, carry.unpack(init), rows, length, unchanged)
    if eqn.params["reverse"]:
        table = table[::-1]
    stacked = [outs.pack(row) for row in table]
    ys = [np.stack(arrays.together(column)) for column in zip(*stacked, strict=True)]
    if not table:
        ys = [arrays.zeros(out.aval) for out in eqn.outvars[num_carry:]]
    return [*carry.pack(final), *ys]


def _as_loop(
    graph: Graph,
    step: Iteration,
    inits: list,
    rows: list[list[Scalar]],
    length: int,
    unchanged: list[bool] | None,
) -> tuple[list, list]:
    """Builds a scan's loop; returns the final carry and the ys of each iteration."""
    xs = [list(column) for column in zip(*rows, strict=True)]
    loop = iterate.iterate(graph, step, inits, length=length, xs=xs, unchanged=unchanged)
    # A loop may end early if it neither reads rows nor makes ys: further iterations leave nothing.
    if not xs and not loop.ys:
        switch = _switch(loop)
        if switch is not None:
            loop = iterate.iterate(
                graph, step, inits, length=length, active=switch, unchanged=unchanged
            )
    final, columns = loop.results()
    return final, [list(row) for row in zip(*columns, strict=True)] or [[]] * length


def _switch(loop: Loop) -> int | None:
    """Finds a bool carry that, once False in a lane, leaves that lane's whole carry as it is.

    MJX's line search is such a scan: its body is cond(active, iterate, identity).
    """
    changing = [i for i, carry in enumerate(loop.carries) if carry is not None]
    for i in changing:
        switch = loop.carries[i]
        if switch is None or switch.dtype != np.bool_:
            continue
        # What the carry is after an iteration where the switch is off, and what it was before.
        after = [_when_false(loop.nexts[k], switch) for k in changing]
        before = [np.False_ if k == i else loop.carries[k] for k in changing]
        if all(map(same, after, before)):
            return i
    return None


def _when_false(value: Scalar, switch: Node) -> Scalar:
    """Returns what a scalar is where the switch is False, or itself where that is not known."""
    if value is switch:
        return np.False_
    if not isinstance(value, Node):
        return value
    # A gate that is skipped gives what is cold; a selection has the case for False first.
    gate = value.owner
    if isinstance(gate, Gate) and gate.predicate is switch:
        return _when_false(gate.cold[value.position], switch)
    if value.op is not None and value.op.name == "select_n" and value.args[0] is switch:
        return _when_false(value.args[1], switch)
    if value.op is not None and value.op.name == "and":
        sides = [_when_false(arg, switch) for arg in value.args]
        if any(is_constant(side) and not side for side in sides):
            return np.False_
    return value


#: A branch that evaluates itself in the graph's innermost scope.
Branch = Callable[[], list[Scalar]]


class _Body(NamedTuple):
    """A branch that was evaluated: where its nodes are, and its results."""

    scope: Scope
    results: list[Scalar]


def cond_rule(
    graph: Graph, run: Callable, eqn: Equation, live: list[bool], *operands: Array
) -> Results:
    """Evaluates the branches that lanes may take and picks each lane's own.

    Args:
      graph: where nodes are made.
      run: (program, arguments, which results something reads) -> results.
      eqn: the equation.
      live: which of its results something reads.
      *operands: [] which branch is taken, and the arguments of every branch.
    """
    index, *arguments = operands
    programs = [jaxprs.program(branch) for branch in eqn.params["branches"]]
    (choice,) = arrays.elements(index)
    if is_constant(choice):
        nearest = min(max(int(choice), 0), len(programs) - 1)
        return run(programs[nearest], arguments, live)
    layout = arrays.Layout([out.aval for out in eqn.outvars])

    def branch(program: jaxprs.Program) -> Branch:
        return lambda: layout.unpack(run(program, arguments, live))

    return layout.pack(_choose_among(graph, [branch(program) for program in programs], choice))


def skippable_rule(
    graph: Graph, run: Callable, eqn: Equation, live: list[bool], *operands: Array
) -> Results:
    """Skips a computation that no lane needs, if it is expensive; see ``skippable``."""
    needed, *leaves = operands
    count = eqn.params["num_results"]
    otherwise = leaves[:count]
    consts = leaves[count:]
    layout = arrays.Layout([out.aval for out in eqn.outvars])

    def compute() -> list[Scalar]:
        return layout.unpack(run(jaxprs.program(eqn.params["computation"]), consts, live))

    (predicate,) = arrays.elements(needed)
    if is_constant(predicate) and not predicate:
        return otherwise
    body = _expensive(graph, compute, 0, predicate)
    if body is None:
        return layout.pack(compute())
    # In a lane that does not need it the result equals ``otherwise``, so nothing is selected.
    return layout.pack(_close(graph, body, predicate, body.results, layout.unpack(otherwise)))


def whole_rule(
    graph: Graph, run: Callable, eqn: Equation, live: list[bool], *operands: Array
) -> Results:
    """Keeps an operation whole; see ``whole``."""
    fields = tuple(field for field, *_ in eqn.params["results"])
    args = [arrays.elements(x) for x in operands]
    call = Call(graph.scope, graph.number(), eqn.params["name"], args, fields)
    results = []
    for number, (out, is_live) in enumerate(zip(eqn.outvars, live, strict=True)):
        # A result that nothing reads has no leaves, and the backend need not store it.
        leaves = []
        array = arrays.zeros(out.aval)
        if is_live:
            places = [(number, k) for k in range(num_entries(out.aval))]
            leaves = [graph.leaf(out.aval.dtype, True, call, place) for place in places]
            array = arrays.pack(leaves, out.aval.shape, out.aval.dtype)
        call.outs.append(leaves)
        results.append(array)
    return results


def _choose_among(graph: Graph, branches: list[Branch], choice: Node) -> list[Scalar]:
    """Returns the results of the branch that each lane takes."""
    needed = [_takes(graph, choice, k, len(branches)) for k in range(len(branches))]
    order = list(range(len(branches)))
    bodies = {}
    if len(branches) == 2:
        bodies[0] = _expensive(graph, branches[0], 0, needed[0])
        # The cheap branch comes first: its results are what a skipped one falls back on.
        if bodies[0] is not None:
            order = [1, 0]
    results: list[Scalar] | None = None
    for k in order:
        if k not in bodies:
            bodies[k] = _expensive(graph, branches[k], k, needed[k])
        body = bodies[k]
        if body is not None:
            results = _gate(graph, body, needed[k], results)
            continue
        # Every lane computes a cheap branch. The first of all branches needs no selection: each
        # lane that takes another one overwrites it.
        branch_results = branches[k]()
        if results is not None:
            branch_results = _select_all(graph, needed[k], branch_results, results)
        results = branch_results
    return results or []


def _takes(graph: Graph, choice: Node, k: int, count: int) -> Scalar:
    """Returns which lanes take branch k; a choice out of range takes the nearest."""
    if choice.dtype == np.bool_:
        if k == 0:
            return graph.call("not", choice)
        return choice
    number = choice.dtype.type
    if k == 0:
        return graph.call("lt", choice, number(1))
    if k == count - 1:
        return graph.call("ge", choice, number(k))
    return graph.call("eq", choice, number(k))


def _expensive(graph: Graph, branch: Branch, k: int, needed: Scalar) -> _Body | None:
    """Evaluates branch k where it may be skipped; returns None if it need not be.

    What a cheap branch makes is dropped. A branch that was expensive once remains so where less is
    assumed.
    """
    # A premise holds for some lane wherever this code runs: such a branch is never skipped.
    if not isinstance(needed, Node) or needed in graph.premises:
        return None
    with graph.branch() as scope, graph.assuming(needed):
        results = branch()
    place = (graph.path, "expensive", k)
    if place not in graph.findings:
        if not scope.has_loop and scope.cost <= graph.branch_cost:
            return None
        graph.findings[place] = True
    return _Body(scope, results)


def _gate(graph: Graph, body: _Body, needed: Node, fallback: list[Scalar] | None) -> list[Scalar]:
    """Makes an expensive branch one that is skipped where no lane needs it."""
    # Without a fallback any value does: where the branch is skipped, no lane takes it.
    cold = fallback or [value.dtype.type(0) for value in body.results]
    # Inside of the branch, so that a skipped one selects nothing either.
    with graph.again(body.scope), graph.assuming(needed):
        hot = _select_all(graph, needed, body.results, cold)
    return _close(graph, body, needed, hot, cold)


def _close(
    graph: Graph, body: _Body, needed: Node, hot: list[Scalar], cold: list[Scalar]
) -> list[Scalar]:
    """Gives a branch its place; returns its results."""
    gate = Gate(graph.scope, graph.number(), needed, body.scope, hot, cold)
    for position, (on, off) in enumerate(zip(hot, cold, strict=True)):
        varying = any(isinstance(value, Node) and value.varying for value in (on, off))
        leaf = None
        if not same(on, off):
            leaf = graph.leaf(on.dtype, varying, gate, position)
        gate.outs.append(leaf)
    return [off if out is None else out for out, off in zip(gate.outs, cold, strict=True)]


def _select_all(graph: Graph, needed: Scalar, on: list[Scalar], off: list[Scalar]) -> list[Scalar]:
    return [graph.select(needed, x, y) for x, y in zip(on, off, strict=True)]
