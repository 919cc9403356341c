"""The rules for choices.

Of ``cond``, cheap branches are both evaluated, and expensive ones skipped if unneeded. Of
``skippable``, nothing is selected. Of ``by_engine``, the program for one episode is taken.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from mjx_reinforce.engine.scalar import arrays, jaxprs
from mjx_reinforce.engine.scalar.graph import Graph
from mjx_reinforce.engine.scalar.nodes import Gate, Node, Scalar, Scope, is_constant, same

#: A branch that evaluates itself in the graph's innermost scope.
Branch = Callable[[], list[Scalar]]


class _Body(NamedTuple):
    """A branch that was evaluated: where its nodes are, and its results."""

    scope: Scope
    results: list[Scalar]


def cond_rule(
    graph: Graph, run: Callable, eqn: jaxprs.Equation, used: list[bool], *operands: np.ndarray
) -> list[np.ndarray]:
    """Evaluates the branches that lanes may take and picks each lane's own.

    Args:
      graph: where nodes are made.
      run: (program, arguments, which results are used) -> results.
      eqn: the equation.
      used: which of its results are used.
      *operands: [] which branch is taken, and the arguments of every branch.
    """
    index, *arguments = operands
    programs = [jaxprs.program(branch) for branch in eqn.params["branches"]]
    (choice,) = arrays.elements(index)
    if is_constant(choice):
        taken = programs[min(max(int(choice), 0), len(programs) - 1)]
        return run(taken, arguments, used)
    layout = arrays.Layout([out.aval for out in eqn.outvars])

    def branch(program: jaxprs.Program) -> Branch:
        return lambda: layout.unpack(run(program, arguments, used))

    return layout.pack(_choose_among(graph, [branch(program) for program in programs], choice))


def skippable_rule(
    graph: Graph, run: Callable, eqn: jaxprs.Equation, used: list[bool], *operands: np.ndarray
) -> list[np.ndarray]:
    """Skips a computation that no lane needs, if it is expensive; see ``skippable``."""
    count, (needed, *others) = eqn.params["num_results"], operands
    otherwise, consts = others[:count], others[count:]
    layout = arrays.Layout([out.aval for out in eqn.outvars])

    def compute() -> list[Scalar]:
        return layout.unpack(run(jaxprs.program(eqn.params["computation"]), consts, used))

    (predicate,) = arrays.elements(needed)
    if is_constant(predicate) and not predicate:
        return otherwise
    body = _expensive(graph, compute, 0, predicate)
    if body is None:
        return layout.pack(compute())
    return layout.pack(_close(graph, body, predicate, body.results, layout.unpack(otherwise)))


def by_engine_rule(
    graph: Graph, run: Callable, eqn: jaxprs.Equation, used: list[bool], *operands: np.ndarray
) -> list[np.ndarray]:
    """Takes the program for an engine that writes out; see ``by_engine``."""
    program = jaxprs.program(eqn.params["one"])
    return run(program, list(operands), used, may_unroll=eqn.params["may_unroll"])


def _choose_among(graph: Graph, branches: list[Branch], choice: Node) -> list[Scalar]:
    """Returns the results of the branch that each lane takes."""
    needed = [_takes(graph, choice, k, len(branches)) for k in range(len(branches))]
    order, tried = list(range(len(branches))), {}
    if len(branches) == 2:
        tried[0] = _expensive(graph, branches[0], 0, needed[0])
        # The cheap branch comes first: its results are what a skipped one falls back on.
        order = [0, 1] if tried[0] is None else [1, 0]
    results: list[Scalar] | None = None
    for k in order:
        body = tried[k] if k in tried else _expensive(graph, branches[k], k, needed[k])
        if body is not None:
            results = _gate(graph, body, needed[k], results)
            continue
        others, results = results, branches[k]()
        if others is not None:
            results = _select_all(graph, needed[k], results, others)
    return results or []


def _takes(graph: Graph, choice: Node, k: int, count: int) -> Scalar:
    """Returns which lanes take branch k; a choice out of range takes the nearest."""
    if choice.dtype == np.bool_:
        return choice if k else graph.call("not", choice)
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
    if not isinstance(needed, Node) or needed in graph.certain:
        return None
    with graph.branch() as scope, graph.assuming(needed):
        results = branch()
    place = (graph.path, "expensive", k)
    if place not in graph.learned:
        if not scope.has_loop and scope.cost <= graph.branch_cost:
            return None
        graph.learned[place] = True
    return _Body(scope, results)


def _gate(graph: Graph, body: _Body, needed: Node, fallback: list[Scalar] | None) -> list[Scalar]:
    """Makes an expensive branch one that is skipped where no lane needs it."""
    cold = fallback or [result.dtype.type(0) for result in body.results]
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
        leaf = None if same(on, off) else graph.leaf(on.dtype, varying, gate, position)
        gate.outs.append(leaf)
    return [off if out is None else out for out, off in zip(gate.outs, cold, strict=True)]


def _select_all(graph: Graph, needed: Scalar, on: list[Scalar], off: list[Scalar]) -> list[Scalar]:
    return [graph.select(needed, x, y) for x, y in zip(on, off, strict=True)]
