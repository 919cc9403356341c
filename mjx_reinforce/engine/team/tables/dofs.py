"""Tables of degrees of freedom: axes, springs, damping, limits, friction loss, and entries of M."""

from typing import Any

import mujoco
import numpy as np

from mjx_reinforce.engine.physics.early_stop import stops_early
from mjx_reinforce.engine.team import flags, records
from mjx_reinforce.engine.team.supported import FREE, SLIDE
from mjx_reinforce.engine.team.tables import cables
from mjx_reinforce.engine.team.tables.store import Tables

_C: Any = mujoco  # a C extension without stubs
#: How a degree of freedom moves what it carries, by ``device/kinematics.h``.
_TURNS, _SHIFTS, _SHIFTS_IN_THE_WORLD = range(3)


def fill(tables: Tables) -> None:
    """Makes the tables of degrees of freedom."""
    model = tables.model
    joint = tables.dof_joint
    joint_kind = model.jnt_type[joint]
    axis_index = np.arange(model.nv) - model.jnt_dofadr[joint]
    is_single = joint_kind >= SLIDE
    # A ball or a free joint moves along the axes of its own frame.
    axes = np.where(is_single[:, None], model.jnt_axis[joint], np.eye(3)[axis_index % 3])
    dof_kinds = np.full(model.nv, _TURNS)
    dof_kinds[joint_kind == SLIDE] = _SHIFTS
    # A free joint shifts by the axes of the world, and turns about those of the body.
    dof_kinds[(joint_kind == FREE) & (axis_index < 3)] = _SHIFTS_IN_THE_WORLD
    qpos = model.jnt_qposadr[joint]
    tables.ints["dof_link"] = joint
    tables.ints["dof_kind"] = dof_kinds
    tables.ints["dof_qpos"] = qpos
    tables.ints["dof_turns"] = ~is_single & ~(dof_kinds == _SHIFTS_IN_THE_WORLD)
    tables.reals["dof_axis"] = axes
    damping = _damping(model)
    tables.reals["dof_damping"] = damping[:, 0]
    tables.reals["dof_armature"] = model.dof_armature + _of_actuators(model)[:, 0]
    tables.reals["dof_stiffness"] = np.where(is_single, model.jnt_stiffness[joint], 0)
    # Beyond these: higher powers, and the springs of free and ball joints.
    laws = np.column_stack([model.jnt_stiffness, model.jnt_stiffnesspoly])[joint]
    laws = np.hstack([laws, damping])
    laws[is_single, 0] = laws[:, 3] = 0
    has_laws = laws.any() or ("jnt_stiffness" in tables.random and not is_single.all())
    tables.constants["JOINT_LAWS"] = int(has_laws)
    tables.reals["dof_law"] = laws if has_laws else []
    tables.reals["rest"] = model.qpos_spring if has_laws else []
    tables.reals["dof_spring"] = model.qpos_spring[qpos]
    tables.reals["dof_zero"] = model.qpos0[qpos]
    # Free bodies without others in their tree, which implicitfast turns in a way of its own.
    is_alone = np.bincount(model.dof_treeid, minlength=1)[model.dof_treeid] == 6
    is_lone = (model.jnt_type == FREE) & is_alone[model.jnt_dofadr]
    free_links = np.flatnonzero(is_lone) if implicit(tables) == 2 else []
    tables.ints["free_link"] = free_links
    tables.constants["NFREE"] = len(free_links)
    tables.functions["dof_parent"] = model.dof_parentid
    tables.functions["last_of_link"] = np.where(np.diff(joint, append=-1), joint, -1)
    _fill_chains(tables, dof_kinds)
    _fill_bounds(tables, is_single)


def _of_actuators(model: Any) -> np.ndarray:
    """Returns what degrees of freedom inherit, [nv, 4]; see ``cables.of_actuators``."""
    joint_types = (_C.mjtTrn.mjTRN_JOINT, _C.mjtTrn.mjTRN_JOINTINPARENT)
    return cables.of_actuators(model, joint_types, model.njnt)[model.dof_jntid]


