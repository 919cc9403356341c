"""Everything that this package uses of MJX and that MJX does not publish.

No other file imports MJX's private modules or reads the private part of its data. Three kinds:

- Names that MJX keeps private, here without underscore: the imports, and ``advance``.
- Fields of ``mjx.Data`` that only MJX's JAX implementation has: ``jax_fields``, ``with_solution``,
  ``rows_of``, ``with_rows``, ``with_contact``, ``with_inertia``, ``Simulation``, ``num_contacts``.
- Functions of MJX in which a name is given another meaning: ``collision_with`` and ``fenced``. They
  would do nothing, silently, if MJX stopped looking that name up; ``check_lookup`` raises then.

``tests/physics/test_mjx_internals.py`` holds a hash of each MJX function that this package replaces
or whose source it depends on: a new MJX fails there first.

``fenced`` makes a change for XLA's CPU backend that changes no answer. A body's pose needs every
entry of its parent's. XLA fuses the whole chain and then computes the parent's entries again for
each entry of the child: time grows exponentially with depth. Pusher's arm, ten bodies deep, takes a
second a state; with a fence between levels, 50 us.
"""

import contextlib
import dis
import functools
import inspect
import threading
import types
from collections.abc import Callable, Iterator
from importlib import metadata
from typing import Any, cast

import jax
import numpy as np
from mujoco import mjx
from mujoco.mjx._src import collision_driver, scan
from mujoco.mjx._src.collision_driver import geom_pairs
from mujoco.mjx._src.collision_primitive import collider
from mujoco.mjx._src.collision_types import Collision, GeomInfo
from mujoco.mjx._src.forward import _advance as advance
from mujoco.mjx._src.math import make_frame, quat_mul_axis
from mujoco.mjx._src.smooth import solve_m
from mujoco.mjx._src.support import muscle_gain

__all__ = [
    "Collision",
    "GeomInfo",
    "Simulation",
    "advance",
    "check_lookup",
    "collider",
    "collision_with",
    "fenced",
    "geom_groups",
    "geom_pairs",
    "jax_fields",
    "make_frame",
    "muscle_gain",
    "num_contacts",
    "quat_mul_axis",
    "rows_of",
    "solve_m",
    "with_contact",
    "with_inertia",
    "with_rows",
    "with_solution",
]

#: What this package was tested with; ``pyproject.toml`` bounds the versions at the same.
TESTED_VERSIONS = {"mujoco": "4.0", "mujoco-mjx": "3.17"}


# ---------------------------------------------------------------------------- names in MJX's code


def check_lookup(module: types.ModuleType, function: str, name: str) -> None:
    """Checks that a function of MJX looks up a global name, so that it sees another meaning.

    Args:
      module: the module of MJX that has the function and the name.
      function: the function's name.
      name: the global name that this package gives another meaning.

    Raises:
      RuntimeError: if the function is gone, or does not look the name up in this module.
    """
    found = inspect.unwrap(getattr(module, function, None))  # type: ignore
    if (
        isinstance(found, types.FunctionType)
        and found.__globals__ is vars(module)
        and name in _looked_up(found.__code__)
    ):
        return
    versions = ", ".join(
        f"{package} {metadata.version(package)} (tested: {tested}.*)"
        for package, tested in TESTED_VERSIONS.items()
    )
    raise RuntimeError(
        f"{module.__name__}.{function} does not look up {name}, which mjx_reinforce replaces. "
        f"Installed: {versions}. Install the tested versions, or adapt {__name__}"
    )


def _looked_up(code: types.CodeType) -> set[str]:
    """Returns the global names that a function's code looks up, also in functions inside it."""
    names = {step.argval for step in dis.get_instructions(code) if step.opname == "LOAD_GLOBAL"}
    inner = (_looked_up(const) for const in code.co_consts if isinstance(const, types.CodeType))
    return names.union(*inner)


for _function, _module, _name in (
    ("collision", collision_driver, "_COLLISION_FUNC"),
    ("flat", scan, "_nvmap"),
    ("body_tree", scan, "_nvmap"),
):
    check_lookup(_module, _function, _name)


def geom_groups(model: mjx.Model) -> Iterator[tuple[int, int, int]]:
    """Yields for each pair of geoms that may meet the dimension of their contacts, and the two."""
    for key, pairs in collision_driver._geom_groups(model).items():
        for first, second, _ in pairs:
            yield int(key.condim), first, second


