"""``scalarize``: a function of one example, written out in scalars."""

import dataclasses
import functools
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from mjx_reinforce.engine.base import PyTree, is_key
from mjx_reinforce.engine.scalar import arrays, jaxprs, size
from mjx_reinforce.engine.scalar.backend import Backend
from mjx_reinforce.engine.scalar.graph import Graph
from mjx_reinforce.engine.scalar.nodes import Scalar
from mjx_reinforce.engine.scalar.passes import liveness
from mjx_reinforce.engine.scalar.primitives import writing_out
from mjx_reinforce.engine.scalar.rules import indexing, loops, reductions, structural

_ARRAY_RULES = {**structural.RULES, **reductions.RULES, **indexing.RULES}
#: What makes keys of words and words of keys.
_KEYS_TO_WORDS = ("random_wrap", "random_unwrap")
_CONTROL_RULES = {
    "while": loops.while_rule,
    "scan": loops.scan_rule,
    "cond": loops.cond_rule,
    "skippable": loops.skippable_rule,
    "whole": loops.whole_rule,
}


@dataclasses.dataclass(frozen=True)
class Scalarized:
    """A function written out in scalars.

    in_avals: shape and dtype of each leaf of the arguments.
    out_tree: the structure of its result.
    out_avals: shape and dtype of each leaf of the result.
    outputs: the scalars of each leaf of the result.
    schedule: the steps that compute them.
    captured: arrays that it closes over and that an outer transformation traces; they are further
      inputs, behind those of its arguments.
    """

    in_avals: list[Any]
    out_tree: Any
    out_avals: list[Any]
    outputs: list[list[Scalar]]
    schedule: liveness.Schedule
    captured: list[jax.Array]

    def compile(self, backend: Backend) -> Any:
        """Returns what a backend makes of the function."""
        return backend.compile(self.schedule, self.outputs)

    @property
    def operations(self) -> Counter[str]:
        """How many scalar operations it takes, by name; a loop's body counts once."""
        return Counter(node.op.name for node in liveness.nodes(self.schedule) if node.op)


def scalarize(fn: Callable, *examples: PyTree, branch_cost: int = 400) -> Scalarized:
    """Writes a function out in scalars, for a backend.

    Args:
      fn: a function of one example.
      *examples: its arguments, or their ``jax.ShapeDtypeStruct``s.
      branch_cost: a branch of ``cond`` with more operations than this, or with a loop, is skipped
        where no lane needs it; others are computed for every lane.
    """
    return build(*trace(fn, *examples), branch_cost)


def trace(fn: Callable, *examples: PyTree, unrolled: int = 1) -> tuple[jaxprs.Program, Any]:
    """Returns a function's program to be written out, and the shapes of its result.

    Args:
      fn: a function of one example.
      *examples: its arguments, or their shapes.
      unrolled: see ``writing_out``.
    """
    with writing_out(unrolled):
        return jaxprs.trace(fn, *examples)


def build(
    program: jaxprs.Program,
    out_shape: Any,
    branch_cost: int,
    scans: int = 4,
    varying: Sequence[bool] | None = None,
    entries: int = 0,
) -> Scalarized:
    """Writes a function out.

    Args:
      program: of ``trace``.
      out_shape: of its result.
      branch_cost: as in ``scalarize``.
      scans: up to which length scans are written out.
      varying: which of its arguments differ from lane to lane; all do if nothing is said.
      entries: of an observation.

    Raises:
      TooLarge: it is more than is written out.
      UnsupportedPrimitive: it uses a primitive that has no rule.
    """
    if any(is_key(variable.aval) for variable in program.jaxpr.invars):
        raise jaxprs.no_keys()
    # Before anything is written, which takes seconds to minutes.
    size.check_size(program, entries)
    graph = Graph(branch_cost, scans)
    in_avals = [variable.aval for variable in program.jaxpr.invars]
    if varying is None:
        varying = [True] * len(in_avals)
    # Constants that an outer transformation traces are further inputs, of which all lanes have the
    # same.
    closures = [*filter(jaxprs.is_traced, program.consts)]
    facts = [*zip(in_avals, varying, strict=True), *((jax.typeof(x), False) for x in closures)]
    inputs = [_input_array(graph, k, aval, is_lane) for k, (aval, is_lane) in enumerate(facts)]
    captured_inputs = dict(zip(map(id, closures), inputs[len(in_avals) :], strict=True))
    program = program._replace(consts=[captured_inputs.get(id(x), x) for x in program.consts])
    # Folding may divide by zero in a branch that no lane takes.
    with np.errstate(all="ignore"):
        leaves = run(graph, program, inputs[: len(in_avals)])
    outputs = [arrays.elements(leaf) for leaf in leaves]
    out_avals, out_tree = jax.tree.flatten(out_shape)
    return Scalarized(
        in_avals=in_avals,
        out_tree=out_tree,
        out_avals=out_avals,
        outputs=outputs,
        schedule=liveness.schedule(graph.scope, (x for leaf in outputs for x in leaf)),
        captured=closures,
    )


