"""``by_engine``: one result computed in two ways, for an engine that writes out and for XLA.

The choice is a primitive of our own, ``by_engine``, which carries both programs. XLA compiles
``many`` and never sees ``one``; ``fused`` writes ``one`` out. No other code chooses between the
two.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.core
import numpy as np
from jax.extend import core
from jax.interpreters import ad, batching, mlir

from mjx_reinforce.fused import jaxprs
from mjx_reinforce.types import PyTree

#: Its operands are those of both programs, which read what they need of them.
_CHOICE = core.Primitive("by_engine")
_CHOICE.multiple_results = True


def by_engine(one: Callable, many: Callable, *args: PyTree, may_unroll: bool = False) -> Any:
    """Computes ``many`` where XLA compiles it, and ``one`` where ``fused`` writes it out.

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
