"""``python -m mjx_reinforce.new arm.xml`` writes the class of a task from a MuJoCo model."""

import dataclasses
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import tyro

from mjx_reinforce.files import check_module, check_output, write_bytes
from mjx_reinforce.settings.flags import run_command

if TYPE_CHECKING:
    from mjx_reinforce.engine.base import MjModel


#: What a class says of a model whose actuators have a home: controls that hold its key frame.
_HOME = """\
        # An untrained policy acts in the middle of this space: on what holds the key frame.
        # Actions beyond it are allowed; MuJoCo clamps what they apply to ctrlrange.
{home}\
        self.scale = {scale}
        self.action_space = Box(-np.ones({nu}), np.ones({nu}))

    def control(self, action):
        \"""Returns what an action [{nu}] applies, MuJoCo's ctrl [{nu}].\"""
        return self.home + self.scale * action
"""
#: The controls of the key frame; or its joint angles, where all actuators are servos of joints.
_HOME_OF_CONTROLS = """\
        self.home = self.mj_model.key_ctrl[0]
"""
_HOME_OF_SERVOS = """\
        # The key frame has no controls: the servos aim at its joint angles.
        joints = self.mj_model.actuator_trnid[:, 0]
        self.home = self.mj_model.key_qpos[0, self.mj_model.jnt_qposadr[joints]]
"""
#: How far actions reach: of a robot on its legs less, since noise of all of it throws it down.
_SCALE = "self.unit"
_SCALE_ON_LEGS = "np.minimum(self.unit, 0.5)  # rad; more makes larger steps, and more falls"
#: Where an episode starts.
_POSE = """\
        return jnp.asarray(self.mj_model.qpos0), noise
"""
_KEY_FRAME = """\
        start = self.key_frame({key})  # with its act and ctrl, and poses of mocap bodies
        return start | {{"qvel": start["qvel"] + noise{ctrl}}}
"""


@dataclasses.dataclass(frozen=True)
class NewSettings:
    """Write the class of an environment for a MuJoCo model, with a reward for you to change."""

    model: tyro.conf.Positional[Path]
    """The model, .xml."""
    output: Path | None = None
    """The file to write, .py, in the folder of the model. By default the model's name."""
    fix: bool = False
    """Write a copy of the model, NAME_fixed.xml, with what makes it fast, accepted, and stable, and
    the class for this copy. Each change is printed."""
    overwrite: bool = False
    """Replace files that exist."""


def main() -> None:
    """Reads the command line, writes, and exits: 0 done, 2 bad input, 130 interrupted."""
    run_command(NewSettings, "new", write_class)


def write_class(settings: NewSettings) -> None:
    """Writes the file, and says what to do with it.

    Raises:
      ValueError: there is no such model, MuJoCo cannot run it, or the file's name does not fit or
        exists.
    """
    xml = settings.model
    if xml.suffix.lower() != ".xml":
        raise ValueError(f"{xml} is not a model; give an MJCF file that ends in .xml")
    if settings.fix:
        xml = _write_fixed(settings)
    output = settings.output or xml.with_name(f"{re.sub(r'[^0-9a-zA-Z]+', '_', xml.stem)}.py")
    check_module(output, "my_robot.py")
    if output.parent.resolve() != xml.parent.resolve():
        raise ValueError(f"{output} must be in the folder of {xml}, where it looks for the model")
    check_output(output, settings.overwrite, ".py")
    from mjx_reinforce.envs import models, refusals
    from mjx_reinforce.envs.instability import instability
    from mjx_reinforce.envs.mending.ground import contact_counts

    path = _path(xml)
    model = models.load_model(path)
    in_c = refusals.best_in_c(model)
    if in_c is None:
        models.to_mjx(model, path)
    write_bytes(output, class_source(model, xml.name, output.stem).encode())
    module = output.stem
    train = f"python -m mjx_reinforce.train --env {module}:{_title(module)} --output {module}_run"
    print(contact_counts(model))
    print("machine code will play it" if in_c is None else f"C MuJoCo will play it: {in_c}")
    if (warning := instability(model)) is not None:
        print(warning)
    if not settings.fix:
        _offer_fix(path)
    print(f"{output}: write its reward, then, in its folder: {train}")


def _path(xml: Path) -> str:
    """Returns a path with a folder: a name alone would mean one of the package's own models."""
    return str(Path.cwd() / xml if xml.parent == Path() else xml)


def _write_fixed(settings: NewSettings) -> Path:
    """Writes the mended copy of a model beside it, and returns its path, or that of the model.

    Raises:
      ValueError: the model cannot be loaded, or there is such a file already.
    """
    from mjx_reinforce.envs import models
    from mjx_reinforce.envs.mending import edits

    path = _path(settings.model)
    models.load_model(path)  # says what it lacks
    mended = edits.mend(path)
    if not mended.edits:
        print(f"{settings.model} needs no fix")
        return settings.model
    output = settings.model.with_name(f"{settings.model.stem}_fixed.xml")
    check_output(output, settings.overwrite, ".xml")
    write_bytes(output, mended.spec.to_xml().encode())
    print(f"{output}:", *mended.edits, sep="\n  ")
    return output


def _offer_fix(path: str) -> None:
    """Says what ``--fix`` would change in a model."""
    from mjx_reinforce.envs.mending import edits

    changes = edits.mend(path).edits
    if changes:
        print("--fix would write a copy with these changes:", *changes, sep="\n  ")


