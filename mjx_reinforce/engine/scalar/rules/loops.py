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
        active, *carries = state
        nexts = carry.unpack(run(body, [*body_consts, *carry.pack(carries)]))
        # Lanes that share the predicate are done all at once: no iteration runs then.
        if varies(active):
            nexts = [graph.select(active, n, o) for n, o in zip(nexts, carries, strict=True)]
            return [graph.call("and", active, goes_on(nexts)), *nexts], []
        return [goes_on(nexts), *nexts], []

    start = carry.unpack(operands[num_cond + num_body :])
    active = goes_on(start)
    if is_constant(active) and not active:
        return carry.pack(start)
    is_kept = None
    if iterate.has_loops(body) or iterate.has_loops(cond):
        is_kept = [False, *carry.repeat(iterate.keeps(body, num_body, len(eqn.outvars)))]
    loop = iterate.iterate(graph, step, [active, *start], active=0, is_kept=is_kept)
    return carry.pack(loop.results()[0][1:])


def scan_rule(graph: Graph, run: Callable, eqn: Equation, live: Any, *operands: Array) -> Results:
    """Writes a short scan out; makes a loop of a longer one, which may end early."""
    length = eqn.params["length"]
    num_consts, num_carry = jaxprs.scan_parts(eqn)
    body = jaxprs.program(eqn.params["jaxpr"])
    num_fixed = num_consts + num_carry
    consts = operands[:num_consts]
    init = operands[num_consts:num_fixed]
    carry = arrays.Layout([out.aval for out in eqn.outvars[:num_carry]])
    out_layout = arrays.Layout([out.aval for out in body.jaxpr.outvars[num_carry:]])
    in_layout = arrays.Layout([var.aval for var in body.jaxpr.invars[num_fixed:]])
    order = range(length)
    if eqn.params["reverse"]:
        order = order[::-1]

    def step(state: list[Scalar], row: list[Scalar]) -> tuple[list[Scalar], list[Scalar]]:
        row_outputs = run(body, [*consts, *carry.pack(state), *in_layout.pack(row)])
        return carry.unpack(row_outputs[:num_carry]), out_layout.unpack(row_outputs[num_carry:])

    rows = [in_layout.unpack([x[t : t + 1] for x in operands[num_fixed:]]) for t in order]
    # Rows and the table of ys are in the order of the iterations.
    if length <= max(graph.scans, eqn.params["unroll"]):
        final_carry = carry.unpack(init)
        output_rows = []
        for row in rows:
            final_carry, ys = step(final_carry, row)
            output_rows.append(ys)
    else:
        is_kept = None
        if iterate.has_loops(body):
            is_kept = carry.repeat(iterate.keeps(body, num_consts, num_carry))
        final_carry, output_rows = _as_loop(graph, step, carry.unpack(init), rows, length, is_kept)
    if eqn.params["reverse"]:
        output_rows = output_rows[::-1]
    outputs = [out_layout.pack(row) for row in output_rows]
    ys = [np.stack(arrays.together(column)) for column in zip(*outputs, strict=True)]
    if not output_rows:
        ys = [arrays.zeros(out.aval) for out in eqn.outvars[num_carry:]]
    return [*carry.pack(final_carry), *ys]


def _as_loop(
    graph: Graph,
    step: Iteration,
    inits: list,
    rows: list[list[Scalar]],
    length: int,
    is_kept: list[bool] | None,
) -> tuple[list, list]:
    """Builds a scan's loop; returns the final carry and the ys of each iteration."""
    xs = [list(column) for column in zip(*rows, strict=True)]
    loop = iterate.iterate(graph, step, inits, length=length, xs=xs, is_kept=is_kept)
    # A loop may end early if it neither reads rows nor makes ys: further iterations leave nothing.
    if not xs and not loop.ys:
        switch = _switch(loop)
        if switch is not None:
            loop = iterate.iterate(
                graph, step, inits, length=length, active=switch, is_kept=is_kept
            )
    final_carry, columns = loop.results()
    return final_carry, [list(row) for row in zip(*columns, strict=True)] or [[]] * length


def _switch(loop: Loop) -> int | None:
    """Finds a bool carry that, once False in a lane, leaves that lane's whole carry as it is.

    MJX's line search is such a scan: its body is cond(active, iterate, identity).
    """
    indices = [i for i, carry in enumerate(loop.carries) if carry is not None]
    for i in indices:
        switch = loop.carries[i]
        if switch is None or switch.dtype != np.bool_:
            continue
        # What the carry is after an iteration where the switch is off, and what it was before.
        next_flags = [_when_false(loop.nexts[k], switch) for k in indices]
        flags = [np.False_ if k == i else loop.carries[k] for k in indices]
        if all(map(same, next_flags, flags)):
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
        branch_index = min(max(int(choice), 0), len(programs) - 1)
        return run(programs[branch_index], arguments, live)
    out_layout = arrays.Layout([out.aval for out in eqn.outvars])

    def branch(program: jaxprs.Program) -> Branch:
        return lambda: out_layout.unpack(run(program, arguments, live))

    return out_layout.pack(_choose_among(graph, [branch(program) for program in programs], choice))


