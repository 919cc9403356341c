"""Whether a model explodes in C MuJoCo itself, which no learning rate mends."""

import time
from collections.abc import Iterator
from typing import Any

import mujoco
import numpy as np

from mjx_reinforce.engine.base import MjModel
from mjx_reinforce.envs.in_mujoco import was_reset

#: MuJoCo's own names; it is a C extension without stubs.
_C: Any = mujoco
#: Simulated time (s).
_SECONDS = 1.0
#: How long that may take on the clock (s); a large model is tried for less.
_WAIT = 0.04
#: How long a random control acts (s of simulated time).
_HOLD = 0.02


def instability(model: MjModel) -> str | None:
    """Plays a model for a second in C MuJoCo, from its first key frame or else its pose.

    Args:
      model: an ``MjModel``; it stays as it is.

    Returns:
      A line on where C MuJoCo meets numbers that are NaN or beyond 1e10 and what helps, under no
      control or random ones in their range; None where it does not.
    """
    warning_texts: list[str] = []
    handler = _C.get_mju_user_warning()
    # Else MuJoCo prints, and writes a file into the folder of the user.
    _C.set_mju_user_warning(warning_texts.append)
    try:
        for kind, controls in (("no control", _zero(model)), ("random controls", _random(model))):
            if (explosion := _play(model, controls)) is not None:
                return (
                    f"this model is unstable in C MuJoCo itself: under {kind} it explodes after "
                    f"{explosion}; try a smaller timestep, armature at the joints, "
                    '<option integrator="implicitfast"/>, or softer servos'
                )
    finally:
        _C.set_mju_user_warning(handler)
    return None


def _play(model: MjModel, controls: Iterator[np.ndarray]) -> str | None:
    """Returns after what time and where a model explodes under controls [A], if it does."""
    data = _C.MjData(model)
    deadline = time.perf_counter() + _WAIT
    if model.nkey:
        _C.mj_resetDataKeyframe(model, data, 0)
    timestep = model.opt.timestep
    # Controls that change in every physics step would average out before anything moves.
    hold = max(1, round(_HOLD / timestep))
    for step in range(round(_SECONDS / timestep)):
        if step % hold == 0:
            data.ctrl[:] = next(controls)
        _C.mj_step(model, data)
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
