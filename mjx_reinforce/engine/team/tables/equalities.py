"""Tables of equality constraints: of joints, and of bodies that are connected or welded."""

from typing import Any

import mujoco
import numpy as np

from mjx_reinforce.engine.team.frames import rotation, times
from mjx_reinforce.engine.team.tables.store import Tables

_C: Any = mujoco  # a C extension without stubs


def fill(tables: Tables) -> None:
    """Makes the tables of equality constraints."""
    model = tables.model
    eq_kinds = np.where(model.eq_active0, model.eq_type, -1)
    weld_eqs = np.flatnonzero(eq_kinds == _C.mjtEq.mjEQ_WELD)
    connect_eqs = np.flatnonzero(eq_kinds == _C.mjtEq.mjEQ_CONNECT)
    connect_eqs = np.concatenate([connect_eqs, weld_eqs])
    joint_eqs = np.flatnonzero(eq_kinds == _C.mjtEq.mjEQ_JOINT)
    tables.constants["NCONNECT"] = len(connect_eqs)
    tables.constants["NWELD"] = len(weld_eqs)
    tables.constants["NE"] = 3 * len(connect_eqs) + 3 * len(weld_eqs) + len(joint_eqs)
    links = []
    turns = []
    places = []
    bodies = []
    for equality in connect_eqs:
        ends = (model.eq_obj1id[equality], model.eq_obj2id[equality])
        anchors = model.eq_data[equality, :6].reshape(2, 3)
        # A weld has them the other way around, and a relative pose.
        is_weld = model.eq_type[equality] == _C.mjtEq.mjEQ_WELD
        quats = np.array([model.eq_data[equality, 6:10], [1, 0, 0, 0]])
        if is_weld:
            anchors = anchors[::-1]
        # Between sites there are no anchors in eq_data: the sites are.
        if model.eq_objtype[equality] == _C.mjtObj.mjOBJ_SITE:
            anchors = model.site_pos[list(ends)]
            quats = model.site_quat[list(ends)]
            ends = model.site_bodyid[list(ends)]
        frames = [tables.frames[body] for body in ends]
        bodies.append([int(body) for body in ends])
        links.append([tables.link_number(frame.link) for frame in frames])
        places.append([frame.place(x) for frame, x in zip(frames, anchors, strict=True)])
        if is_weld:
            ends_quats = [times(x.quat, quat) for x, quat in zip(frames, quats, strict=True)]
            turns.append([rotation(quat) for quat in ends_quats])
    tables.ints["connect_link"] = links
    tables.ints["connect_body"] = bodies
    tables.reals["connect_at"] = places
    tables.reals["connect_weight"] = [model.body_invweight0[x, 0].sum() for x in bodies]
    weld_bodies = bodies[len(bodies) - len(weld_eqs) :]
    tables.reals["weld_turn"] = turns
    tables.reals["weld_scale"] = model.eq_data[weld_eqs, 10]
    tables.reals["weld_weight"] = [model.body_invweight0[x, 1].sum() for x in weld_bodies]
    tables.ints["connect_soft"] = _softness_numbers(tables, connect_eqs)
    # A joint alone is held at a value: its second is -1.
    joints = np.stack([model.eq_obj1id[joint_eqs], model.eq_obj2id[joint_eqs]], 1)
    dofs = np.where(joints >= 0, model.jnt_dofadr[joints], -1)
    tables.ints["joined_dof"] = dofs
    tables.ints["joined_soft"] = _softness_numbers(tables, joint_eqs)
    tables.reals["joined_poly"] = model.eq_data[joint_eqs, :5]
    tables.reals["joined_weight"] = [
        sum(model.dof_invweight0[dof] for dof in pair if dof >= 0) for pair in dofs
    ]


def _softness_numbers(tables: Tables, equalities: np.ndarray) -> list[int]:
    """Returns the numbers of the softnesses of equality constraints."""
    model = tables.model
    return [tables.softness_number(model.eq_solref[n], model.eq_solimp[n]) for n in equalities]
