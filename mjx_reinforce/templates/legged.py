"""The class of a robot on legs, which walks as it is commanded."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from mjx_reinforce.templates import facts

if TYPE_CHECKING:
    from mjx_reinforce.engine.base import MjModel

#: Actions (s), episodes, commands, and pushes (s) of the class.
_PERIOD = 0.02
_EPISODE = 10.0
_COMMAND = 5.0
_PUSH = 4.0
#: A foot makes a step in so many seconds, and is lifted by up to so much (m).
_GAIT = 0.5
_HIGHEST_LIFT = 0.08
#: Below this share of its height, the robot has fallen.
_LOWEST = 0.6
#: Robots of this height (m) and higher walk at full speed, lower ones as the root of the height.
_TALL = 0.3


class _Pace(NamedTuple):
    """How a robot is to walk: the most of each number of a command, of a push, and of a lift.

    forward, sideways, push: (m/s)
    turn: (rad/s)
    lift: of the robot's height
    weights: of the reward's first four terms: upright, and the errors of the three numbers
    """

    forward: float
    sideways: float
    turn: float
    push: float
    lift: float
    weights: tuple[float, float, float, float]


_ON_FOUR = _Pace(
    forward=1.0, sideways=0.3, turn=0.5, push=0.5, lift=0.2, weights=(2.0, -1.0, -1.0, -1.5)
)
#: Slow commands err by little: with the weights of four feet, a robot stands.
_ON_TWO = _Pace(
    forward=0.4, sideways=0.1, turn=0.3, push=0.2, lift=0.12, weights=(3.0, -4.0, -3.0, -2.0)
)
_HOME_OF_CONTROLS = """\
        self.home = self.mj_model.key_ctrl[0]
"""
_HOME_OF_JOINTS = """\
        joints = self.mj_model.actuator_trnid[:, 0]
        self.home = {pose}[self.mj_model.jnt_qposadr[joints]]
"""
_LIMIT = """\
        # The most that a servo does (N m).
        self.limit = {limit}
