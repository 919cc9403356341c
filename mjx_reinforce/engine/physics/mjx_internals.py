"""Everything that this package uses of MJX and that MJX does not publish.

No other file imports MJX's private modules or reads the private part of its data. Three kinds:

- Names that MJX keeps private, here without underscore: the imports, and ``advance``.
- Fields of ``mjx.Data`` that only MJX's JAX implementation has: ``jax_fields``, ``with_fields``,
  ``rows_of``, ``with_rows``, ``with_contact``, ``Simulation``.
- Functions of MJX in which a name is given another meaning: ``collision_with``, ``data_with``,
  ``rows_with`` and ``fenced``. They would do nothing, silently, if MJX stopped looking that name
  up; ``check_lookup`` raises then.

``tests/engine/physics/test_mjx_internals.py`` holds a hash of each MJX function that this package
replaces or whose source it depends on: a new MJX fails there first.

``fenced`` makes a change for XLA's CPU backend that changes no answer. A body's pose needs every
entry of its parent's. XLA fuses the whole chain and then computes the parent's entries again for
each entry of the child: time grows exponentially with depth. Pusher's arm, ten bodies deep, takes a
second a state; with a fence between levels, 50 us.
"""

import functools
import inspect
import threading
import types
from collections.abc import Callable, Iterator
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from mujoco import mjx
from mujoco.mjx._src import (
    collision_driver,
    collision_primitive,
    collision_types,
    constraint,
    forward,
    io,
    math,
    scan,
    smooth,
    support,
)

advance = forward._advance
collider = collision_primitive.collider
geom_pairs = collision_driver.geom_pairs
has_collider = cast(Callable[[int, int], bool], collision_driver.has_collision_fn)
make_frame = math.make_frame
quat_mul_axis = math.quat_mul_axis
kbi = constraint._kbi
muscle_gain = support.muscle_gain
solve_m = smooth.solve_m
tendon_dot = smooth.tendon_dot
Collision = collision_types.Collision
GeomInfo = collision_types.GeomInfo

#: The field of an ``mjx.Data`` in which MJX keeps what is its own.
OWN_FIELDS = "_impl"
#: What this package was tested with; ``pyproject.toml`` bounds the versions at the same.
TESTED_VERSIONS = {"mujoco": "4.0", "mujoco-mjx": "3.17"}


# ---------------------------------------------------------------------------- names in MJX's code


def check_lookup(function: Callable[..., Any], name: str) -> None:
    """Checks that a function of MJX looks up a global name, so that it sees another meaning.

    The functions that it defines may do so too.

    Raises:
      RuntimeError: it does not.
    """
    # The code of functions that it defines is among its constants.
    code = inspect.unwrap(function).__code__
    nested_codes = [const for const in code.co_consts if isinstance(const, types.CodeType)]
    if not any(name in function_code.co_names for function_code in (code, *nested_codes)):
        versions = " and ".join(f"{package}=={tag}.*" for package, tag in TESTED_VERSIONS.items())
        raise RuntimeError(
            f"{function.__module__}.{function.__name__} does not look up {name}, which "
            f"mjx_reinforce replaces: install {versions}, or adapt {__name__}"
        )


check_lookup(mjx.collision, "_COLLISION_FUNC")
check_lookup(collision_driver.make_condim, "_COLLISION_FUNC")
check_lookup(io._make_data_jax, "collision_driver")
check_lookup(mjx.make_constraint, "_kbi")
check_lookup(collision_driver._geom_groups, "geom_pairs")
check_lookup(collision_driver._contact_groups, "_geom_groups")
check_lookup(mjx.collision, "_contact_groups")
check_lookup(collision_driver.make_condim, "_geom_groups")
check_lookup(scan.flat, "_nvmap")
check_lookup(scan.body_tree, "_nvmap")


def geom_groups(model: mjx.Model) -> Iterator[tuple[int, int, int]]:
    """Yields for each pair of geoms that may meet the dimension of their contacts, and the two."""
    for key, pairs in collision_driver._geom_groups(model).items():
        for geom1, geom2, _ in pairs:
            yield int(key.condim), geom1, geom2


