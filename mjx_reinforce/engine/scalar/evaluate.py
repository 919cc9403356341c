"""Evaluates a program on arrays of scalars, equation by equation."""

import functools
from typing import Any

import numpy as np

from mjx_reinforce.engine.base import is_key
from mjx_reinforce.engine.scalar import arrays, jaxprs
from mjx_reinforce.engine.scalar.graph import Graph
from mjx_reinforce.engine.scalar.rules import indexing, loops, reductions, structural

_ARRAY_RULES = {**structural.RULES, **reductions.RULES, **indexing.RULES}
#: What makes keys of words and words of keys.
_KEYS_TO_WORDS = ("random_wrap", "random_unwrap")
_CONTROL = {
    "while": loops.while_rule,
    "scan": loops.scan_rule,
    "cond": loops.cond_rule,
    "skippable": loops.skippable_rule,
    "whole": loops.whole_rule,
}


def run(
    graph: Graph,
    program: jaxprs.Program,
    args: list[np.ndarray],
    used: list[bool] | None = None,
) -> list[np.ndarray]:
    """Returns a program's outputs.

    Args:
      graph: where nodes are made.
      program: what is evaluated.
      args: its arguments.
      used: which of its outputs are; others are zeros, and nothing is computed for them.
    """
    jaxpr = program.jaxpr
    used = [True] * len(jaxpr.outvars) if used is None else used
    values = dict(zip(jaxpr.invars, args, strict=True))
    for variable, const in zip(jaxpr.constvars, program.consts, strict=True):
        values[variable] = jaxprs.as_numpy(const)

    def read(atom: Any) -> np.ndarray:
        return jaxprs.literal_value(atom) if jaxprs.is_literal(atom) else values[atom]

    for eqn, needed in jaxprs.live_equations(jaxpr, used):
        results = _apply(graph, eqn, needed, [read(atom) for atom in eqn.invars])
        values.update(zip(eqn.outvars, results, strict=True))
    return [
        read(out) if use else arrays.zeros(out.aval)
        for out, use in zip(jaxpr.outvars, used, strict=True)
    ]


def _apply(
    graph: Graph, eqn: jaxprs.Equation, used: list[bool], operands: list[np.ndarray]
) -> list:
    """Applies the rule of one equation; what has no rule may call a program that can be run."""
    name = eqn.primitive.name
    if name in _CONTROL:
        with graph.evaluating(eqn):
            return _CONTROL[name](graph, functools.partial(run, graph), eqn, used, *operands)
    if name in _ARRAY_RULES:
        if name not in _KEYS_TO_WORDS and any(is_key(atom.aval) for atom in eqn.invars):
            return _word_by_word(graph, eqn, operands)
        results = zip(_ARRAY_RULES[name](graph, eqn, *operands), eqn.outvars, strict=True)
        return [arrays.settle(result, out.aval.dtype) for result, out in results]
    program = jaxprs.callee(eqn)
    if program is not None:
        with graph.evaluating(eqn):
            return run(graph, program, operands, used)
    makes_keys = any(is_key(out.aval) for out in eqn.outvars)
    if all(map(arrays.is_numeric, operands)) and not makes_keys:
        return jaxprs.compute_constants(eqn.primitive.bind, eqn.params, operands)
    raise jaxprs.no_rule(name, graph.source(eqn))


def _word_by_word(graph: Graph, eqn: jaxprs.Equation, operands: list[np.ndarray]) -> list:
    """Applies a rule that moves keys, whose words are their arrays' last axis."""
    keys = [is_key(atom.aval) for atom in eqn.invars]
    rule, one = _ARRAY_RULES[eqn.primitive.name], jaxprs.on_words(eqn)
    planes = []
    for k in range(operands[keys.index(True)].shape[-1]):
        plane = [x[..., k] if key else x for x, key in zip(operands, keys, strict=True)]
        planes.append(rule(graph, one, *plane))
    return [np.stack(arrays.together(words), -1) for words in zip(*planes, strict=True)]
