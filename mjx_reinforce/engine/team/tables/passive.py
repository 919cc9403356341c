"""Tables of passive forces: gravity compensation, and a medium."""

from typing import Any

import numpy as np

from mjx_reinforce.engine.team import flags
from mjx_reinforce.engine.team.contact_kinds import MIN_VALUE
from mjx_reinforce.engine.team.frames import rotation
from mjx_reinforce.engine.team.tables.store import Tables


def fill_compensation(tables: Tables) -> None:
    """Makes the tables of what gravity compensation holds, a row a link."""
    model = tables.model
    masses = model.body_mass * model.body_gravcomp
    weights: dict[int, np.ndarray] = {}
    is_held = model.body_gravcomp != 0
    if "body_mass" not in tables.random:
        is_held &= model.body_mass != 0
    for body in np.flatnonzero(is_held):
        frame = tables.frames[body]
        mass = masses[body]
        ipos = model.body_ipos[body]
        if frame.link >= 0:
            row = mass * np.array([*frame.place(ipos), 1])
            weights[frame.link] = weights.get(frame.link, 0) + row
    tables.ints["compensated_link"] = list(weights)
    tables.reals["compensated"] = list(weights.values())
    # Of these joints the actuators' force includes it; without an actuator there is none.
    acts = np.asarray(model.jnt_actgravcomp, bool)[tables.dof_joint] & bool(weights)
    tables.ints["dof_actuator_compensation"] = acts if weights else []
    tables.constants["NCOMPENSATED"] = len(weights)
    has_actuators = model.nu > 0 and not flags.is_off(model, "actuation")
    tables.constants["ACTUATOR_COMPENSATION"] = int(acts.any() and has_actuators)


def fill_medium(tables: Tables) -> None:
    """Makes the tables of what a medium does to bodies, in the order of their links."""
    model = tables.model
    opt = model.opt
    links = np.array([tables.link_number(x.link) for x in tables.frames])
    is_resisted = (model.body_mass >= MIN_VALUE) | ("body_mass" in tables.random)
    bodies = np.flatnonzero(is_resisted & (links < model.njnt))
    bodies = bodies[np.argsort(links[bodies], kind="stable")]
    has_medium = opt.density > 0 or opt.viscosity > 0
    tables.constants["MEDIUM"] = int(has_medium)
    tables.fluid_bodies = bodies if has_medium else bodies[:0]
    tables.ints["link_fluid"] = []
    tables.reals |= {"fluid_body": [], "wind": []}
    if not has_medium:
        return
    resistances = fluid(np, model, bodies).values()
    turns = [
        rotation(tables.frames[x].then(model.body_ipos[x], model.body_iquat[x]).quat).T
        for x in bodies
    ]
    places = [tables.frames[x].place(model.body_ipos[x]) for x in bodies]
    turns = np.reshape(turns, (-1, 9))
    tables.reals["fluid_body"] = np.hstack([np.array(places), turns, *resistances])
    tables.ints["link_fluid"] = np.searchsorted(links[bodies], np.arange(model.njnt + 1))
    tables.reals["wind"] = opt.wind


def fluid(xp: Any, model: Any, bodies: np.ndarray) -> dict[str, Any]:
    """Returns the fields of a FluidBody of ``records.py`` that depend on masses and inertias.

    Args:
      xp: NumPy, or that of JAX.
      model: the model.
      bodies: in the order of the table.
    """
    # A body is a box of the same inertia, or, where the medium is viscous, a ball.
    inertia = model.body_inertia[bodies]
    squares = inertia.sum(1, keepdims=True) - 2 * inertia
    masses = model.body_mass[bodies][:, None]
    box = xp.sqrt(xp.maximum(MIN_VALUE, squares) / xp.maximum(MIN_VALUE, masses) * 6)
    box = xp.where(masses >= MIN_VALUE, box, 0)
    diameter = box.mean(1, keepdims=True)
    others = box[:, np.array([[1, 2], [0, 2], [0, 1]])]
    opt = model.opt
    return {
        "viscous_torque": np.pi * opt.viscosity * diameter**3,
        "viscous_force": 3 * np.pi * opt.viscosity * diameter,
        "drag_torque": opt.density / 64 * box * (others**4).sum(2),
        "drag_force": opt.density / 2 * others.prod(2),
    }
