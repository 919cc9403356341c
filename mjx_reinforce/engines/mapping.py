"""The choice of how a function of one environment is mapped over many, as ``choice`` of engines."""

import functools
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax

from mjx_reinforce import fused
from mjx_reinforce.engines.choice import pick
from mjx_reinforce.engines.native import available, look
from mjx_reinforce.engines.native.mapping import machine_map
from mjx_reinforce.engines.native.outlook import check_seconds
from mjx_reinforce.engines.native.program import refusal
from mjx_reinforce.fused import jaxprs, size
from mjx_reinforce.fused.vmap import MAX_OPERATIONS
from mjx_reinforce.types import Environment, PyTree, observation_size

#: Scalar operations of a step, before any fold away: between those of the tasks without contacts
#: and those of the others. On an H100, XLA's kernels of InvertedPendulum played 1.6 times as many
#: env steps a second as ours, and those of HalfCheetah were still compiling after a minute.
_SMALL = 100_000
MappedFunction = Callable[..., Any]


class MapEngine(NamedTuple):
    """A way to map a function.

    name: "vmap" or "native"; "fused" where XLA has the function written out in scalars
    why: the reason it was chosen, for people
    call: the function of a batch, whose first axis of every array is N
    seconds: wall time that making it took, most of it for machine code
    """

    name: str
    why: str
    call: MappedFunction
    seconds: float = 0.0

    def __repr__(self) -> str:
        return f"MapEngine({self.name})"


def map_function(
    name: str, env: Environment, function: Callable[..., Any], *examples: PyTree
) -> MapEngine:
    """Returns a function of one environment mapped over many.

    Args:
      name: one of ``choice.ENGINES``; "auto" is the fastest that supports the function.
      env: the environment.
      function: of its state, and of what else there is; it draws from no typed key that is given.
      *examples: the function's arguments, or their shapes.

    Raises:
      ValueError: the name is unknown, or the engine does not support the function.
    """
    began = time.perf_counter()
    made = _in_scalars(function, *examples) if name == "auto" else None
    if made is None:
        in_machine_code = functools.partial(machine_code, env, function, *examples)
        made = pick(name, in_machine_code, jax.vmap(function))
    return MapEngine(*made, time.perf_counter() - began)


def _in_scalars(
    function: Callable[..., Any], *examples: PyTree
) -> tuple[str, str, MappedFunction] | None:
    """Returns a function that is small enough for XLA's kernels on a GPU, written out for them."""
    if (
        available.platform() != "gpu"
        or size.num_scalars(jaxprs.trace(function, *examples)[0]) >= _SMALL
    ):
        return None
    # On a GPU a real branch makes the host wait for its predicate: both sides are computed.
    mapped = fused.vmap(function, branch_cost=MAX_OPERATIONS)
    batch = jax.tree.map(lambda x: jax.ShapeDtypeStruct((1, *x.shape), x.dtype), examples)
    try:
        written = mapped.write(*batch)
    except Exception:  # whatever it is, another engine may play this
        return None
    if sum(written.operations.values()) > MAX_OPERATIONS:
        return None
    return "fused", "on a GPU XLA's kernels are the fastest for so small a step", mapped


def machine_code(
    env: Environment, function: Callable[..., Any], *examples: PyTree
) -> MappedFunction | str:
    """Returns the function of many environments in machine code, or why that is not possible.

    Arguments are those of ``map_function``.
    """
    against = available.unavailable()
    if against:
        return against
    check = functools.partial(check_seconds, env, entries=observation_size(env))
    try:
        name = f"{getattr(function, '__name__', 'a function')} of {look.name_of(env)}"
        return machine_map(function, *examples, check=check, name=name)
    except Exception as error:  # whatever it is, another engine may play this
        return refusal(error)
