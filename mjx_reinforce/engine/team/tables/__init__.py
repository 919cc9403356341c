"""Tables of a model of MuJoCo, as C++ text, for the device code in which a team plays it.

A link is what one joint moves; its frame is turned as the body after that joint, and its origin is
the joint's anchor. A body without a joint belongs to the link that carries it, to the world, or to
a mocap body: bodies, geoms and anchors have fixed places in the frames of these.

Each part of a model has a file here, which fills its tables: ``links``, ``bodies``, ``dofs``,
``passive`` forces, ``cables``, ``actuators``, ``equalities``, ``contacts`` and their ``geoms``,
sensors of ``touch``, and the ``solver``. ``store`` is what they fill, ``draws`` what of it an
episode may draw, and ``fixed`` its C++.
"""

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import jax
import mujoco

from mjx_reinforce.engine.base import MjModel
from mjx_reinforce.engine.scalar import UnsupportedPrimitive
from mjx_reinforce.engine.team import flags
from mjx_reinforce.engine.team.supported import why as why
from mjx_reinforce.engine.team.tables import (
    actuators,
    bodies,
    cables,
    contacts,
    dofs,
    draws,
    equalities,
    fixed,
    links,
    passive,
    solver,
    touch,
)
from mjx_reinforce.engine.team.tables.store import Tables

_C: Any = mujoco  # a C extension without stubs
_DEVICE = Path(__file__).parents[1] / "device"
#: The files of the device code, each after those that it uses. What the tables use is before them.
_PRELUDE = ("lanes", "records")
_HEADERS = """
    algebra state block kinematics impedance bounds draws cones cables contact_rows vectors passive
    dynamics rounds boxes cylinders hulls two_boxes support gjk epa faces convex collision equality
    elimination newton islands early_stop no_slip touch report free_bodies integrators scalar launch
    """
#: Contacts that the state of a team has room for; more go to memory.
NUM_NEAR = 8


def physics_text(mj_model: MjModel, num_near: int = NUM_NEAR, random: Collection[str] = ()) -> str:
    """Returns the device code for a model.

    Args:
      mj_model: the model.
      num_near: contacts that the state of a team has room for.
      random: the names of its fields that differ from episode to episode.

    Raises:
      UnsupportedPrimitive: the device code lacks something that the model has; see ``why``.
    """
    if reason := why(mj_model, random):
        raise UnsupportedPrimitive(reason)
    prelude, headers = (
        [(_DEVICE / f"{name}.h").read_text("utf-8") for name in names]
        for names in (_PRELUDE, _HEADERS.split())
    )
    # One text, as NVRTC has no folders: nothing is included, and no file may come twice.
    text = "\n".join([*prelude, fixed.text(of_model(mj_model, num_near, random)), *headers])
    return text.replace("#pragma once\n", "")


def far_words(mj_model: MjModel, num_near: int = NUM_NEAR, random: Collection[str] = ()) -> int:
    """Returns how many 4-byte words of memory the contacts need that a team has no room for."""
    sizes = of_model(mj_model, num_near, random).constants
    # The Contact of state.h.
    contact_words = 13 + 5 * sizes["CD"] + sizes["ELLIPTIC"] + 5 * sizes["DRAWS_FRICTION"]
    words = max(0, int(sizes["NC"] - sizes["NEAR"])) * int(contact_words)
    return words + words % 2  # numbers of 8 bytes may follow


def drawn_numbers(
    mj_model: MjModel, random: Collection[str], fields: Mapping[str, Any]
) -> jax.Array:
    """Returns what an episode draws of the device code's tables [n], for ``draw`` of C++.

    Args:
      mj_model: the model.
      random: the names of its fields that differ from episode to episode.
      fields: these fields, and what MuJoCo derives of them, by their names in mjModel.
    """
    return draws.numbers(draws.entries(of_model(mj_model, NUM_NEAR, random), fields))


def of_model(mj_model: MjModel, num_near: int, random: Collection[str]) -> Tables:
    """Returns the tables of a model; see ``physics_text``."""
    model = flags.without_disabled(mj_model)
    tables = Tables(model, draws.effective(model, random))
    links.fill(tables)
    bodies.fill(tables)
    dofs.fill(tables)
    passive.fill_compensation(tables)
    passive.fill_medium(tables)
    cables.fill(tables)
    actuators.fill(tables)
    equalities.fill(tables)
    cables.fill_bounds(tables)
    contacts.fill(tables, num_near)
    touch.fill(tables)
    links.fill_jumps(tables)
    solver.fill(tables)
    constants = tables.constants
    constants["NQ"] = model.nq
    constants["NV"] = model.nv
    constants["NL"] = model.njnt
    constants["NB"] = model.nbody
    constants["NU"] = max(model.nu, 1)
    constants["IMPLICIT"] = dofs.implicit(tables)
    constants["MAY_SKIP"] = dofs.may_skip(tables)
    is_passive = any(constants[x] for x in ("NCOMPENSATED", "TENDON_FORCES", "JOINT_LAWS"))
    constants["PASSIVE"] = int(is_passive)
    constants["RK4"] = int(model.opt.integrator == _C.mjtIntegrator.mjINT_RK4)
    constants["ELLIPTIC"] = solver.is_elliptic(model)
    constants["ANY_POWER"] = int(any(x.power != 2 for x in tables.softnesses))
    tables.reals["soft"] = list(tables.softnesses)
    tables.reals["gravity"] = model.opt.gravity
    return tables
