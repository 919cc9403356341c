"""How large a program is when it is written out, found in a moment from its equations.

For HalfCheetah, Humanoid and observations of 500 and 1,000 entries this was 0.89 to 1.15 times what
was then written, before the entries that a scan stores and loads were counted.
"""

import math
from collections.abc import Mapping
from typing import Any

from mjx_reinforce.engine.scalar import jaxprs
from mjx_reinforce.engine.scalar.nodes import OP_TRAITS

#: What is larger takes more than some 80 s to write and compile. On two quiet cores a training had
#: started after 48 s with Humanoid-v5 (1.9 million), 54 s with dm_control's humanoid (2.7 million).
MAX_SCALARS = 4_000_000
#: LLVM holds all entries of an observation at once, and each pair takes as long as so many scalars:
#: with 500 and 2,000 entries a training had started after 19 s and 116 s.
_PER_PAIR = 1.35
#: A loop's body is written again and again until what never changes in it is known.
_LOOP = 2
_ELEMENTWISE = {*OP_TRAITS, "integer_pow", "square", "add_any", "clamp"}


class TooLarge(NotImplementedError):  # noqa: N818 (reads as what it is)
    """A function that is too large to be written out."""


def check_size(program: jaxprs.Program, entries: int = 0) -> None:
    """Raises TooLarge for a program that is not to be written out.

    Args:
      program: what is written out.
      entries: of an observation.
    """
    step = num_scalars(program)
    pairs = _PER_PAIR * entries**2
    if step + pairs > MAX_SCALARS:
        remedy = f"let it observe fewer than {entries:,} numbers"
        if step > pairs:
            remedy = "let fewer geoms collide, such as the feet alone"
        raise TooLarge(
            f"written out it is about {step + pairs:.2g} scalar operations, more than "
            f"{MAX_SCALARS:.2g}; {remedy}"
        )


def num_scalars(program: jaxprs.Program) -> int:
    """Returns about how many scalar operations are written, those that fold away included."""
    # ``platform_dependent`` is a ``cond`` over such a number, of which one branch is written.
    defaults = {
        eqn.outvars[0]: jaxprs.default_platform(eqn)
        for eqn in program.jaxpr.eqns
        if eqn.primitive.name == "platform_index"
    }
    return sum(_equation_size(eqn, defaults) for eqn in program.jaxpr.eqns)


def _equation_size(eqn: Any, defaults: Mapping[Any, int | None]) -> int:
    """Returns the size of one equation.

    Args:
      eqn: the equation.
      defaults: for each number that ``platform_index`` returns, the default branch.
    """
    name = eqn.primitive.name
    params = eqn.params
    if name == "cond":
        sizes = [num_scalars(jaxprs.program(branch)) for branch in params["branches"]]
        index = eqn.invars[0]
        default = None
        if not jaxprs.is_literal(index):
            default = defaults.get(index)
        if default is None:
            return sum(sizes)
        return sizes[default]
    if name == "skippable":
        return num_scalars(jaxprs.program(params["computation"]))
    if name == "while":
        bodies = (params[param] for param in ("cond_jaxpr", "body_jaxpr"))
        return _LOOP * sum(num_scalars(jaxprs.program(body)) for body in bodies)
    if name == "scan":
        body = min(_LOOP, params["length"]) * num_scalars(jaxprs.program(params["jaxpr"]))
        return body + _entries(eqn.invars) + _entries(eqn.outvars)
    num_results = _entries(eqn.outvars)
    if name == "dot_general":
        (sum_axes, _), _ = params["dimension_numbers"]
        # A product and a sum for each pair of contracted entries.
        return 2 * num_results * math.prod(eqn.invars[0].aval.shape[axis] for axis in sum_axes)
    if name in ("cholesky", "triangular_solve"):
        # An entry of the result is a sum over a row that is half full on average: n products and
        # sums.
        return num_results * eqn.invars[0].aval.shape[-1]
    if name in _ELEMENTWISE:
        return num_results
    if name.startswith(("reduce_", "cum", "arg")):
        return _entries(eqn.invars)
    # Others move elements about, which costs nothing, or call a program.
    program = jaxprs.callee(eqn)
    if program is None:
        return 0
    return num_scalars(program)


def _entries(atoms: Any) -> int:
    """Returns how many entries arrays have, of which a loop stores and loads each."""
    return sum(math.prod(atom.aval.shape) for atom in atoms)
