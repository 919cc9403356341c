"""``skippable``: a computation that changes nothing where it is not needed.

``fused`` writes it out as a branch that is skipped if no lane needs it. Of ``jax.lax.cond`` it also
selects each lane's own result, which costs an operation for each number; a skippable computation
gives the same where a lane does not need it.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.core
from jax.extend import core
from jax.interpreters import batching, mlir

from mjx_reinforce.fused import jaxprs
from mjx_reinforce.types import PyTree

#: Its operands are the predicate, the leaves of ``otherwise``, and what the computation reads.
_SKIPPABLE = core.Primitive("skippable")
_SKIPPABLE.multiple_results = True


def skippable(needed: jax.Array, compute: Callable[[], PyTree], otherwise: PyTree) -> Any:
    """Returns what ``compute`` does; it need not run where ``needed`` is False.

    Args:
      needed: [] bool. Where it is False, ``compute()`` equals ``otherwise``.
      compute: no arguments -> a result of the structure, shapes and dtypes of ``otherwise``.
      otherwise: the result where it is not needed.
    """
    leaves, tree = jax.tree.flatten(otherwise)
    program, _ = jaxprs.trace(lambda: jax.tree.leaves(compute()))
    computation = jax.make_jaxpr(lambda *xs: jax.core.eval_jaxpr(program.jaxpr, xs))(
        *program.consts
    )
    results = _SKIPPABLE.bind(
        needed, *leaves, *program.consts, computation=computation, num_results=len(leaves)
    )
    return tree.unflatten(results)


def _plain(needed: Any, *operands: Any, computation: Any, num_results: int) -> list[Any]:
    otherwise, consts = list(operands[:num_results]), operands[num_results:]
    return jax.lax.cond(needed, lambda: core.jaxpr_as_fun(computation)(*consts), lambda: otherwise)


def _batched(operands: Sequence[Any], axes: Sequence[int | None], **params: Any) -> tuple:
    results = jax.vmap(functools.partial(_plain, **params), tuple(axes))(*operands)
    return results, [0] * len(results)


_SKIPPABLE.def_impl(_plain)
_SKIPPABLE.def_abstract_eval(lambda *_, computation, **__: computation.out_avals)
batching.primitive_batchers[_SKIPPABLE] = _batched
mlir.register_lowering(_SKIPPABLE, mlir.lower_fun(_plain, multiple_results=True))