"""
_START = """\
        joints = self.mj_model.jnt_qposadr[self.mj_model.actuator_trnid[:, 0]]
        noise = jax.random.uniform(rng, ({nu},), minval=-0.1, maxval=0.1)
        qpos = jnp.asarray({pose}).at[joints].add(noise)
        return {{"qpos": qpos, {controls}}}"""
_CONTROLS = '"ctrl": jnp.asarray(self.home)'
#: Servos that lag have reached their controls.
_ACTIVATIONS = ', "act": jnp.asarray(self.home)'


def lacking(model: "MjModel") -> str | None:
    """Returns in words the first thing that a model lacks for the class of a robot on legs.

    Args:
      model: one that is ``facts.is_free``.

    Returns:
      None where it lacks nothing.
    """
    from mjx_reinforce.envs.parts import feet, gait
    from mjx_reinforce.envs.refusals import listed

    is_servo = facts.is_servo(model)
    if not is_servo.all():
        names = [model.actuator(int(i)).name or f"number {i}" for i in np.flatnonzero(~is_servo)]
        return f"<position> servos with gear 1 of hinges or slides in place of {listed(names)}"
    if len(feet(model)) < 2:
        return "two feet that come nearest to a floor, below its body, in the first key frame"
    if model.na not in (0, model.nu):
        return "servos that all lag, or none"
    if not _body(model):
        return "a name of the body of its free joint"
    up = facts.direction_up(model)
    if not np.allclose(up, [0, 0, 1], atol=0.1):
        return f"a body whose z axis is up in the first pose, where up is {up}"
    try:
        gait(model, _lift(model), num_steps=1)
    except ValueError as error:
        return f"a gait: {error}"
    return None


def class_source(model: "MjModel", xml: str, module: str) -> str:
    """Returns the text of the class, as ``model_class.class_source``.

    Args:
      model: one that is ``facts.is_free`` and lacks nothing.
      xml: the name of its file, in the folder of the class.
      module: the name of the class's file, without its ending.
    """
    timestep = float(model.opt.timestep)
    frame_skip = max(1, round(_PERIOD / timestep))
    period = frame_skip * timestep
    pose = "self.mj_model.key_qpos[0]" if model.nkey else "self.mj_model.qpos0"
    height = _height(model)
    pace = _pace(model)
    home = _HOME_OF_JOINTS.format(pose=pose)
    if model.nkey and model.key_ctrl[0].any():
        home = _HOME_OF_CONTROLS
    controls = _CONTROLS + _ACTIVATIONS * (model.na > 0)
    limit = _limit(model)
    if limit is not None:
        home += _LIMIT.format(limit=limit)
    return (
        Path(__file__)
        .with_name("legged.txt")
        .read_text("utf-8")
        .format(
            title=facts.class_name(module),
            module=module,
            xml=facts.quoted(xml),
            body=facts.quoted(_body(model)),
            joints="\n".join(f"    {facts.quoted(name)}," for name in _joints(model)),
            frame_skip=frame_skip,
            timestep=timestep,
            period=period,
            steps=round(_EPISODE / period),
            command_period=round(_COMMAND / period),
            push_period=round(_PUSH / period),
            gait_period=round(_GAIT / period),
            forward=pace.forward,
            sideways=pace.sideways,
            turn=pace.turn,
            push=pace.push,
            upright=pace.weights[0],
            forward_error=pace.weights[1],
            sideways_error=pace.weights[2],
            turn_error=pace.weights[3],
            lift=_lift(model),
            lowest=round(_floor(model) + _LOWEST * height, 3),
            nu=model.nu,
            home=home,
            start=_START.format(nu=model.nu, pose=pose, controls=controls),
            effort_weight='    "effort": -0.1,\n' if limit else "",
            effort_term=_effort(limit),
        )
    )


def _pace(model: "MjModel") -> _Pace:
    """Returns the pace of a robot of this height and number of feet."""
    from mjx_reinforce.envs.parts import feet

    pace = _ON_TWO if len(feet(model)) == 2 else _ON_FOUR
    # Animals of all sizes walk alike at equal Froude numbers, speed^2 / (gravity height).
    share = min(1.0, (_height(model) / _TALL) ** 0.5)
    return pace._replace(
        forward=round(share * pace.forward, 1), sideways=round(share * pace.sideways, 1)
    )


def _lift(model: "MjModel") -> float:
    """Returns how far the gait lifts a foot (m)."""
    return round(min(_pace(model).lift * _height(model), _HIGHEST_LIFT), 3)


def _effort(limit: str | None) -> str:
    """Returns the line of the term of the servos' forces, where they have limits."""
    if limit is None:
        return ""
    return '            "effort": parts.effort(data.actuator_force, self.limit),\n'


def _body(model: "MjModel") -> str:
    """Returns the name of the body that the free joint moves."""
    return model.body(int(model.jnt_bodyid[0])).name


def _joints(model: "MjModel") -> Iterator[str]:
    """Yields the names of the servos' joints."""
    for joint in model.actuator_trnid[:, 0]:
        yield model.joint(int(joint)).name


def _height(model: "MjModel") -> float:
    """Returns the height of the body over the floor in the first pose (m)."""
    pose: Any = model.key_qpos[0] if model.nkey else model.qpos0
    return float(pose[2]) - _floor(model)


def _floor(model: "MjModel") -> float:
    """Returns the height of the floor under the feet (m)."""
    from mjx_reinforce.envs.mending import ground

    standing: Any = ground.stance(model)
    geoms = [geom for pair in standing.pairs for geom in pair[:2]]
    planes = [geom for geom in geoms if model.geom_type[geom] == 0]
    return float(ground.first_pose(model).geom_xpos[planes, 2].min())


def _limit(model: "MjModel") -> str | None:
    """Returns what the limits of the servos' forces are, of actuators or of joints; or None."""
    joints = model.actuator_trnid[:, 0]
    if model.actuator_forcelimited.all():
        return "self.mj_model.actuator_forcerange[:, 1]"
    if model.jnt_actfrclimited[joints].all():
        return "self.mj_model.jnt_actfrcrange[self.mj_model.actuator_trnid[:, 0], 1]"
    return None
