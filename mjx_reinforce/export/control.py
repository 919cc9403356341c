"""What a task applies of an action, for programs that play its policy without the task."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_reinforce.engine.base import Environment
from mjx_reinforce.engine.checks import require
from mjx_reinforce.files import Arrays

#: At how many random actions the numbers are checked, and to which part of the largest number.
_NUM_CHECKS = 16
_TOLERANCE = 1e-7


def affine_control(env: Environment) -> Arrays:
    """Returns the numbers of a task's ``control``: home + scale * action, in the actuators' ranges.

    Where the task has a ``gait``, it is added before the sum is clipped.

    Args:
      env: a ``MujocoEnv``, or a wrapper of one.

    Returns:
      ``home``, ``scale``, ``ctrl_low`` and ``ctrl_high`` [A], float32; bounds may be infinite. Of a
      task with a gait also ``gait`` [P, A].

    Raises:
      ValueError: the task has no ``control``, ``control`` computes something else, or the gait is
        no table of finite numbers.
    """
    task: Any = env
    while not hasattr(task, "control") and hasattr(task, "env"):
        task = task.env
    if not hasattr(task, "control"):
        raise ValueError(f"{type(task).__name__} has no control; leave --env out")
    space = task.action_space
    low = np.maximum(space.low, -1.0)
    high = np.minimum(space.high, 1.0)
    actions = np.random.default_rng(0).uniform(low, high, size=(_NUM_CHECKS, len(low)))
    with jax.enable_x64(True):
        start = _control(task, low)
        rows = [
            _control(task, np.where(x, high, low)) - start for x in np.eye(len(low), dtype=bool)
        ]
        controls = np.array([_control(task, action) for action in actions])
    matrix = np.array(rows) / (high - low)[:, None]
    scale = np.diagonal(matrix)
    home = start - scale * low if start.shape == low.shape else start
    limit = _TOLERANCE * np.abs(controls).max()
    if home.shape != scale.shape or np.abs(home + scale * actions - controls).max() > limit:
        raise ValueError(
            f"control of {type(task).__name__} is not home + scale * action, one number each; "
            "leave --env out, and compute ctrl from the action as control does"
        )
    bounds = np.where(
        task.mj_model.actuator_ctrllimited[:, None],
        task.mj_model.actuator_ctrlrange,
        [-np.inf, np.inf],
    )
    arrays = {"home": home, "scale": scale, "ctrl_low": bounds[:, 0], "ctrl_high": bounds[:, 1]}
    if task.gait is not None:
        arrays["gait"] = _gait(task, len(home))
    return {name: array.astype(np.float32) for name, array in arrays.items()}


def _gait(task: Any, num_controls: int) -> np.ndarray:
    """Returns the gait [P, A] of a task, or raises ValueError where it is no such table."""
    gait = np.asarray(task.gait)
    is_table = gait.ndim == 2 and len(gait) > 0 and gait.shape[1] == num_controls
    require(
        is_table and gait.dtype.kind in "iuf" and bool(np.isfinite(gait).all()),
        f"gait of {type(task).__name__} is what actuate adds to the controls at each env step of a "
        f"period: finite numbers [P, {num_controls}], got {gait.dtype}{list(gait.shape)}",
    )
    return gait


def _control(task: Any, action: np.ndarray) -> np.ndarray:
    """Returns what an action [A] applies, in float64."""
    return np.asarray(task.control(jnp.asarray(action, float)), float)
