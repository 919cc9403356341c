"""The text of a task's class, written from a MuJoCo model."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mjx_reinforce.templates import facts

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
    # The seven numbers of a free joint are its position and its orientation.
    is_free = facts.is_free(model)
    files = ["task.txt", "walk.txt" if is_free else "hold.txt"]
    template = "".join(Path(__file__).with_name(file).read_text("utf-8") for file in files)
    # Five seconds are an episode.
    num_steps = round(5 / (frame_skip * timestep)) or 1
    placeholders = _start_and_home(model, is_free)
    array = "ctrl" if placeholders["home"] else "action"
    if is_free:
        placeholders["body"] = int(model.jnt_bodyid[0])
        placeholders["up"] = facts.direction_up(model)
    return template.format(
        title=facts.class_name(module),
        module=module,
        xml=facts.quoted(xml),
        frame_skip=frame_skip,
        timestep=timestep,
        steps=num_steps,
        nv=model.nv,
        pose="self.mj_model.key_qpos[0]" if model.nkey else "self.mj_model.qpos0",
        observed="".join(f"                data.{x},\n" for x in _observation(model, is_free)),
        about="\n".join(facts.action_lines(model, array)),
        **placeholders,
    )


def _observation(model: "MjModel", is_free: bool) -> Iterator[str]:
    """Yields the fields of mjData that the policy sees, of a robot with a free joint or without."""
    if is_free:
        # Not where it is on the ground, which should make no difference to a policy.
        yield "qpos[2:7]"
    joints = [model.joint(i).name for i in range(int(is_free), model.njnt)]
    if all(joints):
        yield from (f"joint({facts.quoted(name)}).qpos" for name in joints)
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
    has_servos = bool(facts.is_servo(model).all())
    ctrl = ""
    if has_servos and not has_controls:
        ctrl = ', "ctrl": self.home'
    name = model.key(0).name
    key = facts.quoted(name) if name else "0"
    placeholders["start"] = _KEY_FRAME.format(key=key, ctrl=ctrl)
    if has_controls or has_servos:
        home = _HOME_OF_CONTROLS if has_controls else _HOME_OF_SERVOS
        scale = _SCALE_ON_LEGS if is_free and has_servos else _SCALE
        placeholders["home"] = _HOME.format(home=home, scale=scale, nu=model.nu)
        placeholders["imports"] = "from mjx_reinforce import Box\n"
        placeholders["effort"] = "action"
    return placeholders
