"""Whether a model explodes in C MuJoCo itself, which no learning rate mends."""

import copy
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import mujoco
import numpy as np

from mjx_reinforce.engine.base import MjModel
from mjx_reinforce.envs import models
from mjx_reinforce.envs.c_mujoco.in_mujoco import was_reset

#: MuJoCo's own names; it is a C extension without stubs.
_C: Any = mujoco
#: Simulated time (s).
_SECONDS = 1.0
#: How long that may take on the clock (s); a large model is tried for less.
_WAIT = 0.04
#: The same of a remedy, which has to last for all of the second.
_TRIAL_WAIT = 2.0
#: What joints get at least (kg m^2, or kg): of the order of small motors behind their gears.
_ARMATURE = 0.01
#: How long a random control acts (s of simulated time).
_HOLD = 0.02


class Remedy(NamedTuple):
    """What makes a model stable.

    words: what was changed
    model: a changed copy, an ``MjModel``
    """

    words: str
    model: Any


def instability(model: MjModel) -> str | None:
    """Plays a model for a second in C MuJoCo, from its first key frame or else its pose.

    Args:
      model: an ``MjModel``; it stays as it is.

    Returns:
      A line on where C MuJoCo meets numbers that are NaN or beyond 1e10, under no control or random
      ones in their range, and which of the usual remedies helps; None where it does not.
    """
    explosion = _explosion(model, _WAIT)
    if explosion is None:
        return None
    line = f"this model is unstable in C MuJoCo itself: {explosion}; "
    stable = remedy(model)
    if stable is None:
        return f"{line}{', '.join(_TRIALS)} do not mend it: try softer servos"
    return f"{line}with {stable.words} it is stable (python -m mjx_reinforce.new --fix writes it)"


def remedy(model: MjModel) -> Remedy | None:
    """Returns the first remedy that keeps an unstable model stable for a second in C MuJoCo.

    Args:
      model: an ``MjModel``; it stays as it is.

    Returns:
      None where the model is stable, or no remedy helps.
    """
    if _explosion(model, _WAIT) is None:
        return None
    for names in _COMBINATIONS:
        copied = copy.copy(model)
        words = [words for name in names if (words := _TRIALS[name](copied)) is not None]
        # What MuJoCo derives of armatures, such as how soft contacts are.
        _C.mj_setConst(copied, _C.MjData(copied))
        if words and _explosion(copied, _TRIAL_WAIT, unfinished="not tried for a second") is None:
            return Remedy(" and ".join(words), copied)
    return None


def _fast_implicit(model: Any) -> str | None:
    """Integrates damping implicitly, which MJX has not with a fluid."""
    fluid = model.opt.density or model.opt.viscosity or model.opt.wind.any()
    if fluid or model.opt.integrator == _C.mjtIntegrator.mjINT_IMPLICITFAST:
        return None
    model.opt.integrator = _C.mjtIntegrator.mjINT_IMPLICITFAST
    return 'integrator="implicitfast"'


def _servo_damping(model: Any) -> str | None:
    """Damps servos of joints critically: kv is twice the root of kp and the joint's inertia."""
    stiffness = model.actuator_gainprm[:, 0]
    is_servo = (stiffness > 0) & (model.actuator_biasprm[:, 1] == -stiffness)
    is_servo &= model.actuator_trntype == _C.mjtTrn.mjTRN_JOINT
    joints = model.actuator_trnid[is_servo, 0]
    # Seen through the gear, as where MuJoCo computes kv from a dampratio.
    inertia = model.dof_M0[model.jnt_dofadr[joints]] / model.actuator_gear[is_servo, 0] ** 2
    damping = 2 * np.sqrt(stiffness[is_servo] * inertia)
    # In the six digits of a file.
    damping = np.array([float(f"{x:.6g}") for x in damping])
    if np.all(damping <= -model.actuator_biasprm[is_servo, 2]):
        return None
    model.actuator_biasprm[is_servo, 2] = -np.maximum(damping, -model.actuator_biasprm[is_servo, 2])
    least, most = (f"{x:.3g}" for x in (damping.min(), damping.max()))
    return f"kv {least} of servos" if least == most else f"kv {least} to {most} of servos"


def _armature(model: Any) -> str | None:
    """Gives hinges and slides an inertia of their own."""
    scalar = (_C.mjtJoint.mjJNT_HINGE, _C.mjtJoint.mjJNT_SLIDE)
    dofs = model.jnt_dofadr[np.isin(model.jnt_type, scalar)]
    if np.all(model.dof_armature[dofs] >= _ARMATURE):
        return None
    model.dof_armature[dofs] = np.maximum(model.dof_armature[dofs], _ARMATURE)
    return f"armature {_ARMATURE:g} of joints"


