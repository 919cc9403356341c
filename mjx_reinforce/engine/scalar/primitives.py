"""What a function says to be written out as: ``by_engine``, ``skippable``, ``whole``, ``any_lane``.

``by_engine`` has one result computed in two ways. The choice is a primitive of our own, which
carries both programs. XLA compiles ``many`` and never sees ``one``; ``scalar`` writes ``one`` out.
No other code chooses between the two.

``skippable`` is a computation that changes nothing where it is not needed. ``scalar`` writes it out
as a branch that is skipped if no lane needs it. Of ``jax.lax.cond`` it also selects each lane's own
result, which costs an operation for each number; a skippable computation gives the same where a
lane does not need it.
"""

import functools
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax.extend import core
from jax.interpreters import ad, batching, mlir

from mjx_reinforce.engine.base import PyTree
from mjx_reinforce.engine.scalar import jaxprs

#: Its operands are those of both programs, which read what they need of them.
_CHOICE = core.Primitive("by_engine")
_CHOICE.multiple_results = True


def by_engine(one: Callable, many: Callable, *args: PyTree, may_unroll: bool = False) -> Any:
    """Computes ``many`` where XLA compiles it, and ``one`` where ``scalar`` writes it out.

    The derivative is that of ``many``, for all engines.

    Args:
      one: best where an episode takes its own branches.
      many: best where many episodes are computed at once; it returns the same.
      *args: arguments of both.
      may_unroll: whether the scans of ``one`` may be written out, those outside of its loops and
        branches. Up to which length they are is the engine's ``Limits.unrollable``.

    Raises:
      TypeError: the results of ``one`` and ``many`` differ in structure, shape or dtype.
    """
    if not isinstance(jax.numpy.zeros(()), jax.core.Tracer):  # nothing is traced: XLA computes now
        return many(*args)
    leaves, tree = jax.tree.flatten(args)
    (first, shapes), (second, others) = (
        jaxprs.trace(lambda *flat, f=f: f(*tree.unflatten(flat)), *leaves) for f in (one, many)
    )
    if _signature(shapes) != _signature(others):
        raise TypeError(f"by_engine got two different results, {shapes} and {others}")
    consts = [*first.consts, *second.consts]
    start, end = len(first.consts), len(consts)
    operands = [*consts, *leaves]
    results = _CHOICE.bind(
        *operands,
        one=_without_consts(first.jaxpr, slice(0, start), end, operands),
        many=_without_consts(second.jaxpr, slice(start, end), end, operands),
        may_unroll=may_unroll,
    )
    return jax.tree.structure(shapes).unflatten(results)


def _signature(shapes: Any) -> tuple[Any, list[tuple]]:
    leaves, tree = jax.tree.flatten(shapes)
    return tree, [(leaf.shape, np.dtype(leaf.dtype)) for leaf in leaves]


def _without_consts(jaxpr: Any, consts: slice, end: int, operands: Sequence[Any]) -> Any:
    """Returns a program of all operands, of which the first ``end`` are constants of programs."""
    return jax.make_jaxpr(lambda *xs: jax.core.eval_jaxpr(jaxpr, xs[consts], *xs[end:]))(*operands)


def _many(*operands: PyTree, many: Any, **_: Any) -> list[Any]:
    return core.jaxpr_as_fun(many)(*operands)


def _batched(operands: Sequence[Any], axes: Sequence[int | None], **params: Any) -> tuple:
    """Maps both programs; a result that depends on nothing mapped stays as it is."""
    mapped = [axis is not None for axis in axes]
    one, many = params["one"], params["many"]
    spread = np.any([_unmapped(one, mapped), jaxprs.depends(many, mapped)], axis=0)
    out_axes = [0 if wide else None for wide in spread]
    results = _CHOICE.bind(
        *operands,
        one=_Mapped(one, tuple(axes), out_axes, list(map(jax.typeof, operands))),
        many=jax.make_jaxpr(jax.vmap(core.jaxpr_as_fun(many), tuple(axes), out_axes))(*operands),
        may_unroll=params["may_unroll"],
    )
    return results, out_axes


