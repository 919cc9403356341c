"""Tables of actuators."""

from typing import Any

import mujoco
import numpy as np

from mjx_reinforce.engine.team.tables.store import Tables

_C: Any = mujoco  # a C extension without stubs
_NO_RANGE = (-1e30, 1e30)


def fill(tables: Tables) -> None:
    """Makes the tables of actuators, in the order of the degrees of freedom that they move."""
    model = tables.model
    targets = _targets(tables)
    gear = model.actuator_gear[:, 0].copy()
    # The moments of an actuator's own cable have its gear.
    gear[[x.actuator for x in tables.cables if x.actuator >= 0]] = 1
    order = np.argsort(targets, kind="stable")
    tables.actuator_order = order
    controls = np.where(model.actuator_ctrllimited[:, None], model.actuator_ctrlrange, _NO_RANGE)
    forces = np.where(model.actuator_forcelimited[:, None], model.actuator_forcerange, _NO_RANGE)
    gain = model.actuator_gainprm[:, :3].copy()
    bias = model.actuator_biasprm[:, :3].copy()
    # All are affine here: what MuJoCo does not read of the others is zero.
    gain[model.actuator_gaintype == _C.mjtGain.mjGAIN_FIXED, 1:] = 0
    bias[model.actuator_biastype == _C.mjtBias.mjBIAS_NONE] = 0
    tables.add_records(
        "actuator",
        order,
        gear=gear,
        control_low=controls[:, 0],
        control_high=controls[:, 1],
        gain=gain[:, 0],
        bias=bias[:, 0],
        bias_by_length=bias[:, 1],
        bias_by_speed=bias[:, 2],
        force_low=forces[:, 0],
        force_high=forces[:, 1],
        gain_by_length=gain[:, 1],
        gain_by_speed=gain[:, 2],
    )
    tables.ints["actuator_ctrl"] = model.actuator_ctrladr[order]
    # Those of a degree of freedom or a cable are from its entry up to the next one's.
    counts = np.arange(model.nv + len(tables.cables) + 1)
    tables.ints["target_actuator"] = np.searchsorted(targets[order], counts)
    joint = tables.dof_joint
    is_limited = model.jnt_actfrclimited[joint, None]
    bounds = np.where(is_limited, model.jnt_actfrcrange[joint], _NO_RANGE)
    tables.add_records("dof_force", low=bounds[:, 0], high=bounds[:, 1])


def _targets(tables: Tables) -> np.ndarray:
    """Returns what actuators drive: a degree of freedom, or the number of a cable after all."""
    model = tables.model
    of_tendons = {x.tendon: n for n, x in enumerate(tables.cables)}
    of_actuators = {x.actuator: n for n, x in enumerate(tables.cables)}
    targets = []
    for actuator, (number, _) in enumerate(model.actuator_trnid):
        if actuator in of_actuators:
            targets.append(model.nv + of_actuators[actuator])
        elif model.actuator_trntype[actuator] == _C.mjtTrn.mjTRN_TENDON:
            targets.append(model.nv + of_tendons[number])
        else:
            targets.append(model.jnt_dofadr[number])
    return np.array(targets, int)
