"""``mjx-reinforce new my_arm.xml`` writes the class of an environment from a MuJoCo model."""

import dataclasses
import json
import keyword
import re
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from mjx_reinforce.console.streams import accept_everything
from mjx_reinforce.files import write_bytes
from mjx_reinforce.settings.flags import one_line_errors, read_command_line

if TYPE_CHECKING:
    from mjx_reinforce.types import MjModel

#: What is named in the class, by mjData's arrays whose rows it numbers.
_POSITION_OF = {"site": "site_xpos", "body": "xpos"}


@dataclasses.dataclass(frozen=True)
class NewSettings:
    """Write the class of an environment from a MuJoCo model; its reward is yours to write."""

    model: tyro.conf.Positional[Path]
    """The model, .xml."""
    output: Path | None = None
    """The file to write, .py, in the folder of the model. By default the model's name."""
    overwrite: bool = False
    """Replace a file that exists."""


def main(argv: Sequence[str] | None = None) -> None:
    """Reads the command line, writes, and exits: 0 done, 2 bad input, 130 interrupted.

    Args:
      argv: what follows the command's name; by default what the program was started with.
    """
    accept_everything()
    with one_line_errors():
        arguments = sys.argv[1:] if argv is None else argv
        output = write_class(
            read_command_line(
                NewSettings, arguments, "mjx-reinforce new", NewSettings.__doc__ or ""
            )
        )
        module = output.stem
        command = f"mjx-reinforce train --env {module}:{_title(module)} --output {module}_run"
        print(f"{output}: write its reward, then, in its folder: {command}")


def write_class(settings: NewSettings) -> Path:
    """Writes the file and returns its name.

    Raises:
      ValueError: there is no such model, MuJoCo or MJX cannot run it, or the file's name does not
        fit or exists.
    """
    xml = settings.model
    output = settings.output or xml.with_name(f"{re.sub(r'[^0-9a-zA-Z]+', '_', xml.stem)}.py")
    if xml.suffix.lower() != ".xml":
        raise ValueError(f"{xml} is no model; give an MJCF file that ends in .xml")
    name = output.stem
    if output.suffix != ".py" or not name.isidentifier() or keyword.iskeyword(name):
        raise ValueError(
            f"Python cannot import {output.name!r}; choose an --output of letters, digits and "
            "underscores that ends in .py, such as my_robot.py"
        )
    if name in sys.stdlib_module_names:
        raise ValueError(f"{output.name} would hide Python's {name}; choose another --output")
    if output.parent.resolve() != xml.parent.resolve():
        raise ValueError(f"{output} must be in the folder of {xml}, where it looks for the model")
    if output.exists() and not settings.overwrite:
        raise ValueError(f"{output} exists; pass --overwrite or another --output")
    from mjx_reinforce.envs import models

    path = str(xml if xml.parent != Path() else Path.cwd() / xml)
    model = models.load_model(path)
    models.to_mjx(model, path)
    write_bytes(output, class_source(model, xml.name, name).encode())
    return output


def class_source(model: "MjModel", xml: str, module: str) -> str:
    """Returns the text of the class.

    Args:
      model: an ``MjModel``.
      xml: the name of its file, in the folder of the class.
      module: the name of the class's file, without its ending.
    """
    timestep = float(model.opt.timestep)
    frame_skip = max(1, round(0.04 / timestep))
    seen, observed = ["positions (m, rad)", "speeds (m/s, rad/s)"], ["data.qpos", "data.qvel"]
    if model.nsensordata:
        seen.append("sensors")
        observed.append("data.sensordata")
    constants = "".join(_constants(model))
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
        constants=f"{constants}\n\n" if constants else "\n",
        seen=", ".join(seen),
        observed=", ".join(observed),
        about=_about(model),
    )


def _title(module: str) -> str:
    """Returns the name of the class in a module: my_arm -> MyArm."""
    words = [word for word in module.split("_") if word]
    title = "".join(word[:1].upper() + word[1:] for word in words)
    return title if title.isidentifier() else f"Robot{title}"


def _constants(model: "MjModel") -> Iterable[str]:
    """Yields a line for each named site and body: its number, by which outcome finds it."""
    taken = set()
    for kind, array in _POSITION_OF.items():
        count = {"site": model.nsite, "body": model.nbody}[kind]
        for number in range(count):
            name = getattr(model, kind)(number).name
            constant = re.sub(r"\W+", "_", f"{kind}_{name}").upper()
            if name and name != "world" and constant not in taken:
                taken.add(constant)
                yield f"{constant} = {number}  # data.{array}[{constant}] is where it is (m)\n"


def _about(model: "MjModel") -> str:
    """Returns the docstring of the class: what its positions and actions are."""
    joints = _listed(
        f"{_safe_name(model.joint(i).name, 'joint', i)} at qpos[{int(model.jnt_qposadr[i])}]"
        for i in range(model.njnt)
    )
    actions = _listed(
        f"{_safe_name(_moved(model, i), 'actuator', i)}{_control_range(model, i)}"
        for i in range(model.nu)
    )
    return f"What it should do.\n\n    Joints:\n{joints}\n    Actions:\n{actions}    "


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
    return f" in [{low:g}, {high:g}]" if model.actuator_ctrllimited[number] else ", unlimited"


if __name__ == "__main__":
    main()