def skippable_rule(
    graph: Graph, run: Callable, eqn: Equation, live: list[bool], *operands: Array
) -> Results:
    """Skips a computation that no lane needs, if it is expensive; see ``skippable``."""
    is_needed, *leaves = operands
    count = eqn.params["num_results"]
    default = leaves[:count]
    consts = leaves[count:]
    out_layout = arrays.Layout([out.aval for out in eqn.outvars])

    def compute() -> list[Scalar]:
        return out_layout.unpack(run(jaxprs.program(eqn.params["computation"]), consts, live))

    (predicate,) = arrays.elements(is_needed)
    if is_constant(predicate) and not predicate:
        return default
    body = _expensive(graph, compute, 0, predicate)
    if body is None:
        return out_layout.pack(compute())
    # In a lane that does not need it the result equals ``default``, so nothing is selected.
    cold_values = out_layout.unpack(default)
    return out_layout.pack(
        _close(graph, body, predicate, body.results, cold_values, is_skippable=True)
    )


def whole_rule(
    graph: Graph, run: Callable, eqn: Equation, live: list[bool], *operands: Array
) -> Results:
    """Keeps an operation whole; see ``whole``."""
    field_names = tuple(field for field, *_ in eqn.params["results"])
    args = [arrays.elements(x) for x in operands]
    call = Call(graph.scope, graph.number(), eqn.params["name"], args, field_names)
    outputs = []
    for index, (out, is_live) in enumerate(zip(eqn.outvars, live, strict=True)):
        # A result that nothing reads has no leaves, and the backend need not store it.
        leaves = []
        leaf = arrays.zeros(out.aval)
        if is_live:
            places = [(index, k) for k in range(num_entries(out.aval))]
            leaves = [graph.leaf(out.aval.dtype, True, call, place) for place in places]
            leaf = arrays.pack(leaves, out.aval.shape, out.aval.dtype)
        call.outs.append(leaves)
        outputs.append(leaf)
    return outputs


def _choose_among(graph: Graph, branches: list[Branch], choice: Node) -> list[Scalar]:
    """Returns the results of the branch that each lane takes."""
    flags = [_takes(graph, choice, k, len(branches)) for k in range(len(branches))]
    order = list(range(len(branches)))
    bodies = {}
    if len(branches) == 2:
        bodies[0] = _expensive(graph, branches[0], 0, flags[0])
        # The cheap branch comes first: its results are what a skipped one falls back on.
        if bodies[0] is not None:
            order = [1, 0]
    selection: list[Scalar] | None = None
    for k in order:
        if k not in bodies:
            bodies[k] = _expensive(graph, branches[k], k, flags[k])
        body = bodies[k]
        if body is not None:
            selection = _gate(graph, body, flags[k], selection)
            continue
        # Every lane computes a cheap branch. The first of all branches needs no selection: each
        # lane that takes another one overwrites it.
        branch_results = branches[k]()
        if selection is not None:
            branch_results = _select_all(graph, flags[k], branch_results, selection)
        selection = branch_results
    return selection or []


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


def _expensive(graph: Graph, branch: Branch, k: int, flag: Scalar) -> _Body | None:
    """Evaluates branch k where it may be skipped; returns None if it need not be.

    What a cheap branch makes is dropped. A branch that was expensive once remains so where less is
    assumed.
    """
    # A premise holds for some lane wherever this code runs: such a branch is never skipped.
    if not isinstance(flag, Node) or flag in graph.premises:
        return None
    with graph.branch() as scope, graph.assuming(flag):
        outputs = branch()
    place = (graph.path, "expensive", k)
    if place not in graph.findings:
        if not scope.has_loop and scope.cost <= graph.branch_cost:
            return None
        graph.findings[place] = True
    return _Body(scope, outputs)


def _gate(graph: Graph, body: _Body, flag: Node, fallback: list[Scalar] | None) -> list[Scalar]:
    """Makes an expensive branch one that is skipped where no lane needs it."""
    # Without a fallback any value does: where the branch is skipped, no lane takes it.
    cold_values = fallback or [value.dtype.type(0) for value in body.results]
    # Inside of the branch, so that a skipped one selects nothing either.
    with graph.again(body.scope), graph.assuming(flag):
        hot_values = _select_all(graph, flag, body.results, cold_values)
    return _close(graph, body, flag, hot_values, cold_values)


def _close(
    graph: Graph,
    body: _Body,
    flag: Node,
    hot_values: list[Scalar],
    cold_values: list[Scalar],
    *,
    is_skippable: bool = False,
) -> list[Scalar]:
    """Gives a branch its place; returns its results."""
    gate = Gate(
        graph.scope,
        graph.number(),
        flag,
        body.scope,
        hot_values,
        cold_values,
        is_skippable=is_skippable,
    )
    for position, (hot, cold) in enumerate(zip(hot_values, cold_values, strict=True)):
        varying = any(isinstance(value, Node) and value.varying for value in (hot, cold))
        leaf = None
        if not same(hot, cold):
            leaf = graph.leaf(hot.dtype, varying, gate, position)
        gate.outs.append(leaf)
    return [cold if out is None else out for out, cold in zip(gate.outs, cold_values, strict=True)]


def _select_all(graph: Graph, mask: Scalar, hot: list[Scalar], cold: list[Scalar]) -> list[Scalar]:
    return [graph.select(mask, x, y) for x, y in zip(hot, cold, strict=True)]
