"""Reading jaxprs: the one file that knows what differs between JAX releases.

Written against JAX 0.10.2, 0.11.2 and 0.12.0. jaxprs are not a frozen interface; when a release
moves something, it moves here.
"""

import functools
import hashlib
import math
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple, Protocol

import jax
import jax.core
import numpy as np
from jax import lax
from jax.extend import core
from jax.interpreters import partial_eval

from mjx_reinforce.engine.base import PyTree, is_key
from mjx_reinforce.engine.scalar.nodes import OP_TRAITS

# The parameter under which a call-like primitive keeps the jaxpr that it calls.
_CALLEE_PARAMS = ("jaxpr", "call_jaxpr", "fun_jaxpr")


class UnsupportedPrimitive(NotImplementedError):  # noqa: N818 (reads as what it is)
    """A JAX primitive that cannot be written out, or not for a backend."""


def no_keys() -> UnsupportedPrimitive:
    """Returns the error for typed PRNG keys."""
    return UnsupportedPrimitive(
        "typed PRNG keys (jax.random.key) cannot be written out; draw the random numbers outside "
        "and pass them, or use jax.vmap for this function"
    )


def no_rule(name: str, source: str) -> UnsupportedPrimitive:
    """Returns the error for a primitive without a rule.

    Args:
      name: the primitive's.
      source: the line of the user's code that it came from.
    """
    return UnsupportedPrimitive(
        f"there is no rule for the primitive {name!r}, used at {source}; use jax.vmap for this "
        "function, or add a rule in mjx_reinforce/engine/scalar/rules"
    )


class Program(NamedTuple):
    """A jaxpr with the values of its constant variables.

    jaxpr: the equations.
    consts: one array for each constant variable; may be tracers.
    """

    jaxpr: core.Jaxpr
    consts: list[Any]


class Shape(Protocol):
    """What is known of an operand or a result; JAX's own type for it declares neither."""

    shape: tuple[int, ...]
    dtype: np.dtype


def num_entries(leaf: Shape) -> int:
    """Returns how many numbers an array of a shape has."""
    return math.prod(leaf.shape)


class Atom(Protocol):
    """An operand or a result of an equation."""

    aval: Shape


class Equation(Protocol):
    """An equation of a jaxpr, a ``jax.extend.core.JaxprEqn``, by what is read of it.

    primitive: what is done.
    params: how.
    invars: the operands.
    outvars: the results.
    source_info: where it was written.
    """

    primitive: core.Primitive
    params: dict[str, Any]
    invars: list[Atom]
    outvars: list[Atom]
    source_info: Any


def trace(fn: Callable, *examples: PyTree) -> tuple[Program, Any]:
    """Returns fn's program for one example and the pytree of its output shapes."""
    closed_jaxpr, out_shape = jax.make_jaxpr(fn, return_shape=True)(*examples)
    return program(closed_jaxpr), out_shape


def fingerprint(root: Program) -> str:
    """Returns a hash of a program and of the constants in it, the same in every process."""
    # JAX itself leaves the addresses of functions out of a program's text.
    digest = hashlib.sha256(str(root.jaxpr).encode())
    for const in [*root.consts, *_inner_constants(root.jaxpr)]:
        if is_traced(const):
            digest.update(b"unknown")
        else:
            value = as_numpy(const)
            digest.update(f"{value.dtype}{value.shape}".encode() + value.tobytes())
    return digest.hexdigest()


def _inner_constants(jaxpr: core.Jaxpr) -> list[Any]:
    """Returns the constants of the programs that a program calls."""
    constants = []
    for eqn in jaxpr.eqns:
        for subprogram in subprograms(eqn.params.values()):
            constants += [*subprogram.consts, *_inner_constants(subprogram.jaxpr)]
    return constants


def subprograms(params: Iterable[Any]) -> list[Program]:
    """Returns the programs among the parameters of an equation."""
    programs = []
    for value in params:
        if isinstance(value, (tuple, list)):
            programs += subprograms(value)
        elif isinstance(value, core.Jaxpr) or hasattr(type(value), "jaxpr"):  # open, or closed
            programs.append(program(value))
    return programs


