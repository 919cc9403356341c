"""What a function says to be written out as: ``skippable``, ``whole``, ``any_lane``.

Where one episode is best computed in another way than many, a function asks ``is_written_out``
while it is traced: whoever writes it out traces it within ``writing_out``.

``skippable`` is a computation that changes nothing where it is not needed. ``scalar`` writes it out
as a branch that is skipped if no lane needs it. Of ``jax.lax.cond`` it also selects each lane's own
result, which costs an operation for each number; a skippable computation gives the same where a
lane does not need it.
"""

import functools
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax.extend import core
from jax.interpreters import ad, batching

from mjx_reinforce.engine.base import PyTree
from mjx_reinforce.engine.scalar import jaxprs

#: Up to which length a ``short_scan`` is written out, None where XLA compiles. JAX keeps what it
#: traced with one value of this apart from what it traced with another.
_UNROLLED = jax.make_user_context(None)


def writing_out(unrolled: int = 1) -> AbstractContextManager[None]:
    """Has what is traced within take the ways of what is written out.

    Args:
      unrolled: up to which length a ``short_scan`` is written out.
    """
    return _UNROLLED(unrolled)


def is_written_out() -> bool:
    """Returns whether what is traced now is written out, and not compiled by XLA."""
    return _UNROLLED.value is not None


def short_scan(step: Callable, init: PyTree, xs: PyTree) -> Any:
    """``lax.scan`` of what is written out; up to a length that the engine chooses, no loop is."""
    length = len(jax.tree.leaves(xs)[0])
    return jax.lax.scan(step, init, xs, unroll=length <= (_UNROLLED.value or 0))


#: Traced where it is written out. Its operands are the predicate, the leaves of ``otherwise``, and
#: what the computation reads.
_SKIPPABLE = core.Primitive("skippable")
_SKIPPABLE.multiple_results = True


def skippable(needed: jax.Array, compute: Callable[[], PyTree], otherwise: PyTree) -> Any:
    """Returns what ``compute`` does; it need not run where ``needed`` is False.

    Args:
      needed: [] bool. Where it is False, ``compute()`` equals ``otherwise``.
      compute: no arguments -> a result of the structure, shapes and dtypes of ``otherwise``.
      otherwise: the result where it is not needed.
    """
    if not is_written_out():
        return jax.lax.cond(needed, compute, lambda: otherwise)
    leaves, tree = jax.tree.flatten(otherwise)
    program, _ = jaxprs.trace(lambda: jax.tree.leaves(compute()))
    computation = jax.make_jaxpr(lambda *xs: jax.core.eval_jaxpr(program.jaxpr, xs))(
        *program.consts
    )
    results = _SKIPPABLE.bind(
        needed, *leaves, *program.consts, computation=computation, num_results=len(leaves)
    )
    return tree.unflatten(results)


def _plain_skippable(needed: Any, *operands: Any, computation: Any, num_results: int) -> list[Any]:
    otherwise, consts = list(operands[:num_results]), operands[num_results:]
    return jax.lax.cond(needed, lambda: core.jaxpr_as_fun(computation)(*consts), lambda: otherwise)


def _batched_skippable(operands: Sequence[Any], axes: Sequence[int | None], **params: Any) -> tuple:
    results = jax.vmap(functools.partial(_plain_skippable, **params), tuple(axes))(*operands)
    return results, [0] * len(results)


def _derivative_of_skippable(primals: Any, tangents: Any, **params: Any) -> tuple:
    plain = functools.partial(_plain_skippable, **params)
    return jax.jvp(plain, tuple(primals), tuple(map(ad.instantiate_zeros, tangents)))


ad.primitive_jvps[_SKIPPABLE] = _derivative_of_skippable
_SKIPPABLE.def_abstract_eval(lambda *_, computation, **__: computation.out_avals)
batching.primitive_batchers[_SKIPPABLE] = _batched_skippable


#: Its operands are those of the operation; it is traced only for backends that know it.
_WHOLE = core.Primitive("whole")
_WHOLE.multiple_results = True
_WHOLE.def_abstract_eval(
    lambda *_, results, **__: [jax.core.ShapedArray(shape, dtype) for _, shape, dtype in results]
)


def whole(
    name: str, results: Mapping[str, Any], *args: jax.Array, model: str = ""
) -> dict[str, jax.Array]:
    """Calls an operation that a backend knows by its name, where ``is_kept_whole``.

    Args:
      name: of the operation.
      results: of its results by name, their shapes and dtypes.
      *args: its operands.
      model: the digest of the ``PhysicsModel`` that it simulates; "" if it simulates none.
    """
    facts = tuple((field, x.shape, np.dtype(x.dtype)) for field, x in results.items())
    made = _WHOLE.bind(*args, name=name, results=facts, model=model)
    return dict(zip(results, made, strict=True))


def simulated_models(traced: jaxprs.Program) -> Iterator[str]:
    """Yields, once a call, the digests of the models that a program simulates by ``whole``."""
    for eqn in traced.jaxpr.eqns:
        if eqn.primitive is _WHOLE and eqn.params["model"]:
            yield eqn.params["model"]
        yield from itertools.chain(*map(simulated_models, jaxprs.subprograms(eqn.params.values())))


@jax.custom_batching.custom_vmap
def any_lane(predicate: jax.Array) -> jax.Array:
    """Returns whether a predicate holds in any lane, of this batch or of one mapped over it.

    A loop's or a branch's predicate that ``jax.vmap`` batches turns the loop into one that computes
    every lane, and the branch into a selection. This one is never batched: under an outer
    ``jax.vmap`` (say over seeds) it reduces over that axis too, so loops stay loops.

    Args:
      predicate: bools of any shape.

    Returns:
      One bool, the same for every lane of every mapped axis.
    """
    return jnp.any(predicate)


@any_lane.def_vmap
def _reduce_outer_axis(axis_size: int, in_batched: list[bool], predicate: jax.Array) -> Any:
    del axis_size, in_batched
    return any_lane(predicate), False
