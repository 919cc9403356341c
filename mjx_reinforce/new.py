"""``python -m mjx_reinforce.new arm.xml`` writes the class of a task from a MuJoCo model."""

import dataclasses
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

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
    train = f"python -m mjx_reinforce.train --env {module}:{_title(module)} --output {module}_run"
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
    free = [i for i in range(model.njnt) if model.jnt_type[i] == 0]
    pose = "self.mj_model.key_qpos[0]" if model.nkey else "self.mj_model.qpos0"
    height = float((model.key_qpos[0] if model.nkey else model.qpos0)[2]) if free else 0.0
    observed = ["data.qpos[2:]" if free == [0] else "data.qpos", "data.qvel"]
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
        unit="".join(_unit_quaternions(model)),
        walking=_WALKING.format(low=height / 2) if free == [0] else "",
        observed=", ".join(observed + ["data.sensordata"] * (model.nsensordata > 0)),
        about="".join(_about(model)),
    )


def _title(module: str) -> str:
    """Returns the name of the class in a module: my_arm -> MyArm."""
    title = "".join(word[:1].upper() + word[1:] for word in module.split("_"))
    return title if title.isidentifier() else f"Robot{title}"


def _size(model: "MjModel", joint: int) -> int:
    """Returns how many entries of qpos a joint has: free, ball, slide or hinge."""
    return (7, 4, 1, 1)[int(model.jnt_type[joint])]


def _unit_quaternions(model: "MjModel") -> Iterator[str]:
    """Yields a line for each quaternion of qpos, which noise makes longer or shorter."""
    for joint in range(model.njnt):
        if (size := _size(model, joint)) > 1:
            end = int(model.jnt_qposadr[joint]) + size
            part = f"{end - 4}:{end}"
            yield f"        qpos = qpos.at[{part}].divide(jnp.linalg.norm(qpos[{part}]))\n"


def _about(model: "MjModel") -> Iterator[str]:
    """Yields the lines of the class's docstring: its positions, its actions, and its places."""
    yield "    Joints:\n"
    for i in range(model.njnt):
        first, size = int(model.jnt_qposadr[i]), _size(model, i)
        where = f"{first}:{first + size}" if size > 1 else first
        yield f"      {_safe_name(model.joint(i).name, 'joint', i)} at qpos[{where}]\n"
    yield "    Actions:\n"
    for i in range(model.nu):
        low, high = model.actuator_ctrlrange[i]
        limits = f"in [{low:g}, {high:g}]" if model.actuator_ctrllimited[i] else "unlimited"
        moved = (
            model.joint(model.actuator_trnid[i, 0]).name if model.actuator_trntype[i] == 0 else ""
        )
        name = _safe_name(model.actuator(i).name or moved, "actuator", i)
        yield f"      {name}, {limits}\n"
    yield "    Places (m):\n"
    for kind, count in (("site", model.nsite), ("body", model.nbody)):
        for name in (getattr(model, kind)(i).name for i in range(count)):
            if name not in ("", "world"):
                yield f"      data.{kind}({json.dumps(name)}).xpos\n"


def _safe_name(name: str, kind: str, number: int) -> str:
    """Returns a name that is safe in a docstring, or what has none."""
    return re.sub(r'["\\\n]', "_", name) or f"{kind} {number}"


if __name__ == "__main__":
    main()