def _damping(model: Any) -> np.ndarray:
    """Returns the damping of degrees of freedom, and the rest of its polynomial, [nv, 3]."""
    own = np.column_stack([model.dof_damping, model.dof_dampingpoly])
    return own + _of_actuators(model)[:, 1:]


def _fill_chains(tables: Tables, dof_kinds: np.ndarray) -> None:
    """Makes the tables of which degrees of freedom move a link, and which meet in M."""
    model = tables.model
    # None moves the world and mocap bodies, the last.
    link_chains = [[] for _ in range(model.njnt + 1 + model.nmocap)]
    dof_pairs = []
    for i in range(model.nv):
        chain = []
        j = i
        while j >= 0:
            chain.append(j)
            # The three shifts of a free body are orthogonal: their entries of M are zero.
            is_shift_pair = dof_kinds[i] == dof_kinds[j] == _SHIFTS_IN_THE_WORLD
            if j < i and not is_shift_pair:
                dof_pairs.append(records.packed(j, i))
            j = int(model.dof_parentid[j])  # NumPy's would overflow in a mask
        # The last degree of freedom of a link has the longest chain, and overwrites the others.
        link_chains[tables.dof_joint[i]] = chain
    tables.ints["paired"] = dof_pairs
    tables.constants["NPAIRED"] = len(dof_pairs)
    tables.masks["link_dofs"] = [sum(1 << x for x in chain) for chain in link_chains]


def _fill_bounds(tables: Tables, is_single: np.ndarray) -> None:
    """Makes the tables of limits and friction loss."""
    model = tables.model
    joint = tables.dof_joint
    is_limited = np.asarray(model.jnt_limited, bool)[joint] & is_single
    span = np.diff(model.jnt_range[joint]).ravel()
    # Both limits of a joint push at once only where their margins overlap.
    overlap = is_limited & (span < 2 * model.jnt_margin[joint])
    tables.constants["LIMITS"] = int(is_limited.any()) + int(overlap.any())
    tables.constants["LOSSES"] = int(np.any(model.dof_frictionloss))
    tables.ints["dof_limited"] = is_limited
    tables.add_records(
        "dof_limit",
        range=model.jnt_range[joint],
        margin=model.jnt_margin[joint],
        weight=model.dof_invweight0,
    )
    tables.ints["dof_limit_soft"] = _softness_numbers(
        tables, model.jnt_solref[joint], model.jnt_solimp[joint], is_limited
    )
    tables.add_records("dof_loss", most=model.dof_frictionloss, weight=model.dof_invweight0)
    tables.ints["dof_loss_soft"] = _softness_numbers(
        tables, model.dof_solref, model.dof_solimp, model.dof_frictionloss
    )


def _softness_numbers(
    tables: Tables, solrefs: np.ndarray, solimps: np.ndarray, row_mask: np.ndarray
) -> list[int]:
    """Returns the number of each softness that is present, 0 for the others."""
    rows = zip(solrefs, solimps, row_mask, strict=True)
    return [tables.softness_number(ref, imp) if is_present else 0 for ref, imp, is_present in rows]


def implicit(tables: Tables) -> int:
    """Returns how damping is implicit: 0 not at all, 1 of joints, 2 of actuators, too."""
    opt = tables.model.opt
    if opt.integrator == _C.mjtIntegrator.mjINT_IMPLICITFAST:
        return 2
    is_euler = opt.integrator == _C.mjtIntegrator.mjINT_EULER
    is_off = any(flags.is_off(tables.model, x) for x in ("eulerdamp", "damper"))
    is_damped = _damping(tables.model).any() or "dof_damping" in tables.random
    return int(is_euler and not is_off and (is_damped or _solves_again(tables.model)))


def may_skip(tables: Tables) -> bool:
    """Returns whether C does not solve once more in an episode that draws no damping."""
    is_drawn = stops_early(tables.model) and "dof_damping" in tables.random
    is_damped = bool(_damping(tables.model)[:, 1:].any()) or _solves_again(tables.model)
    return implicit(tables) == 1 and is_drawn and not is_damped


def _solves_again(model: Any) -> bool:
    """Returns whether C solves once more for the armature of an actuator (mj_EulerSkip).

    This only matters for a search that stops early.
    """
    return stops_early(model) and bool(np.any(model.jnt_actuatorid != -1))