def class_source(model: "MjModel", xml: str, module: str) -> str:
    """Returns the text of the class.

    Args:
      model: an ``MjModel``.
      xml: the name of its file, in the folder of the class.
      module: the name of the class's file, without its ending.
    """
    timestep = float(model.opt.timestep)
    # Actions 25 times a second, as near as whole steps of the simulation come to that.
    frame_skip = max(1, round(0.04 / timestep))
    # A robot that stands on its own has a free joint (type 0) first, whose seven numbers are its
    # position and its orientation.
    is_free = bool(model.njnt > 0 and model.jnt_type[0] == 0)
    files = ["new_task.txt", "new_walk.txt" if is_free else "new_hold.txt"]
    template = "".join(Path(__file__).with_name(file).read_text("utf-8") for file in files)
    # Five seconds are an episode.
    num_steps = round(5 / (frame_skip * timestep)) or 1
    placeholders = _start_and_home(model, is_free)
    array = "ctrl" if placeholders["home"] else "action"
    if is_free:
        placeholders["body"] = int(model.jnt_bodyid[0])
        placeholders["up"] = _up(model)
    return template.format(
        title=_title(module),
        module=module,
        xml=json.dumps(xml),
        frame_skip=frame_skip,
        timestep=timestep,
        steps=num_steps,
        nv=model.nv,
        pose="self.mj_model.key_qpos[0]" if model.nkey else "self.mj_model.qpos0",
        observed="".join(f"                data.{x},\n" for x in _observation(model, is_free)),
        about="\n".join(_about(model, array)),
        **placeholders,
    )


def _observation(model: "MjModel", is_free: bool) -> Iterator[str]:
    """Yields the fields of mjData that the policy sees, of a robot with a free joint or without."""
    if is_free:
        # Not where it is on the ground, which should make no difference to a policy.
        yield "qpos[2:7]"
    joints = [model.joint(i).name for i in range(int(is_free), model.njnt)]
    if all(joints):
        yield from (f"joint({json.dumps(name)}).qpos" for name in joints)
    else:
        yield "qpos[7:]" if is_free else "qpos"
    yield "qvel"
    if model.nsensor > 0:
        yield "sensordata"


def _start_and_home(model: "MjModel", is_free: bool) -> dict[str, Any]:
    """Returns the parts of the class that depend on the model's key frame and actuators."""
    # What a robot without a key frame, a home or a free joint needs in these places.
    placeholders: dict[str, Any] = {
        "home": "",
        "imports": "",
        "effort": "action / self.unit",
        "start": _POSE,
        "body": 0,
        "up": "",
    }
    if not model.nkey:
        return placeholders
    has_controls = bool(model.key_ctrl[0].any())
    has_servos = _has_servos(model)
    ctrl = ""
    if has_servos and not has_controls:
        ctrl = ', "ctrl": self.home'
    key = json.dumps(model.key(0).name or 0)
    placeholders["start"] = _KEY_FRAME.format(key=key, ctrl=ctrl)
    if has_controls or has_servos:
        home = _HOME_OF_CONTROLS if has_controls else _HOME_OF_SERVOS
        scale = _SCALE_ON_LEGS if is_free and has_servos else _SCALE
        placeholders["home"] = _HOME.format(home=home, scale=scale, nu=model.nu)
        placeholders["imports"] = "from mjx_reinforce import Box\n"
        placeholders["effort"] = "action"
    return placeholders


def _has_servos(model: "MjModel") -> bool:
    """Returns whether every control of a model is the position to which a servo moves a joint."""
    import mujoco

    c: Any = mujoco
    is_of_joint = model.actuator_trntype == c.mjtTrn.mjTRN_JOINT
    if not is_of_joint.all():
        return False
    joint_types = model.jnt_type[model.actuator_trnid[:, 0]]
    is_scalar = np.isin(joint_types, (c.mjtJoint.mjJNT_HINGE, c.mjtJoint.mjJNT_SLIDE))
    # As ``<position>`` is: the force is a stiffness times the way that is left, and damping.
    is_affine = model.actuator_biastype == c.mjtBias.mjBIAS_AFFINE
    is_pulled = model.actuator_biasprm[:, 1] == -model.actuator_gainprm[:, 0]
    is_direct = model.actuator_gear[:, 0] == 1
    return bool((is_scalar & is_affine & is_pulled & is_direct).all())


def _up(model: "MjModel") -> list[float]:
    """Returns which way is up [3], in the axes of a robot that stands in its first pose."""
    import mujoco

    data: Any = mujoco.MjData(model)  # pyright: ignore[reportAttributeAccessIssue]
    data.qpos[:] = model.key_qpos[0] if model.nkey else model.qpos0
    mujoco.mj_kinematics(model, data)  # pyright: ignore[reportAttributeAccessIssue]
    return data.xmat[model.jnt_bodyid[0]].reshape(3, 3)[2].round(3).tolist()


def _title(module: str) -> str:
    """Returns the name of the class in a module: my_arm -> MyArm."""
    return "".join(word[:1].upper() + word[1:] for word in module.split("_"))


def _about(model: "MjModel", array: str) -> Iterator[str]:
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


if __name__ == "__main__":
    main()
