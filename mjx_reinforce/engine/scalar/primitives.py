"""The three ways of tracing a function, and what a function says to be written out as.

An environment, its physics and its policy are written once, as JAX. They are traced in one of three
ways, and where one is best computed otherwise than another, the function asks which one it is. The
way is part of the context, not an argument: MJX and flax stand between the one who sets it and the
one who asks. JAX keeps what it traced in one way apart from what it traced in another.

==============  ======================================================================
way             who sets it, and what becomes of the program
==============  ======================================================================
for XLA         Nobody: the default. ``jax.vmap`` maps the function over episodes, and
                XLA compiles passes over arrays.
written out     ``writing_out``, in ``scalarized.trace``: for machine code on CPUs, for
                threads of GPUs, and for ``scalar.vmap``. Arrays become scalars; loops
                and branches stay. ``unrolled`` is 1 on CPUs and 25 on GPUs, where what
                a loop reads is in memory. ``physics/touching.py`` sets it to 1 again
                around code that rarely runs or would be long.
kept whole      ``base.keeping_whole``, in ``play/program.py`` around
                ``scalarized.trace``: for teams of lanes. The program is written out,
                but physics and layers of the policy are single operations, which the
                C++ of ``team`` knows. ``base.shapes`` sets it too, so that asking for
                shapes does not trace the physics.
==============  ======================================================================

Who asks, and why (kept by hand: a new caller adds its row):

====================================  =============================================================
``is_written_out``
====================================  =============================================================
``play/units.py``                     the policy: a loop over units is short, a product of matrices
                                      would be thousands of scalars
``physics/contacts.py``               geoms collide pair by pair, and pairs that are apart are
                                      skipped; XLA takes all at once. And a search stays a loop
``physics/rows.py``                   rows contact by contact, skipped where nothing touches
``physics/contact_rows.py``           products with the Jacobian by contacts, skipped likewise; XLA
                                      multiplies whole matrices
``physics/touching.py``               contacts that touch are packed, so that loops are short
``physics/early_stop.py``             rows one after the other: in one block LLVM takes minutes
``physics/inertia.py``                elimination from the leaves of the tree of bodies, whose zeros
                                      fold away; XLA takes MJX's own
``skippable``                         XLA has ``jax.lax.cond`` instead
====================================  =============================================================

====================================  =============================================================
``base.is_kept_whole``
====================================  =============================================================
``envs/dynamics.py``                  whether ``whole`` stands for the steps of the physics; for
                                      shapes alone (``base.is_for_shapes``) it always does
``play/units.py``                     whether ``whole`` stands for a layer of the network
====================================  =============================================================

What a function may say, in any of the ways:

- ``short_scan`` is a loop that is written out up to the length ``unrolled``. The physics uses it
  for contacts and rows.
- ``skippable`` is a computation that changes nothing where it is not needed. It is written out as a
  branch that is skipped if no lane needs it. Of ``jax.lax.cond`` each lane's own result is also
  selected, which costs an operation for each number; a skippable computation gives the same where a
  lane does not need it. ``physics/contact_rows.py`` and ``physics/newton.py`` add contacts so.
- ``whole`` calls an operation that a backend knows by its name, only where it is kept whole.
- ``any_lane`` is for XLA alone: a predicate that stays one bool under ``jax.vmap``. ``vmap`` uses
  it for loops and branches, ``episode.while_any`` and ``training/wrappers.py`` to end early over
  seeds.
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
    # The rule of ``scan`` writes out what is to be unrolled wholly, whatever its own limit is.
    return jax.lax.scan(step, init, xs, unroll=length <= (_UNROLLED.value or 0))


#: Traced where it is written out. Its operands are the predicate, the leaves of ``default``, and
#: what the computation reads.
_SKIPPABLE = core.Primitive("skippable")
_SKIPPABLE.multiple_results = True


def skippable(is_needed: jax.Array, compute: Callable[[], PyTree], default: PyTree) -> Any:
    """Returns what ``compute`` does; it need not run where ``is_needed`` is False.

    Args:
      is_needed: [] bool. Where it is False, ``compute()`` equals ``default``.
      compute: no arguments -> a result of the structure, shapes and dtypes of ``default``.
      default: the result where it is not needed.
    """
    if not is_written_out():
        return jax.lax.cond(is_needed, compute, lambda: default)
    leaves, tree = jax.tree.flatten(default)
    # What the computation reads of the trace around it becomes operands: a primitive's parameters
    # must not hold values of a trace.
    program, _ = jaxprs.trace(lambda: jax.tree.leaves(compute()))
    computation = jax.make_jaxpr(lambda *xs: jax.core.eval_jaxpr(program.jaxpr, xs))(
        *program.consts
    )
    outputs = _SKIPPABLE.bind(
        is_needed, *leaves, *program.consts, computation=computation, num_results=len(leaves)
    )
    return tree.unflatten(outputs)


def _plain_skippable(flag: Any, *operands: Any, computation: Any, num_results: int) -> list[Any]:
    default = list(operands[:num_results])
    consts = operands[num_results:]
    return jax.lax.cond(flag, lambda: core.jaxpr_as_fun(computation)(*consts), lambda: default)


def _batched_skippable(operands: Sequence[Any], axes: Sequence[int | None], **params: Any) -> tuple:
    # Mapped, one example may need it where another does not: as a ``cond`` it becomes a selection.
    outputs = jax.vmap(functools.partial(_plain_skippable, **params), tuple(axes))(*operands)
    return outputs, [0] * len(outputs)


def _derivative_of_skippable(primals: Any, tangents: Any, **params: Any) -> tuple:
    function = functools.partial(_plain_skippable, **params)
    # ``jvp`` takes no symbolic zeros, which stand for operands that nothing is differentiated by.
    return jax.jvp(function, tuple(primals), tuple(map(ad.instantiate_zeros, tangents)))


ad.primitive_jvps[_SKIPPABLE] = _derivative_of_skippable
_SKIPPABLE.def_abstract_eval(lambda *_, computation, **__: computation.out_avals)
batching.primitive_batchers[_SKIPPABLE] = _batched_skippable


#: Its operands are those of the operation; it is traced only for backends that know it.
_WHOLE_PRIMITIVE = core.Primitive("whole")
_WHOLE_PRIMITIVE.multiple_results = True
_WHOLE_PRIMITIVE.def_abstract_eval(
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
    arrays = _WHOLE_PRIMITIVE.bind(*args, name=name, results=facts, model=model)
    return dict(zip(results, arrays, strict=True))


def simulated_models(root: jaxprs.Program) -> Iterator[str]:
    """Yields, once a call, the digests of the models that a program simulates by ``whole``."""
    for eqn in root.jaxpr.eqns:
        if eqn.primitive is _WHOLE_PRIMITIVE and eqn.params["model"]:
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
def _reduce_outer_axis(axis_size: int, is_batched: list[bool], predicate: jax.Array) -> Any:
    del axis_size, is_batched
    # The array with its new axis is reduced as a whole, so the result is the same for all examples.
    return any_lane(predicate), False
