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
from mjx_reinforce.engine.checks import check_count, check_number, require
from mjx_reinforce.envs.mending.ground import first_pose, stance

_C: Any = mujoco  # a C extension without stubs
#: Steps of Newton's method on the place of a foot, and the damping of its least squares.
_ITERATIONS = 20
_DAMPING = 1e-4
#: How far from its place a lifted foot may be, as a part of the height.
_PRECISION = 0.1


class Foot(NamedTuple):
    """The end of a limb on which a robot stands.

    geom: its number in the model
    joints: the numbers of the hinges and slides of the limb, from the root on
    position: [3] the center of the geom in the first pose (m)
    """

    geom: int
    joints: tuple[int, ...]
    position: np.ndarray


def feet(model: MjModel) -> list[Foot]:
    """Returns the feet in their order around the robot, from behind on, seen from above.

    They are the geoms that come nearest the floor in the first key frame, or in the model's pose
    where there is none; of each limb, which its first joint tells from others, one. A joint that
    all feet hang on, such as a waist, is of no limb.
    """
    standing = stance(model)
    if standing is None:
        return []
    data = first_pose(model)
    limbs: dict[int, Foot] = {}
    paths = {geom: _joints_to(model, model.geom_bodyid[geom]) for geom in standing.feet}
    paths = {geom: path for geom, path in paths.items() if path}
    num_shared = _num_shared([*paths.values()])
    for geom, path in paths.items():
        joints = path[num_shared:]
        limbs.setdefault(joints[0], Foot(geom, joints, data.geom_xpos[geom].copy()))
    middle = np.mean([foot.position for foot in limbs.values()] or np.zeros((1, 3)), axis=0)

    def direction(foot: Foot) -> float:
        x, y, _ = foot.position - middle
        return float(np.arctan2(y, x))

    return sorted(limbs.values(), key=direction)


def gait(model: MjModel, height: float, num_steps: int) -> np.ndarray:
    """Returns what lifts the feet in turn [num_steps, nu] (rad, m), to be added to the home pose.

    Neighbors alternate: four legs trot, two walk, and six move in threes. Each foot is lifted
    straight up, along half a sine, in one half of the period, and stands in the other.

    Args:
      model: all of whose actuators are position servos of hinges or slides, with gear 1.
      height: of a lifted foot over where it stands (m).
      num_steps: env steps of a period.

    Raises:
      ValueError: the robot stands on fewer than two feet, or a leg cannot lift its foot that far
        from the first pose; a number is out of its range.
    """
    check_count("num_steps", num_steps)
    check_number("height", height)
    standing = feet(model)
    require(
        len(standing) > 1,
        f"a gait needs two feet or more, and this model has {len(standing)}: geoms of limbs that "
        "may touch a floor, and come nearest to it in the first key frame",
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


def _joints_to(model: MjModel, body: int) -> tuple[int, ...]:
    """Returns the hinges and slides between the root and a body, the root's side first."""
    joints: list[int] = []
    while body:
        first = model.body_jntadr[body]
        joints += reversed(range(first, first + model.body_jntnum[body]))
        body = model.body_parentid[body]
    scalar = (int(_C.mjtJoint.mjJNT_HINGE), int(_C.mjtJoint.mjJNT_SLIDE))
    return tuple(int(joint) for joint in reversed(joints) if model.jnt_type[joint] in scalar)


def _num_shared(paths: list[tuple[int, ...]]) -> int:
    """Returns how many joints all paths begin with; each keeps one or more after them."""
    shortest = min(map(len, paths), default=1) - 1
    is_shared = [len(set(joints)) == 1 for joints in zip(*paths, strict=False)]
    return [*is_shared[:shortest], False].index(False)


def _lift(model: MjModel, foot: Foot, height: float) -> np.ndarray:
    """Returns the change of qpos [nq] that lifts a foot straight up: damped least squares."""
    data = first_pose(model)
    _C.mj_comPos(model, data)
    pose = data.qpos.copy()
    body = model.geom_bodyid[foot.geom]
    dofs = model.jnt_dofadr[list(foot.joints)]
    addresses = model.jnt_qposadr[list(foot.joints)]
    goal = np.add(foot.position, [0.0, 0.0, height])
    jacobian = np.zeros((3, model.nv))
    for _ in range(_ITERATIONS):
        position = data.geom_xpos[foot.geom]
        way = goal - position
        _C.mj_jac(model, data, jacobian, None, position, body)
        columns = jacobian[:, dofs]
        square = columns @ columns.T + _DAMPING * np.eye(3)
        data.qpos[addresses] += columns.T @ np.linalg.solve(square, way)
        _C.mj_kinematics(model, data)
        _C.mj_comPos(model, data)
    # A straight leg does not know which way to bend, and a short one does not reach.
    rest = np.linalg.norm(goal - data.geom_xpos[foot.geom])
    require(
        rest <= _PRECISION * height,
        f"a foot (geom {foot.geom}) is not lifted by {height:g} m: its leg leaves {rest:.2g} m of "
        "that; bend the leg in the first key frame, or lift less",
    )
    return data.qpos - pose
