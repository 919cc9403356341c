"""What a loop does to its carry, foreseen from the equations of its body.

``iterate`` finds that out scalar by scalar, and writes the body two to four times for it. Of a body
with loops inside that takes most of the time, and the variables of its jaxpr say as much.
"""

from collections.abc import Callable
from typing import Any

from mjx_reinforce.fused import jaxprs

#: The equations that call a program and return its results as they are.
_CALLS = ("pjit", "jit", "closed_call", "custom_jvp_call", "custom_vjp_call", "remat2")


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


def spread(step: Callable[[list[bool]], list[bool]], varying: list[bool]) -> list[bool]:
    """Returns which variables of the carry differ from lane to lane in some iteration.

    Args:
      step: which do after an iteration, given which do before it.
      varying: which do before the first.
    """
    while True:
        after = [v or s for v, s in zip(varying, step(varying), strict=True)]
        if after == varying:
            return varying
        varying = after


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
