"""A model without the parts of the physics that its flags disable."""

import copy
import itertools
from typing import Any

import mujoco
import numpy as np

from mjx_reinforce.engine.base import MjModel

_C: Any = mujoco
_DISABLED: Any = _C.mjtDisableBit
_ENABLED: Any = _C.mjtEnableBit
#: Without these an actuator pushes nothing. Its gear stays: by its square, joints and tendons
#: inherit armature and damping of actuators that are disabled, too (mj_actuatorArmature).
_FORCES = ("actuator_gainprm", "actuator_biasprm")
#: Flags of <option> that disable terms, and the fields that are zero without these.
_TERMS = {
    "equality": ("eq_active0",),
    "frictionloss": ("dof_frictionloss", "tendon_frictionloss"),
    "limit": ("jnt_limited", "tendon_limited"),
    "spring": ("jnt_stiffness", "jnt_stiffnesspoly", "tendon_stiffness", "tendon_stiffnesspoly"),
    "damper": (
        *("dof_damping", "dof_dampingpoly", "tendon_damping", "tendon_dampingpoly"),
        *("actuator_damping", "actuator_dampingpoly"),
    ),
    "gravity": ("body_gravcomp",),
    "clampctrl": ("actuator_ctrllimited",),
    "actuation": (*_FORCES, "actuator_forcelimited", "jnt_actfrclimited", "tendon_actfrclimited"),
}
#: Groups of actuators that can be disabled.
_MAX_GROUPS = 31
#: What the flag of all constraints disables.
_CONSTRAINTS = ("equality", "frictionloss", "limit")
#: Flags that enable what changes no state: they compute energies, and compare inverse dynamics.
_MEASURES = int(_ENABLED.mjENBL_ENERGY | _ENABLED.mjENBL_FWDINV | _ENABLED.mjENBL_INVDISCRETE)


def is_off(model: Any, flag: str) -> bool:
    """Returns whether a flag of <option> is disabled."""
    return bool(model.opt.disableflags & getattr(_DISABLED, f"mjDSBL_{flag.upper()}"))


def has_contacts(model: Any) -> bool:
    """Returns whether the flags let geoms touch."""
    return not (is_off(model, "contact") or is_off(model, "constraint"))


def enabled_physics(model: Any) -> int:
    """Returns the flags of a model that enable other physics."""
    return model.opt.enableflags & ~_MEASURES


def without_disabled(mj_model: MjModel) -> Any:
    """Returns a copy of a model that has no terms which its flags disable."""
    model: Any = copy.copy(mj_model)
    is_without_constraints = is_off(model, "constraint")
    for flag, fields in _TERMS.items():
        if is_off(model, flag) or (is_without_constraints and flag in _CONSTRAINTS):
            for field in fields:
                getattr(model, field)[:] = 0
    if is_off(model, "gravity"):
        model.opt.gravity = 0
    # Without springs and dampers C computes no passive forces at all (mj_passive).
    if is_off(model, "spring") and is_off(model, "damper"):
        model.body_gravcomp[:] = 0
        model.opt.density = model.opt.viscosity = 0
    for field in _FORCES:
        getattr(model, field)[disabled_actuators(model)] = 0
    return model


def disabled_fields(model: Any) -> frozenset[str]:
    """Returns the fields of terms that the flags of a model disable."""
    disabled_terms = [fields for flag, fields in _TERMS.items() if is_off(model, flag)]
    return frozenset(itertools.chain(*disabled_terms))


def disabled_actuators(model: Any) -> np.ndarray:
    """Returns which actuators are of a group that is disabled (mj_actuatorDisabled)."""
    groups = np.clip(model.actuator_group, -1, _MAX_GROUPS)
    disabled_groups = (model.opt.disableactuator >> np.arange(_MAX_GROUPS) & 1).astype(bool)
    return np.append(disabled_groups, [False, False])[groups]
