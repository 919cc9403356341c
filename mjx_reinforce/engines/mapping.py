"""The choice of how a function of one environment is mapped over many, as ``choice`` of engines."""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax

from mjx_reinforce import fused
from mjx_reinforce.checks import explain
from mjx_reinforce.engines.choice import ENGINES
from mjx_reinforce.engines.native import available
from mjx_reinforce.engines.native import mapping as native
from mjx_reinforce.engines.native.mapping import SizeCheck
from mjx_reinforce.fused.vmap import MAX_OPERATIONS
from mjx_reinforce.registry import check_name
from mjx_reinforce.types import PyTree

#: Why machine code for a GPU is not chosen by itself.
_UNTRIED = "its kernels for a step were run on no GPU yet; engine='native' asks for them"


class MapEngine(NamedTuple):
    """A way to map a function.

    name: "vmap", "fused" or "native"
    why: the reason it was chosen, for people
    call: the function of a batch, whose first axis of every array is N
    seconds: wall time that making it took, most of it for machine code
    """

    name: str
    why: str
    call: Callable[..., Any]
    seconds: float = 0.0

    def __repr__(self) -> str:
        return f"MapEngine({self.name})"


def map_function(
    name: str,
    function: Callable[..., Any],
    *examples: PyTree,
    check: SizeCheck | None = None,
) -> MapEngine:
    """Returns a function of one environment mapped over many.

    Args:
      name: one of ``ENGINES``; "auto" is machine code where it can be made, else ``fused`` where
        the function is small enough, else ``vmap``.
      function: of one environment; it draws from no typed key that is given.
      *examples: its arguments, or their shapes.
      check: raises TooLarge where writing the function out and compiling it takes too long.

    Raises:
      ValueError: the name is unknown, or the engine does not support the function.
    """
    check_name("engine", name, dict.fromkeys(ENGINES))
    began = time.perf_counter()
    engine = _map(name, function, examples, check)
    return engine._replace(seconds=time.perf_counter() - began)


def _map(
    name: str, function: Callable[..., Any], examples: tuple[Any, ...], check: SizeCheck | None
) -> MapEngine:
    makers: dict[str, Callable[[], Callable[..., Any] | str]] = {
        "native": lambda: _native(function, examples, check),
        "fused": lambda: _fused(function, examples),
        "vmap": lambda: jax.vmap(function),
    }
    if name != "auto":
        made = makers[name]()
        if isinstance(made, str):
            raise ValueError(f"the {name} engine cannot play this: {made}; choose auto")
        return MapEngine(name, "chosen by name", made)
    reasons = []
    for engine, make in makers.items():
        untried = engine == "native" and available.platform() == "gpu"
        made = _UNTRIED if untried else make()
        if not isinstance(made, str):
            why = "; ".join(reasons) or f"machine code for this {jax.default_backend().upper()}"
            return MapEngine(engine, why, made)
        reasons.append(f"{engine} cannot play this: {made}")
    raise AssertionError("vmap plays everything")


def _native(
    function: Callable[..., Any], examples: tuple[Any, ...], check: SizeCheck | None
) -> Callable[..., Any] | str:
    """Returns the function in machine code, or why that is not possible."""
    against = available.unavailable()
    if against:
        return against
    try:
        return native.machine_map(function, *examples, check=check)
    except (fused.TooLarge, fused.UnsupportedPrimitive, TypeError) as error:
        return " ".join(str(error).split())
    except Exception as error:  # whatever it is, another engine may play this
        return f"it cannot be written out ({explain(error)})"


def _fused(function: Callable[..., Any], examples: tuple[Any, ...]) -> Callable[..., Any] | str:
    """Returns the function in scalars for XLA, or why that is not possible, or not well."""
    mapped = fused.vmap(function)
    batch = jax.tree.map(lambda x: jax.ShapeDtypeStruct((1, *x.shape), x.dtype), examples)
    try:
        count = sum(mapped.write(*batch).operations.values())
    except (fused.TooLarge, fused.UnsupportedPrimitive) as error:
        return " ".join(str(error).split())
    except Exception as error:  # whatever it is, vmap may play this
        return f"it cannot be written out ({explain(error)})"
    if count > MAX_OPERATIONS:
        return f"it takes {count:,} scalar operations, more than {MAX_OPERATIONS:,}"
    return mapped