def program(source: Any) -> Program:
    """Returns the program of a closed or an open jaxpr."""
    return Program(getattr(source, "jaxpr", source), list(getattr(source, "consts", ())))


def callee(eqn: Equation) -> Program | None:
    """Returns the program that a call-like equation calls, or None."""
    for name in _CALLEE_PARAMS:
        if name in eqn.params:
            return program(eqn.params[name])
    if eqn.primitive.name == "call_hi_primitive":  # JAX 0.12: composite primitives
        avals = [variable.aval for variable in eqn.invars]
        return program(jax.make_jaxpr(eqn.params["_prim"].expand)(*avals))
    if eqn.primitive.name in _RECIPES:  # a key is an array of its words
        return program(jax.make_jaxpr(_RECIPES[eqn.primitive.name](eqn))(*map(words, eqn.invars)))
    return None


def words(atom: Atom) -> jax.ShapeDtypeStruct:
    """Returns the shape of an operand, of which a key is an array of words."""
    if not is_key(atom.aval):
        return jax.ShapeDtypeStruct(atom.aval.shape, atom.aval.dtype)
    shape = (*atom.aval.shape, *_implementation(atom).key_shape)
    return jax.ShapeDtypeStruct(shape, np.dtype(np.uint32))


def on_words(eqn: Any) -> Equation:
    """Returns an equation that moves keys as one that moves a word of each."""

    def word(atom: Atom) -> Any:
        if not is_key(atom.aval):
            return atom
        return SimpleNamespace(aval=jax.ShapeDtypeStruct(atom.aval.shape, np.dtype(np.uint32)))

    return eqn.replace(invars=[*map(word, eqn.invars)], outvars=[*map(word, eqn.outvars)])


def _implementation(key: Atom) -> Any:
    """Returns the generator of a key: functions of words."""
    dtype: Any = key.aval.dtype
    return dtype._impl


def _largest(eqn: Equation) -> Callable[[jax.Array], list[jax.Array]]:
    """Returns ``top_k`` as a sort: -NaN, -inf, ..., -0, 0, ..., inf, NaN, equal ones in order."""
    k = eqn.params["k"]
    axis = eqn.params["axis"]

    def largest(x: jax.Array) -> list[jax.Array]:
        """Sorts by the complement of the order, which turns it around; ties by their positions."""
        order = x
        if np.issubdtype(x.dtype, np.floating):
            # As integers, the bits of floats are in the order of the numbers. Those of negative
            # ones are in the reverse order, and all of them but the sign are inverted.
            bits = lax.bitcast_convert_type(x, f"int{8 * x.dtype.itemsize}")
            order = lax.select(bits < 0, bits ^ np.iinfo(bits.dtype).max, bits)
        places = lax.broadcasted_iota(np.int32, x.shape, axis)
        _, *sorted_arrays = lax.sort((~order, x, places), dimension=axis)
        return [lax.slice_in_dim(y, 0, k, axis=axis) for y in sorted_arrays]

    return largest


#: What other operations make up, and what is done to keys, as functions of their words:
#: equation -> function.
_RECIPES: dict[str, Callable[[Equation], Callable[..., Any]]] = {
    "random_bits": lambda eqn: (
        lambda key: _implementation(eqn.invars[0]).random_bits(
            key, eqn.params["bit_width"], eqn.params["shape"]
        )
    ),
    "random_split": lambda eqn: (
        lambda key: _implementation(eqn.invars[0]).split(key, eqn.params["shape"])
    ),
    "random_fold_in": lambda eqn: _implementation(eqn.invars[0]).fold_in,
    "top_k": _largest,
}


def default_platform(eqn: Any) -> int | None:
    """Returns which branch of ``platform_dependent`` is the default; None if it has no default.

    The default is taken because what is written out does not depend on where it will run, and the
    default alone is right on every platform.
    """
    platforms = list(eqn.params["platforms"])
    if None not in platforms:
        return None
    return platforms.index(None)


