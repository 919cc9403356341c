"""The rule for `cond`: cheap branches are both evaluated, expensive ones skipped if unneeded."""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from mjx_reinforce.fused import arrays, jaxprs, ops
from mjx_reinforce.fused.graph import Graph, Node, Scalar, Scope, same


@dataclasses.dataclass(eq=False, slots=True)
class Gate:
    """A branch that runs only if some lane needs it.

    Attributes:
        scope: where the gate is.
        index: its place among the nodes of that scope.
        predicate: which lanes need the branch.
        body: the scope of the branch.
        hot: the results if some lane needs it, each lane's own already selected.
        cold: the results if none does.
        outs: the leaf that stands for each result; None where hot and cold are the same.
    """

    scope: Scope
    index: int
    predicate: Node
    body: Scope
    hot: list[Scalar]
    cold: list[Scalar]
    outs: list[Node | None] = dataclasses.field(default_factory=list)


def cond_rule(
    run: Callable, graph: Graph, eqn: Any, used: list[bool], index: np.ndarray, *operands: Any
) -> list[np.ndarray]:
    """Evaluates the branches that lanes may take and picks each lane's own."""
    branches = [jaxprs.program(branch) for branch in eqn.params["branches"]]
    (choice,) = arrays.elements(index)
    if ops.is_constant(choice):
        taken = branches[min(max(int(choice), 0), len(branches) - 1)]
        return run(graph, taken, list(operands), used)
    results: list[Scalar] | None = None
    for k in _cheap_first(run, graph, branches, operands, used):
        needed = _takes(graph, choice, k, len(branches))
        results = _merge(run, graph, branches[k], operands, used, needed, results)
    scalars, packed = iter(results or ()), []
    for out in eqn.outvars:
        size = int(np.prod(out.aval.shape, dtype=int))
        packed.append(
            arrays.pack([next(scalars) for _ in range(size)], out.aval.shape, out.aval.dtype)
        )
    return packed


def _takes(graph: Graph, choice: Node, k: int, count: int) -> Scalar:
    """Tells which lanes take branch k; a choice out of range takes the nearest."""
    if choice.dtype == np.bool_:
        return choice if k else graph.call("not", choice)
    number = choice.dtype.type
    if k == 0:
        return graph.call("lt", choice, number(1))
    if k == count - 1:
        return graph.call("ge", choice, number(k))
    return graph.call("eq", choice, number(k))


def _cheap_first(run: Callable, graph: Graph, branches: list, operands: Any, used: Any) -> list:
    """Orders the branches so that an expensive one finds results to fall back on."""
    if len(branches) != 2:
        return list(range(len(branches)))
    first, _ = _try(run, graph, branches[0], operands, used)
    return [1, 0] if _is_expensive(graph, first) else [0, 1]


def _merge(
    run: Callable, graph: Graph, branch: Any, operands: Any, used: Any, needed: Scalar,
    fallback: list[Scalar] | None,
) -> list[Scalar]:  # fmt: skip
    """Adds one branch's results to those of the branches before it."""
    scope, trial = _try(run, graph, branch, operands, used)
    gated = _is_expensive(graph, scope) and isinstance(needed, Node) and needed not in graph.certain
    if not gated:
        results = _scalars(run(graph, branch, list(operands), used))
        return results if fallback is None else _choose(graph, needed, results, fallback)
    cold = fallback or [value.dtype.type(0) for value in trial]
    return _gate(run, graph, branch, operands, used, needed, cold)


def _gate(
    run: Callable, graph: Graph, branch: Any, operands: Any, used: Any, needed: Node, cold: list
) -> list[Scalar]:
    with graph.branch() as body:
        certain = set(graph.certain)
        graph.certain.add(needed)
        results = _scalars(run(graph, branch, list(operands), used))
        hot = _choose(graph, needed, results, cold)
        graph.certain = certain
    gate = Gate(graph.scope, graph.number(), needed, body, hot, cold)
    for position, (on, off) in enumerate(zip(hot, cold, strict=True)):
        varying = any(isinstance(value, Node) and value.varying for value in (on, off))
        leaf = None if same(on, off) else graph.leaf(on.dtype, varying, gate, position)
        gate.outs.append(leaf)
    return [off if out is None else out for out, off in zip(gate.outs, cold, strict=True)]


def _try(run: Callable, graph: Graph, branch: Any, operands: Any, used: Any) -> tuple[Scope, list]:
    """Evaluates a branch to see what it costs; what it makes is dropped."""
    with graph.branch() as scope:
        results = _scalars(run(graph, branch, list(operands), used))
    return scope, results


def _is_expensive(graph: Graph, scope: Scope) -> bool:
    return scope.has_loop or scope.cost > graph.branch_cost


def _choose(graph: Graph, needed: Scalar, on: list[Scalar], off: list[Scalar]) -> list[Scalar]:
    return [graph.select(needed, x, y) for x, y in zip(on, off, strict=True)]


def _scalars(results: list[np.ndarray]) -> list[Scalar]:
    return [scalar for array in results for scalar in arrays.elements(array)]
