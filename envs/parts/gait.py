"""Gaits: what lifts the feet of a robot in turn, to which a policy adds its actions.

The idea is that of Iscen et al., Policies Modulating Trajectory Generators, 2018: a policy that has
to find a gait by noise alone first learns to stand still.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.typing import ArrayLike

from mjx_reinforce.engine.base import MjModel
from mjx_reinforce.engine.checks import require

_C: Any = mujoco  # a C extension without stubs
#: A geom is a foot if it is at most so much higher than the lowest geom of all limbs (m).
_ABOVE_LOWEST = 0.05
#: Steps of Newton's method on the place of a foot, and the damping of its least squares.
_ITERATIONS = 20
_DAMPING = 1e-4


class Foot(NamedTuple):
    """The end of a limb on which a robot stands.

    geom: its number in the model
    joints: the numbers of the hinges and slides between the root and it
    position: [3] the center of the geom in the first pose (m)
    """

    geom: int
    joints: tuple[int, ...]
    position: np.ndarray


def feet(model: MjModel) -> list[Foot]:
    """Returns the feet in their order around the robot, from behind on, seen from above.

    A foot is the lowest geom of a limb that may touch something, in the first key frame, or in the
    model's pose where there is none. Limbs are told apart by their first joint.
    """
    data = _first_pose(model)
    may_touch = (np.asarray(model.geom_contype) | np.asarray(model.geom_conaffinity)) != 0
    may_touch[[*model.pair_geom1, *model.pair_geom2]] = True
    lowest: dict[int, tuple[float, Foot]] = {}
    for geom in np.flatnonzero(may_touch):
        joints = _joints_to(model, model.geom_bodyid[geom])
        if not joints:
            continue
        position = data.geom_xpos[geom].copy()
        height = position[2] - model.geom_rbound[geom]
        if joints[0] not in lowest or height < lowest[joints[0]][0]:
            lowest[joints[0]] = height, Foot(int(geom), joints, position)
    floor = min((height for height, _ in lowest.values()), default=0.0)
    standing = [foot for height, foot in lowest.values() if height < floor + _ABOVE_LOWEST]
    middle = np.mean([foot.position for foot in standing], axis=0) if standing else 0.0

    def direction(foot: Foot) -> float:
        x, y, _ = foot.position - middle
        return float(np.arctan2(y, x))

    return sorted(standing, key=direction)


def gait(model: MjModel, height: float, num_steps: int) -> np.ndarray:
    """Returns what lifts the feet in turn [num_steps, nu] (rad, m), to be added to the home pose.

    Neighbors alternate: four legs trot, two walk, and six move in threes. Each foot is lifted
    straight up, along half a sine, in one half of the period, and stands in the other.

    Args:
      model: all of whose actuators are position servos of hinges or slides, with gear 1.
      height: of a lifted foot over where it stands (m).
      num_steps: env steps of a period.

    Raises:
      ValueError: the robot stands on fewer than two feet.
    """
    standing = feet(model)
    require(
        len(standing) > 1,
        f"a gait needs two feet or more, and this model has {len(standing)}: geoms at the ends of "
        "limbs that may touch the floor, lowest in the first key frame",
    )
    addresses = model.jnt_qposadr[model.actuator_trnid[:, 0]]
    lifts = np.stack([_lift(model, foot, height)[addresses] for foot in standing])
    turns = np.arange(num_steps)[:, None] / num_steps + np.arange(len(standing)) / 2
    return np.maximum(np.sin(2 * np.pi * turns), 0.0) @ lifts


def cyclic(table: ArrayLike, step: ArrayLike) -> jax.Array:
    """Returns the row [...] of a table [N, ...] that repeats, at a count of env steps."""
    rows = jnp.asarray(table)
    phase = jnp.asarray(step) % len(rows)
    # No index: machine code chooses between the rows.
    row = rows[0]
    for number in range(1, len(rows)):
        row = jnp.where(phase == number, rows[number], row)
    return row


def clock(step: ArrayLike, num_steps: int) -> jax.Array:
    """Returns sine and cosine [2] of where a count of env steps is in a period of num_steps."""
    angle = 2 * np.pi / num_steps * (jnp.asarray(step) % num_steps)
    return jnp.stack([jnp.sin(angle), jnp.cos(angle)])


def _first_pose(model: MjModel) -> Any:
    """Returns an ``MjData`` in the first key frame, or in the model's pose."""
    data = _C.MjData(model)
    if model.nkey:
        data.qpos[:] = model.key_qpos[0]
    _C.mj_kinematics(model, data)
    _C.mj_comPos(model, data)
    return data


def _joints_to(model: MjModel, body: int) -> tuple[int, ...]:
    """Returns the hinges and slides between the root and a body, the root's side first."""
    joints: list[int] = []
    while body:
        first = model.body_jntadr[body]
        joints += reversed(range(first, first + model.body_jntnum[body]))
        body = model.body_parentid[body]
    scalar = (int(_C.mjtJoint.mjJNT_HINGE), int(_C.mjtJoint.mjJNT_SLIDE))
    return tuple(int(joint) for joint in reversed(joints) if model.jnt_type[joint] in scalar)


def _lift(model: MjModel, foot: Foot, height: float) -> np.ndarray:
    """Returns the change of qpos [nq] that lifts a foot straight up: damped least squares."""
    data = _first_pose(model)
    pose = data.qpos.copy()
    body = model.geom_bodyid[foot.geom]
    dofs = model.jnt_dofadr[list(foot.joints)]
    addresses = model.jnt_qposadr[list(foot.joints)]
    jacobian = np.zeros((3, model.nv))
    for _ in range(_ITERATIONS):
        position = data.geom_xpos[foot.geom]
        way = foot.position + [0.0, 0.0, height] - position
        _C.mj_jac(model, data, jacobian, None, position, body)
        columns = jacobian[:, dofs]
        square = columns @ columns.T + _DAMPING * np.eye(3)
        data.qpos[addresses] += columns.T @ np.linalg.solve(square, way)
        _C.mj_kinematics(model, data)
        _C.mj_comPos(model, data)
    return data.qpos - pose