def scan_parts(eqn: Equation) -> tuple[int, int]:
    """Returns how the operands and results of a ``scan`` equation divide.

    Returns:
      How many leading operands are the same in every iteration; and how many operands after them,
      and leading results, are the carry. The rest are xs and ys.
    """
    if "num_consts" in eqn.params:  # JAX 0.10
        return eqn.params["num_consts"], eqn.params["num_carry"]
    consts, carry, _ = eqn.params["ft_in"].update(list(eqn.invars)).unpack()
    return len(list(consts)), len(list(carry))


def is_literal(atom: Any) -> bool:
    """Returns whether an operand is a literal, which is not hashable in every release."""
    return isinstance(atom, core.Literal)


def literal_value(atom: Any) -> np.ndarray:
    """Returns a literal's value in its own dtype."""
    return np.asarray(atom.val, atom.aval.dtype)


def is_traced(value: object) -> bool:
    """Returns whether a constant has no value yet."""
    return isinstance(value, jax.core.Tracer)


def as_numpy(value: object) -> np.ndarray:
    """Returns a constant's value."""
    if not isinstance(value, np.ndarray) and is_key(jax.typeof(value)):
        raise no_keys()
    return np.asarray(value)


def prune(fn: Callable) -> Callable:
    """Returns fn without the operations that its results do not need; call it under ``jax.jit``.

    Simulators compute much that one task does not read, and ``jax.vmap`` and the compiler pay for
    all of it.
    """

    @functools.wraps(fn)
    def pruned(*args: PyTree) -> Any:
        """Traces the function, drops what is dead, and evaluates the rest."""
        leaves, in_tree = jax.tree.flatten(args)
        (jaxpr, consts), out_shape = trace(lambda *args: fn(*in_tree.unflatten(args)), *leaves)
        is_used = [True] * len(jaxpr.outvars)
        jaxpr, _ = partial_eval.dce_jaxpr(jaxpr, is_used, instantiate=True)
        outputs = jax.core.eval_jaxpr(jaxpr, consts, *leaves)
        return jax.tree.structure(out_shape).unflatten(outputs)

    return pruned


def live_equations(jaxpr: core.Jaxpr, live: Iterable[bool]) -> list[tuple[Any, list[bool]]]:
    """Returns the equations that the live outputs need, in order, and which results of each.

    Equations are pure here: one with an effect (a print, a callback) is dropped like any other
    when nothing reads it.

    Args:
      jaxpr: the equations.
      live: which of the jaxpr's outputs something reads.
    """
    outputs = zip(jaxpr.outvars, live, strict=True)
    read_vars = {outvar for outvar, is_live in outputs if is_live and not is_literal(outvar)}
    equations = []
    # Backwards: whoever reads an equation's results comes behind it, and was looked at before.
    for eqn in reversed(jaxpr.eqns):
        if any(outvar in read_vars for outvar in eqn.outvars):
            equations.append((eqn, [outvar in read_vars for outvar in eqn.outvars]))
            read_vars.update(atom for atom in eqn.invars if not is_literal(atom))
    return equations[::-1]


def source(eqn: Equation) -> str:
    """Returns 'file:line (function)' of the user's code that an equation came from.

    It is "" where the equation came from inside of a jitted function of JAX, or from here.
    """
    try:
        from jax._src import source_info_util  # no public equivalent

        line = source_info_util.summarize(eqn.source_info)
    except (ImportError, AttributeError):
        return ""
    # A line of this package, such as one of ``primitives``, says nothing to the user.
    if line.startswith(str(Path(__file__).parent)):
        return ""
    return line


def operation(name: str) -> Callable[..., Any]:
    """Returns JAX's function for an operation of the scalar graph."""
    return getattr(lax, OP_TRAITS[name].lax_name or name)


def compute_constants(
    function: Callable, params: dict, operands: Sequence[Any]
) -> list[np.ndarray]:
    """Computes an operation of JAX on constants at once; takes about 1 ms."""
    # Also while an outer function is traced, where JAX would else trace this too.
    with jax.ensure_compile_time_eval():
        values = [jax.numpy.asarray(operand) for operand in operands]
        outputs = function(*values, **params)
        if not isinstance(outputs, (list, tuple)):
            outputs = [outputs]
        return [np.asarray(output) for output in outputs]