def has_friction(model: mjx.Model) -> np.ndarray:
    """Returns which tendons have rows of friction loss, [ntendon]."""
    return cast(mjx.ModelJAX, model._impl).tendon_hasfrictionloss


def wrap_points(
    model: mjx.Model, data: mjx.Data, elements: np.ndarray
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Returns whether tendons touch geoms, [W], and where they meet and leave them, [W, 3] each.

    Args:
      model: an MJX model.
      data: its data after ``mjx.kinematics``.
      elements: [W] all of ``model.wrap_type`` that are geoms.
    """
    # A geom is between two sites in ``wrap_objid``; ``wrap_prm`` is its side site, -1 if none.
    impl: Any = model._impl
    site1, geom, site2 = model.wrap_objid[elements + np.array([[-1], [0], [1]])]
    side = np.round(model.wrap_prm[elements]).astype(int)
    is_sphere = model.wrap_type[elements] == mjx.WrapType.SPHERE
    end_points = data.site_xpos[site1], data.site_xpos[site2]
    geoms = data.geom_xpos[geom], data.geom_xmat[geom], model.geom_size[geom, 0]
    arguments = *end_points, *geoms, data.site_xpos[side], side[:, None] >= 0, is_sphere
    search = impl.wrap_inside_maxiter, impl.wrap_inside_tolerance
    # MJX asks in Python whether a tendon wraps inside (support.py), so that both kinds are computed
    # apart, and then put back in their order.
    order = []
    paths = []
    for is_inside in (False, True):
        indices = np.flatnonzero(impl.is_wrap_inside == is_inside)
        if indices.size:
            static_args = is_inside, *search, impl.wrap_inside_z_init
            wrap = jax.vmap(lambda *x, static_args=static_args: support.wrap(*x, *static_args))
            paths.append(wrap(*(x[indices] for x in arguments)))
            order.append(indices)
    inverse = np.argsort(np.concatenate(order))
    length, point1, point2 = (jnp.concatenate(x)[inverse] for x in zip(*paths, strict=True))
    # A tendon that misses its geom has a length of -1 on it.
    return length.reshape(-1) >= 0, point1, point2


_Colliders = dict[tuple[mjx.GeomType, mjx.GeomType], Callable[..., Any]]


def meeting_pairs(model: Any) -> Iterator[tuple[int, int, int]]:
    """Yields ``geom_pairs`` of a model without those that nothing moves, which C leaves out, too.

    MJX has contacts of mocap bodies with the world and with each other, whose forces are of no use.
    """
    is_moved = model.body_treeid[model.geom_bodyid] >= 0
    for geom1, geom2, pair in geom_pairs(model):
        if is_moved[geom1] or is_moved[geom2]:
            yield geom1, geom2, pair


def kinematics(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Computes poses as ``mjx.kinematics(model, data)``, and of what mocap bodies carry as C.

    MJX moves mocap bodies last, and leaves their children where the model has them.
    """
    if not model.nmocap:
        return mjx.kinematics(model, data)
    is_mocap = model.body_mocapid >= 0
    quat = data.mocap_quat / jnp.linalg.norm(data.mocap_quat, axis=1, keepdims=True)
    body_pos = jnp.asarray(model.body_pos).at[is_mocap].set(data.mocap_pos)
    body_quat = jnp.asarray(model.body_quat).at[is_mocap].set(quat)
    return mjx.kinematics(model.replace(body_pos=body_pos, body_quat=body_quat), data)


def collision_with(
    functions: Callable[[_Colliders], _Colliders],
) -> Callable[[mjx.Model, mjx.Data], mjx.Data]:
    """Returns a copy of ``mjx.collision`` with other collision functions, of ``meeting_pairs``.

    MJX finds its collision functions in one table, a global of a module; the copy has a table of
    its own, and MJX stays as it is.

    Args:
      functions: from MJX's table, a ``collider`` for each pair of types of geoms in MJX's order,
        makes the copy's.
    """
    colliders = functions(dict(collision_driver._COLLISION_FUNC))
    groups = _copy(collision_driver._contact_groups, _geom_groups=_geom_groups)
    return _copy(mjx.collision, _COLLISION_FUNC=colliders, _contact_groups=groups)


def rows_with(kbi: Callable[..., Any]) -> Callable[[mjx.Model, mjx.Data], mjx.Data]:
    """Returns a copy of ``mjx.make_constraint`` with another stiffness, damping and impedance.

    Args:
      kbi: in place of MJX's, see ``kbi``.
    """
    return _copy(mjx.make_constraint, _kbi=kbi)


def _copy(function: Callable[..., Any], **meanings: Any) -> Callable[..., Any]:
    """Returns a copy of a function of MJX in which global names have other meanings."""
    # Without MJX's decorators, which call the original.
    original = inspect.unwrap(function)
    return types.FunctionType(original.__code__, {**original.__globals__, **meanings})


def data_with(functions: Callable[[_Colliders], _Colliders]) -> Callable[..., mjx.Data]:
    """Returns a copy of ``mjx.make_data`` that has room for the contacts of ``collision_with``.

    Args:
      functions: as in ``collision_with``.

    Returns:
      (model, device) -> data
    """
    # MJX's function asks ``collision_driver`` for dimensions; the copy asks this stand-in.
    colliders = functions(dict(collision_driver._COLLISION_FUNC))
    names = {"_COLLISION_FUNC": colliders, "_geom_groups": _geom_groups}
    make_condim = _copy(collision_driver.make_condim, **names)
    driver = types.SimpleNamespace(make_condim=make_condim)
    return _copy(io._make_data_jax, collision_driver=driver)


_geom_groups = _copy(collision_driver._geom_groups, geom_pairs=meeting_pairs)
_lock = threading.RLock()
_level = scan._nvmap


def fenced(fn: Callable[..., Any]) -> Callable[..., Any]:
    """Returns a function that traces MJX with a fence between levels."""

    @functools.wraps(fn)
    def trace(*args: Any) -> Any:
        """Calls the function with MJX's own name for a level replaced meanwhile."""
        # The name is global to all threads. A thread that traces within another trace comes in.
        with _lock:
            outer_level = scan._nvmap
            scan._nvmap = _fenced_level
            try:
                return fn(*args)
            finally:
                scan._nvmap = outer_level

    return trace


def _fenced_level(*inputs: Any) -> Any:
    """Computes one level of bodies, and lets nothing of it be computed again."""
    return jax.lax.optimization_barrier(_level(*inputs))


# --------------------------------------------------------------------------- fields of MJX's data


def jax_fields(data: mjx.Data) -> mjx.DataJAX:
    """Returns the fields that only MJX's JAX implementation has, by MuJoCo's names."""
    return cast(mjx.DataJAX, data._impl)


def with_fields(data: mjx.Data, **fields: Any) -> mjx.Data:
    """Returns the data with other values of fields that only MJX's JAX implementation has."""
    return cast(mjx.Data, data.tree_replace({f"_impl.{name}": x for name, x in fields.items()}))


_ROW_FIELDS = ("efc_J", "efc_D", "efc_aref", "efc_pos", "efc_margin", "efc_frictionloss")


def rows_of(data: mjx.Data) -> list[jax.Array]:
    """Returns what ``mjx.make_constraint`` makes."""
    return [getattr(jax_fields(data), name) for name in _ROW_FIELDS]


def with_rows(data: mjx.Data, rows: list[jax.Array]) -> mjx.Data:
    """Returns the data with rows as ``rows_of`` lists them."""
    return with_fields(data, **dict(zip(_ROW_FIELDS, rows, strict=True)))


def with_contact(data: mjx.Data, contact: Any, dim: np.ndarray) -> mjx.Data:
    """Returns the data with other contacts, of these dimensions."""
    return with_fields(data, contact=contact.replace(dim=dim))


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
