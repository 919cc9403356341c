"""A function of one example over a batch, in machine code: ``jax.vmap`` for simulations."""

from collections.abc import Callable
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from mjx_reinforce.engine.base import PyTree
from mjx_reinforce.engine.cpu import handler, machine, seam
from mjx_reinforce.engine.cpu.mapping import POSITIONS, mapping_text
from mjx_reinforce.engine.gpu import seam as gpu_seam
from mjx_reinforce.engine.gpu.mapping import mapping_text as gpu_mapping_text
from mjx_reinforce.engine.play import program
from mjx_reinforce.engine.play.native_step import stored
from mjx_reinforce.engine.scalar import jaxprs, scalarized

#: Raises TooLarge for a program that takes too long to write and compile.
SizeCheck: TypeAlias = Callable[[jaxprs.Program], None]


def machine_map(
    function: Callable[..., Any],
    *examples: PyTree,
    check: SizeCheck = lambda traced: None,
    name: str = "a function",
) -> Callable[..., Any]:
    """Returns a function of a batch, compiled unless memory or disk has it.

    What it returns is as ``jax.vmap(function)`` up to rounding. All threads that XLA has compute
    it, or those of the GPU. Call it inside of any transformation except differentiation; vmapped,
    it remains one call.

    Args:
      function: of one example; pytrees of numbers of 32 or 64 bits and bools, in and out.
      *examples: its arguments, or their shapes.
      check: raises TooLarge where writing it out and compiling it takes too long.
      name: of the function, for people.

    Raises:
      TooLarge: writing it out would take minutes.
      UnsupportedPrimitive: it has an operation that cannot be written.
      TypeError: numbers of another size.
    """
    leaves, tree = jax.tree.flatten(examples)
    given = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in leaves]

    def flat(*values: jax.Array) -> list[Any]:
        whole = [x != 0 if leaf.dtype == bool else x for x, leaf in zip(values, given, strict=True)]
        return [stored(x) for x in jax.tree.leaves(function(*tree.unflatten(whole)))]

    out = jax.eval_shape(function, *examples)
    results, out_tree = jax.tree.flatten(out)
    kept = [jax.eval_shape(stored, x) for x in given]
    for leaf in (*kept, *map(jax.eval_shape, [stored] * len(results), results)):
        if np.dtype(leaf.dtype).itemsize not in (4, 8):
            raise TypeError(f"it has numbers of {leaf.dtype}, not of 32 or 64 bits")
    code, _ = program.load("map", name, flat, kept, check, _write_cpu, gpu_mapping_text)

    def mapped(*args: PyTree) -> Any:
        values = jax.tree.leaves(args)
        num = values[0].shape[0]
        rows = [stored(x).reshape(num, -1) for x in values if x.size]
        shapes = [
            jax.ShapeDtypeStruct((num, x.size), jnp.int32 if x.dtype == bool else x.dtype)
            for x in results
            if x.size
        ]
        if isinstance(code, machine.Code):
            made = iter(seam.call(code, shapes, jnp.int32(0), *rows))
        else:
            made = iter(gpu_seam.launch_map(code, shapes, *rows))
        return out_tree.unflatten(
            next(made).reshape(num, *x.shape).astype(x.dtype)
            if x.size
            else jnp.zeros((num, *x.shape), x.dtype)
            for x in results
        )

    return mapped


def _write_cpu(written: scalarized.Scalarized, target: machine.Machine) -> str:
    """Writes a function, and all around it, as LLVM IR."""
    num_args = 1 + sum(bool(np.prod(x.shape)) for x in written.in_avals)
    sizes = [np.dtype(x.dtype).itemsize for x in written.out_avals if np.prod(x.shape)]
    entry = handler.handler_text(num_args, sizes, target.lanes, POSITIONS, zeroed=False)
    return entry + mapping_text(written, target.lanes, handler.flush(target.triple))