def _input_array(graph: Graph, number: int, aval: Any, varying: bool) -> np.ndarray:
    places = [(number, k) for k in range(int(np.prod(aval.shape, dtype=int)))]
    leaves = [graph.leaf(aval.dtype, varying, position=place) for place in places]
    return arrays.pack(leaves, aval.shape, aval.dtype)


def run(
    graph: Graph,
    program: jaxprs.Program,
    args: list[np.ndarray],
    live: list[bool] | None = None,
) -> list[np.ndarray]:
    """Returns a program's outputs.

    Args:
      graph: where nodes are made.
      program: what is evaluated.
      args: its arguments.
      live: which of its outputs something reads; others are zeros, and nothing is computed for
        them.
    """
    jaxpr = program.jaxpr
    if live is None:
        live = [True] * len(jaxpr.outvars)
    values = dict(zip(jaxpr.invars, args, strict=True))
    for variable, const in zip(jaxpr.constvars, program.consts, strict=True):
        values[variable] = jaxprs.as_numpy(const)

    def read(atom: Any) -> np.ndarray:
        return jaxprs.literal_value(atom) if jaxprs.is_literal(atom) else values[atom]

    for eqn, live_results in jaxprs.live_equations(jaxpr, live):
        outputs = _apply(graph, eqn, live_results, [read(atom) for atom in eqn.invars])
        values.update(zip(eqn.outvars, outputs, strict=True))
    return [
        read(out) if is_live else arrays.zeros(out.aval)
        for out, is_live in zip(jaxpr.outvars, live, strict=True)
    ]


def _apply(
    graph: Graph, eqn: jaxprs.Equation, live: list[bool], operands: list[np.ndarray]
) -> list:
    """Applies the rule of one equation; what has no rule may call a program that can be run."""
    name = eqn.primitive.name
    if name in _CONTROL_RULES:
        with graph.evaluating(eqn):
            return _CONTROL_RULES[name](graph, functools.partial(run, graph), eqn, live, *operands)
    if name in _ARRAY_RULES:
        if name not in _KEYS_TO_WORDS and any(is_key(atom.aval) for atom in eqn.invars):
            return _word_by_word(graph, eqn, operands)
        outputs = zip(_ARRAY_RULES[name](graph, eqn, *operands), eqn.outvars, strict=True)
        return [arrays.settle(leaf, out.aval.dtype) for leaf, out in outputs]
    program = jaxprs.callee(eqn)
    if program is not None:
        with graph.evaluating(eqn):
            return run(graph, program, operands, live)
    # JAX computes what is left of constants. Keys it would return as keys, not as their words.
    makes_keys = any(is_key(out.aval) for out in eqn.outvars)
    if all(map(arrays.is_numeric, operands)) and not makes_keys:
        return jaxprs.compute_constants(eqn.primitive.bind, eqn.params, operands)
    raise jaxprs.no_rule(name, graph.source(eqn))


def _word_by_word(graph: Graph, eqn: jaxprs.Equation, operands: list[np.ndarray]) -> list:
    """Applies a rule that moves keys, whose words are their arrays' last axis."""
    is_key_arg = [is_key(atom.aval) for atom in eqn.invars]
    rule = _ARRAY_RULES[eqn.primitive.name]
    word_eqn = jaxprs.on_words(eqn)
    planes = []
    for k in range(operands[is_key_arg.index(True)].shape[-1]):
        # The k-th word of each key; indices and such are the same for all words.
        plane = [
            x[..., k] if has_words else x for x, has_words in zip(operands, is_key_arg, strict=True)
        ]
        planes.append(rule(graph, word_eqn, *plane))
    return [np.stack(arrays.together(words), -1) for words in zip(*planes, strict=True)]
