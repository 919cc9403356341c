"""``python -m mjx_reinforce.new arm.xml`` writes the class of a task from a MuJoCo model."""

import dataclasses
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from mjx_reinforce.files import check_module, check_output, write_bytes
from mjx_reinforce.settings.flags import run_command

if TYPE_CHECKING:
    from mjx_reinforce.engine.base import MjModel


#: What a class says of a model whose first key frame has controls.
_HOME = """\
        # An untrained policy acts in the middle of this space: on what holds the key frame.
        # Actions beyond it are allowed; MuJoCo clamps them to ctrlrange.
        self.home = self.mj_model.key_ctrl[0]
        reach = np.where(limited, self.unit / 2, np.inf)
        self.action_space = Box(self.home - reach, self.home + reach)
"""


@dataclasses.dataclass(frozen=True)
class NewSettings:
    """Write the class of an environment for a MuJoCo model, with a reward for you to change."""

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
        raise ValueError(f"{xml} is not a model; give an MJCF file that ends in .xml")
    check_module(output, "my_robot.py")
    if output.parent.resolve() != xml.parent.resolve():
        raise ValueError(f"{output} must be in the folder of {xml}, where it looks for the model")
    check_output(output, settings.overwrite, ".py")
    from mjx_reinforce.envs import models
    from mjx_reinforce.envs.instability import instability

    path = str(xml)
    # A file's name alone would mean one of the package's own models.
    if xml.parent == Path():
        path = str(Path.cwd() / xml)
    model = models.load_model(path)
    models.to_mjx(model, path)
    write_bytes(output, class_source(model, xml.name, output.stem).encode())
    module = output.stem
    train = f"python -m mjx_reinforce.train --env {module}:{_title(module)} --output {module}_run"
    if (warning := instability(model)) is not None:
        print(warning)
    print(f"{output}: write its reward, then, in its folder: {train}")


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
    joints = [model.joint(i).name for i in range(int(is_free), model.njnt)]
    observation = []
    if is_free:
        # Not where it is on the ground, which should make no difference to a policy.
        observation.append("qpos[2:7]")
    if all(joints):
        observation += [f"joint({json.dumps(name)}).qpos" for name in joints]
    else:
        observation.append("qpos[7:]" if is_free else "qpos")
    observation.append("qvel")
    if model.nsensor > 0:
        observation.append("sensordata")
    has_home = bool(model.nkey and model.key_ctrl[0].any())
    files = ["new_task.txt", "new_walk.txt" if is_free else "new_hold.txt"]
    template = "".join(Path(__file__).with_name(file).read_text("utf-8") for file in files)
    # Five seconds are an episode.
    num_steps = round(5 / (frame_skip * timestep)) or 1
    # What a robot without a home or without a free joint needs in these places.
    placeholders: dict[str, Any] = {
        "home": "",
        "imports": "",
        "effort": "action",
        "body": 0,
        "up": "",
    }
    if has_home:
        placeholders["home"] = _HOME
        placeholders["imports"] = "from mjx_reinforce import Box\n"
        placeholders["effort"] = "(action - self.home)"
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
        observed="".join(f"                data.{entry},\n" for entry in observation),
        about="\n".join(_about(model)),
        **placeholders,
    )


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


def _about(model: "MjModel") -> Iterator[str]:
    """Yields the lines of the class's docstring: what its actions move."""
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
        yield f"    action[{i}]: actuator {name}{limits}"


if __name__ == "__main__":
    main()