def _half_timestep(model: Any) -> str | None:
    """Halves the timestep."""
    model.opt.timestep /= 2
    return f"timestep {model.opt.timestep:g}"


#: What is tried, by what a message calls it.
_TRIALS: dict[str, Callable[[Any], str | None]] = {
    "implicitfast": _fast_implicit,
    "damping of servos": _servo_damping,
    f"armature {_ARMATURE:g}": _armature,
    "half the timestep": _half_timestep,
}
_FAST, _DAMPING, _INERTIA, _HALF = _TRIALS
#: In this order: first what costs nothing, last what costs speed.
_COMBINATIONS = (
    (_FAST,),
    (_INERTIA,),
    (_DAMPING,),
    (_FAST, _DAMPING),
    (_FAST, _INERTIA, _DAMPING),
    (_HALF,),
    (_FAST, _INERTIA, _DAMPING, _HALF),
)


def _explosion(model: MjModel, wait: float, unfinished: str | None = None) -> str | None:
    """Returns under which controls and where a model explodes, if it does.

    Args:
      model: an ``MjModel``; it stays as it is.
      wait: how long each kind of controls may take (s).
      unfinished: what is returned if a second takes longer.
    """
    warning_texts: list[str] = []
    handler = _C.get_mju_user_warning()
    # Else MuJoCo prints, and writes a file into the folder of the user.
    _C.set_mju_user_warning(warning_texts.append)
    try:
        for kind, controls in (("no control", _zero(model)), ("random controls", _random(model))):
            deadline = time.perf_counter() + wait
            if (place := _play(model, controls, deadline)) is not None:
                return f"under {kind} it explodes after {place}"
            if time.perf_counter() > deadline and unfinished is not None:
                return unfinished
    finally:
        _C.set_mju_user_warning(handler)
    return None


def _play(model: MjModel, controls: Iterator[np.ndarray], deadline: float) -> str | None:
    """Returns after what time and where a model explodes under controls [A], if it does."""
    model = models.c_model(model)
    data = _C.MjData(model)
    if model.nkey:
        _C.mj_resetDataKeyframe(model, data, 0)
    timestep = model.opt.timestep
    # Controls that change in every physics step would average out before anything moves.
    hold = max(1, round(_HOLD / timestep))
    for step in range(round(_SECONDS / timestep)):
        if step % hold == 0:
            data.ctrl[:] = next(controls)
        try:
            _C.mj_step(model, data)
        except _C.FatalError as error:  # too many contacts, of parts that lie in each other
            return f"{step * timestep:.3g} s ({str(error).splitlines()[0]})"
        if was_reset(data):
            return f"{step * timestep:.3g} s ({_place(model, data)})"
        if time.perf_counter() > deadline:
            break
    return None


def _place(model: MjModel, data: Any) -> str:
    """Returns the degree of freedom, or the coordinate, of which C MuJoCo warned, and its joint."""
    kinds = _C.mjtWarning
    coordinate = data.warning[kinds.mjWARN_BADQPOS]
    if coordinate.number:
        # The last joint whose coordinates begin at this one or before.
        kind = "qpos"
        number = coordinate.lastinfo
        joint = int(np.searchsorted(model.jnt_qposadr, number, side="right")) - 1
    else:
        kind = "DOF"
        speeds = data.warning[kinds.mjWARN_BADQVEL], data.warning[kinds.mjWARN_BADQACC]
        number = next(x.lastinfo for x in speeds if x.number)
        joint = int(model.dof_jntid[number])
    return f"{kind} {number}, joint {model.joint(joint).name or joint!r}"


def _zero(model: MjModel) -> Iterator[np.ndarray]:
    """Yields controls of zero, or what is nearest in their range."""
    low, high = _ranges(model)
    while True:
        yield np.clip(0.0, low, high)


def _random(model: MjModel) -> Iterator[np.ndarray]:
    """Yields controls from all of their range; those without one are normal."""
    rng = np.random.default_rng(0)
    low, high = _ranges(model)
    # Limits are infinite in pairs; a range that is not used is drawn as [0, 0].
    is_bounded = np.isfinite(low)
    while True:
        normal = rng.normal(size=model.nu)
        bounded_controls = rng.uniform(np.where(is_bounded, low, 0), np.where(is_bounded, high, 0))
        yield np.where(is_bounded, bounded_controls, normal)


def _ranges(model: MjModel) -> tuple[np.ndarray, np.ndarray]:
    """Returns the least and the largest control [A], infinite where there is no limit."""
    low, high = model.actuator_ctrlrange.T
    is_limited = model.actuator_ctrllimited.astype(bool)
    return np.where(is_limited, low, -np.inf), np.where(is_limited, high, np.inf)
