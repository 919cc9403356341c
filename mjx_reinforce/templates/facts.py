"""What the text of a class says of a model."""

import json
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from mjx_reinforce.engine.base import MjModel


def class_name(module: str) -> str:
    """Returns the name of the class in a module: my_arm -> MyArm."""
    return "".join(word[:1].upper() + word[1:] for word in module.split("_"))


def action_lines(model: "MjModel", array: str) -> Iterator[str]:
    """Yields the lines of the class's docstring: what the entries of an array move."""
    for i in range(model.nu):
        low, high = model.actuator_ctrlrange[i]
        limits = ""
        if model.actuator_ctrllimited[i]:
            limits = f" in [{low:g}, {high:g}]"
        name = model.actuator(i).name
        # An actuator without a name goes by the joint that it moves, where it moves one (type 0).
        if not name and model.actuator_trntype[i] == 0:
            name = model.joint(model.actuator_trnid[i, 0]).name
        name = json.dumps(name)
        yield f"    {array}[{i}]: actuator {name}{limits}"


def is_servo(model: "MjModel") -> np.ndarray:
    """Returns of each control [nu] whether it is the position to which a servo moves a joint."""
    import mujoco

    c: Any = mujoco
    is_of_joint = model.actuator_trntype == c.mjtTrn.mjTRN_JOINT
    if not is_of_joint.any():
        return is_of_joint
    joint_types = model.jnt_type[np.where(is_of_joint, model.actuator_trnid[:, 0], 0)]
    is_scalar = np.isin(joint_types, (c.mjtJoint.mjJNT_HINGE, c.mjtJoint.mjJNT_SLIDE))
    # As ``<position>`` is: the force is a stiffness times the way that is left, and damping.
    is_affine = model.actuator_biastype == c.mjtBias.mjBIAS_AFFINE
    is_pulled = model.actuator_biasprm[:, 1] == -model.actuator_gainprm[:, 0]
    is_direct = model.actuator_gear[:, 0] == 1
    return is_of_joint & is_scalar & is_affine & is_pulled & is_direct


def direction_up(model: "MjModel") -> list[float]:
    """Returns which way is up [3], in the axes of a robot that stands in its first pose."""
    import mujoco

    data: Any = mujoco.MjData(model)  # pyright: ignore[reportAttributeAccessIssue]
    data.qpos[:] = model.key_qpos[0] if model.nkey else model.qpos0
    mujoco.mj_kinematics(model, data)  # pyright: ignore[reportAttributeAccessIssue]
    return data.xmat[model.jnt_bodyid[0]].reshape(3, 3)[2].round(3).tolist()