class _Mapped:
    """A program mapped over one axis more; traced when it is first read, which XLA never does.

    It is read as a closed jaxpr is.
    """

    def __init__(self, program: Any, axes: tuple, out_axes: list, shapes: list[Any]):
        self.program, self._axes, self._out_axes, self._shapes = program, axes, out_axes, shapes

    @functools.cached_property
    def _traced(self) -> Any:
        """The closed jaxpr."""
        program = self.program._traced if isinstance(self.program, _Mapped) else self.program
        mapped = jax.vmap(core.jaxpr_as_fun(program), self._axes, self._out_axes)
        return jax.make_jaxpr(mapped)(*self._shapes)

    @property
    def jaxpr(self) -> Any:
        """Its equations."""
        return self._traced.jaxpr

    @property
    def consts(self) -> list[Any]:
        """The values of its constant variables."""
        return self._traced.consts

    def __repr__(self) -> str:
        return repr(self._traced)


def _unmapped(program: Any, given: Sequence[bool]) -> list[bool]:
    """Returns ``jaxprs.depends``, which mapping does not change, without reading what is mapped."""
    while isinstance(program, _Mapped):
        program = program.program
    return jaxprs.depends(program, given)


def _derivative(primals: Sequence[Any], tangents: Sequence[Any], *, many: Any, **_: Any) -> Any:
    filled = tuple(map(ad.instantiate_zeros, tangents))
    return jax.jvp(core.jaxpr_as_fun(many), tuple(primals), filled)


_CHOICE.def_impl(_many)
_CHOICE.def_abstract_eval(lambda *_, many, **__: many.out_avals)
batching.primitive_batchers[_CHOICE] = _batched
ad.primitive_jvps[_CHOICE] = _derivative
mlir.register_lowering(_CHOICE, mlir.lower_fun(_many, multiple_results=True))


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


def _plain_skippable(needed: Any, *operands: Any, computation: Any, num_results: int) -> list[Any]:
    otherwise, consts = list(operands[:num_results]), operands[num_results:]
    return jax.lax.cond(needed, lambda: core.jaxpr_as_fun(computation)(*consts), lambda: otherwise)


def _batched_skippable(operands: Sequence[Any], axes: Sequence[int | None], **params: Any) -> tuple:
    results = jax.vmap(functools.partial(_plain_skippable, **params), tuple(axes))(*operands)
    return results, [0] * len(results)


_SKIPPABLE.def_impl(_plain_skippable)
_SKIPPABLE.def_abstract_eval(lambda *_, computation, **__: computation.out_avals)
batching.primitive_batchers[_SKIPPABLE] = _batched_skippable
mlir.register_lowering(_SKIPPABLE, mlir.lower_fun(_plain_skippable, multiple_results=True))


#: Its operands are those of the operation; it is traced only for backends that know it.
_WHOLE = core.Primitive("whole")
_WHOLE.multiple_results = True
_WHOLE.def_abstract_eval(
    lambda *_, results, **__: [jax.core.ShapedArray(shape, dtype) for _, shape, dtype in results]
)


def whole(
    name: str, results: Mapping[str, Any], *args: jax.Array, owner: str = ""
) -> dict[str, jax.Array]:
    """Calls an operation that a backend knows by its name, where ``is_kept_whole``.

    Args:
      name: of the operation.
      results: of its results by name, their shapes and dtypes.
      *args: its operands.
      owner: whose operation it is, as ``hex(id(env))``; "" if it is everybody's.
    """
    facts = tuple((field, x.shape, np.dtype(x.dtype)) for field, x in results.items())
    made = _WHOLE.bind(*args, name=name, results=facts, owner=owner)
    return dict(zip(results, made, strict=True))


def owners(traced: jaxprs.Program) -> Iterator[str]:
    """Yields, once a call, whose operations a program calls by their names."""
    for eqn in traced.jaxpr.eqns:
        if eqn.primitive is _WHOLE and eqn.params["owner"]:
            yield eqn.params["owner"]
        yield from itertools.chain(*map(owners, jaxprs.subprograms(eqn.params.values())))


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
