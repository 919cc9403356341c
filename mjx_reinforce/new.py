"""``mjx-reinforce new my_arm.xml`` writes the class of an environment from a MuJoCo model."""

import dataclasses
import json
import re
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from mjx_reinforce.files import check_module, check_output, write_bytes
from mjx_reinforce.settings.flags import run_command

if TYPE_CHECKING:
    from mjx_reinforce.engine.base import MjModel

#: Of a robot that stands on its own.
_WALKING = """\
        # To walk: forward = (data.qpos[0] - before.qpos[0]) / self.dt is its speed along x (m/s).
        # To end where it falls: data.qpos[2] < {low:.2g} (m) in place of False.
"""


@dataclasses.dataclass(frozen=True)
class NewSettings:
    """Write the class of an environment from a MuJoCo model; its reward is yours to write."""

    model: tyro.conf.Positional[Path]
    """The model, .xml."""
    output: Path | None = None
    """The file to write, .py, in the folder of the model. By default the model's name."""
    overwrite: bool = False
    """Replace a file that exists."""


def main() -> None:
    """Reads the command line, writes, and exits: 0 done, 2 bad input, 130 interrupted."""
    run_command(NewSettings, "new", write_class)


def write_class(settings: NewSettings) -> None:
    """Writes the file, and says what to do with it.

    Raises:
      ValueError: there is no such model, MuJoCo or MJX cannot run it, or the file's name does not
        fit or exists.
    """
    xml = settings.model
    output = settings.output or xml.with_name(f"{re.sub(r'[^0-9a-zA-Z]+', '_', xml.stem)}.py")
    if xml.suffix.lower() != ".xml":
        raise ValueError(f"{xml} is no model; give an MJCF file that ends in .xml")
    check_module(output, "my_robot.py")
    if output.parent.resolve() != xml.parent.resolve():
        raise ValueError(f"{output} must be in the folder of {xml}, where it looks for the model")
    check_output(output, settings.overwrite, ".py")
    from mjx_reinforce.envs import models

    path = str(xml if xml.parent != Path() else Path.cwd() / xml)
    model = models.load_model(path)
    models.to_mjx(model, path)
    write_bytes(output, class_source(model, xml.name, output.stem).encode())
    module = output.stem
    train = f"mjx-reinforce train --env {module}:{_title(module)} --output {module}_run"
    print(f"{output}: write its reward, then, in its folder: {train}")


def class_source(model: "MjModel", xml: str, module: str) -> str:
    """Returns the text of the class.

    Args:
      model: an ``MjModel``.
      xml: the name of its file, in the folder of the class.
      module: the name of the class's file, without its ending.
    """
    timestep = float(model.opt.timestep)
    frame_skip = max(1, round(0.04 / timestep))
    walks = model.njnt > 0 and _kind(model, 0) == "free"
    seen, observed = ["positions (m, rad)", "speeds (m/s, rad/s)"], ["data.qpos", "data.qvel"]
    if walks:
        observed[0] = "data.qpos[2:]"
    if model.nsensordata:
        seen.append("sensors")
        observed.append("data.sensordata")
    pose = "self.mj_model.key_qpos[0]" if model.nkey else "self.mj_model.qpos0"
    height = float((model.key_qpos[0] if model.nkey else model.qpos0)[2]) if walks else 0.0
    template = Path(__file__).with_name("new_task.txt").read_text("utf-8")
    return template.format(
        title=_title(module),
        module=module,
        xml=json.dumps(xml),
        frame_skip=frame_skip,
        timestep=timestep,
        steps=round(5 / (frame_skip * timestep)) or 1,
        nq=model.nq,
        nv=model.nv,
        pose=pose,
        pose_name="key frame 0" if model.nkey else "the model's pose",
        unit="".join(_unit_quaternions(model)),
        walking=_WALKING.format(low=height / 2) if walks else "",
        seen=", ".join(seen),
        observed=", ".join(observed),
        without="  # without x and y" if walks else "",
        about=_about(model),
    )


def _title(module: str) -> str:
    """Returns the name of the class in a module: my_arm -> MyArm."""
    words = [word for word in module.split("_") if word]
    title = "".join(word[:1].upper() + word[1:] for word in words)
    return title if title.isidentifier() else f"Robot{title}"


def _kind(model: "MjModel", joint: int) -> str:
    return ("free", "ball", "slide", "hinge")[int(model.jnt_type[joint])]


def _unit_quaternions(model: "MjModel") -> Iterable[str]:
    """Yields a line for each quaternion of qpos, which noise makes longer or shorter."""
    for joint in range(model.njnt):
        if (kind := _kind(model, joint)) in ("free", "ball"):
            first = int(model.jnt_qposadr[joint]) + 3 * (kind == "free")
            part = f"{first}:{first + 4}"
            yield f"        qpos = qpos.at[{part}].divide(jnp.linalg.norm(qpos[{part}]))\n"


def _about(model: "MjModel") -> str:
    """Returns the docstring of the class: its positions, its actions, and what has a name."""
    joints = _listed(
        f"{_safe_name(model.joint(i).name, 'joint', i)} at {_place(model, i)}"
        for i in range(model.njnt)
    )
    actions = _listed(
        f"{_safe_name(_moved(model, i), 'actuator', i)}{_control_range(model, i)}"
        for i in range(model.nu)
    )
    counts = {"site": model.nsite, "body": model.nbody}
    named = ((kind, getattr(model, kind)(i).name) for kind in counts for i in range(counts[kind]))
    places = _listed(
        f"data.{kind}({json.dumps(name)}).xpos" for kind, name in named if name not in ("", "world")
    )
    said = f"What it should do.\n\n    Joints:\n{joints}\n    Actions:\n{actions}"
    return f"{said}\n    Places (m):\n{places}    " if places else f"{said}    "


def _place(model: "MjModel", joint: int) -> str:
    """Returns where the position of a joint is."""
    first, kind = int(model.jnt_qposadr[joint]), _kind(model, joint)
    if size := {"free": 7, "ball": 4}.get(kind):
        return f"qpos[{first}:{first + size}], {kind}"
    return f"qpos[{first}]"


def _listed(lines: Iterable[str]) -> str:
    return "".join(f"      {line}\n" for line in lines)


def _safe_name(name: str, kind: str, number: int) -> str:
    """Returns a name that is safe in a docstring, or what has none."""
    return re.sub(r'["\\\n]', "_", name) or f"{kind} {number}"


def _moved(model: "MjModel", number: int) -> str:
    """Returns the name of an actuator, or of the joint that it moves."""
    import mujoco

    kinds: Any = mujoco
    joints = int(kinds.mjtTrn.mjTRN_JOINT), int(kinds.mjtTrn.mjTRN_JOINTINPARENT)
    name = model.actuator(number).name
    if not name and model.actuator_trntype[number] in joints:
        return model.joint(model.actuator_trnid[number, 0]).name
    return name


def _control_range(model: "MjModel", number: int) -> str:
    low, high = model.actuator_ctrlrange[number]
    limits = f" in [{low:g}, {high:g}]" if model.actuator_ctrllimited[number] else ", unlimited"
    return f"{limits}, {model.key_ctrl[0, number]:g} in key frame 0" if model.nkey else limits


if __name__ == "__main__":
    main()
