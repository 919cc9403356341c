"""What the text of a class says of a model."""

import json
import keyword
import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from mjx_reinforce.engine.base import MjModel


def class_name(module: str) -> str:
    """Returns the name of the class in a module: my_arm -> MyArm, and box -> TaskBox.

    The class must not hide what the templates import or define, as they do ``Box``.
    """
    name = "".join(word[:1].upper() + word[1:] for word in module.split("_"))
    is_name = name.isidentifier() and not keyword.iskeyword(name)
    texts = (file.read_text("utf-8") for file in Path(__file__).parent.glob("*.txt"))
    is_taken = any(re.search(rf"\b{name}\b", text) for text in texts)
    return name if is_name and not is_taken else f"Task{name}"


def quoted(name: str) -> str:
    """Returns a name of a model as Python writes it in double quotes, on one line."""
    # JSON's own escapes of what is beyond 16 bits are two characters in Python.
    return json.dumps(name, ensure_ascii=False)


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
        yield f"    {array}[{i}]: actuator {quoted(name)}{limits}"


def is_free(model: "MjModel") -> bool:
    """Returns whether the first joint of a model is free (type 0), as that of a robot on legs."""
    return bool(model.njnt > 0 and model.jnt_type[0] == 0)


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
    # Of an integrator, as <intvelocity> has one, the control is a speed.
    lags = (c.mjtDyn.mjDYN_NONE, c.mjtDyn.mjDYN_FILTER, c.mjtDyn.mjDYN_FILTEREXACT)
    is_position = np.isin(model.actuator_dyntype, lags)
    return is_of_joint & is_scalar & is_affine & is_pulled & is_direct & is_position


def direction_up(model: "MjModel") -> list[float]:
    """Returns which way is up [3], in the axes of a robot that stands in its first pose."""
    import mujoco

    data: Any = mujoco.MjData(model)  # pyright: ignore[reportAttributeAccessIssue]
    data.qpos[:] = model.key_qpos[0] if model.nkey else model.qpos0
    mujoco.mj_kinematics(model, data)  # pyright: ignore[reportAttributeAccessIssue]
    return data.xmat[model.jnt_bodyid[0]].reshape(3, 3)[2].round(3).tolist()