_Colliders = dict[tuple[mjx.GeomType, mjx.GeomType], Callable[..., Any]]


def collision_with(
    functions: Callable[[_Colliders], _Colliders],
) -> Callable[[mjx.Model, mjx.Data], mjx.Data]:
    """Returns a copy of ``mjx.collision`` with other collision functions.

    MJX finds its collision functions in one table, a global of a module; the copy has a table of
    its own, and MJX stays as it is.

    Args:
      functions: from MJX's table, a ``collider`` for each pair of types of geoms in MJX's order,
        makes the copy's.
    """
    plain = inspect.unwrap(mjx.collision)
    table = functions(dict(collision_driver._COLLISION_FUNC))
    return types.FunctionType(plain.__code__, {**plain.__globals__, "_COLLISION_FUNC": table})


_lock = threading.RLock()
_level = scan._nvmap


def fenced(fn: Callable[..., Any]) -> Callable[..., Any]:
    """Returns a function that traces MJX with a fence between levels."""

    @functools.wraps(fn)
    def traced(*args: Any) -> Any:
        with _lock, _swapped(scan, "_nvmap", _fenced_level):
            return fn(*args)

    return traced


def _fenced_level(*inputs: Any) -> Any:
    """Computes one level of bodies, and lets nothing of it be computed again."""
    return jax.lax.optimization_barrier(_level(*inputs))


@contextlib.contextmanager
def _swapped(module: types.ModuleType, name: str, value: object) -> Iterator[None]:
    """Gives a module's name another meaning for a while."""
    before = getattr(module, name)
    setattr(module, name, value)
    try:
        yield
    finally:
        setattr(module, name, before)


# --------------------------------------------------------------------------- fields of MJX's data


def jax_fields(data: mjx.Data) -> mjx.DataJAX:
    """Returns the fields that only MJX's JAX implementation has, by MuJoCo's names."""
    return cast(mjx.DataJAX, data._impl)


def with_solution(
    data: mjx.Data, qacc: jax.Array, qfrc_constraint: jax.Array, efc_force: jax.Array
) -> mjx.Data:
    """Returns the data with what a constraint solver found.

    Args:
      data: an MJX simulation.
      qacc: [nv] the acceleration.
      qfrc_constraint: [nv] the constraints' joint forces.
      efc_force: [rows] the constraint rows' forces.
    """
    solved = data.tree_replace(
        {"qacc": qacc, "qfrc_constraint": qfrc_constraint, "_impl.efc_force": efc_force}
    )
    return cast(mjx.Data, solved)  # flax types it as any PyTreeNode


_ROW_FIELDS = ("efc_J", "efc_D", "efc_aref", "efc_pos", "efc_margin", "efc_frictionloss")


def rows_of(data: mjx.Data) -> list[jax.Array]:
    """Returns what ``mjx.make_constraint`` makes."""
    return [getattr(jax_fields(data), name) for name in _ROW_FIELDS]


def with_rows(data: mjx.Data, rows: list[jax.Array]) -> mjx.Data:
    """Returns the data with rows as ``rows_of`` lists them."""
    names = (f"_impl.{name}" for name in _ROW_FIELDS)
    return cast(mjx.Data, data.tree_replace(dict(zip(names, rows, strict=True))))


def with_contact(data: mjx.Data, contact: Any, dim: np.ndarray) -> mjx.Data:
    """Returns the data with other contacts, of these dimensions."""
    return cast(mjx.Data, data.tree_replace({"_impl.contact": contact.replace(dim=dim)}))


def with_inertia(data: mjx.Data, matrix: jax.Array) -> mjx.Data:
    """Returns the data with another inertia matrix, [nv, nv]."""
    return cast(mjx.Data, data.tree_replace({"_impl.M": matrix}))


class Simulation:
    """A read-only view of an ``mjx.Data``: every field of mjData under MuJoCo's own name.

    MJX keeps some fields (``cinert``, ``cfrc_ext``, ``efc_force``, ...) in a part of its own;
    here all stand side by side, as in C.
    """

    def __init__(self, data: Any):
        self._data = data

    def __getattr__(self, name: str) -> Any:
        for part in (self._data, self._data._impl):
            if hasattr(part, name):
                return getattr(part, name)
        raise AttributeError(f"mjx.Data has no field {name!r}; see mjData in MuJoCo's reference")


def num_contacts(data: mjx.Data) -> int:
    """Returns the most contacts that a model can have at once, from its ``mjx.Data``."""
    return int(jax_fields(data).ncon)
