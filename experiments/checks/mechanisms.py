"""Mechanisms that each have one feature of MuJoCo, and what `matrix.py` crosses them with."""

import dataclasses
import functools
import importlib
import itertools
import re
from collections.abc import Iterator
from typing import Any, TypeAlias

import numpy as np

mujoco: Any = importlib.import_module("mujoco")  # pyright does not know what is in it

_ARM = """
<mujoco>
  <option {option}>{flags}</option>
  {top}
  <default><geom contype="0" conaffinity="0" density="800"/></default>
  <worldbody>
    <site name="wall" pos=".3 0 .2"/>
    {world}
    <body name="upper" pos="0 0 1" {upper}>
      <joint name="a" axis="0 1 0" damping=".2" {joint}/>
      <geom name="upper" type="capsule" fromto="0 0 0 .4 0 0" size=".05"/>
      <site name="middle" pos=".2 0 .05"/>
      <body name="lower" pos=".4 0 0">
        <joint name="b" {hinge}/>
        <geom name="lower" type="capsule" fromto="0 0 0 .3 0 0" size=".04"/>
        <site name="tip" pos=".3 .02 0"/>
      </body>
    </body>
  </worldbody>
  <actuator>{actuator}</actuator>
  {rest}
</mujoco>
"""
_SCENE = """
<mujoco>
  <option {option}>{flags}</option>
  {top}
  <worldbody>
    <geom name="floor" {floor}/>
    <body name="thing" pos="{pos}">
      <freejoint/>
      <geom name="thing" size=".1 .12 .14" density="500" {geom}/>
    </body>
    {world}
  </worldbody>
  {rest}
</mujoco>
"""
_MOTOR = '<motor joint="a" gear="2"/>'
_PENDULUM = """
<mujoco>
  <option {option}></option>
  <worldbody>
    <body>
      <joint name="a" axis="0 1 0" damping=".1" {joint}/>
      <geom size=".05" pos=".3 0 0" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <tendon><fixed name="t" {tendon}><joint joint="a" coef="1"/></fixed></tendon>
  <actuator>{actuator}</actuator>
</mujoco>
"""
_FIXED = (
    '<tendon><fixed name="t" {0}><joint joint="a" coef="1"/><joint joint="b" coef="-.5"/></fixed>'
    "</tendon>"
)
_SPATIAL = (
    '<tendon><spatial name="t" {0}><site site="wall"/>{1}<site site="tip"/></spatial></tendon>'
)
_ASSETS = (
    '<asset><mesh name="m" vertex=".2 0 -.1  -.1 .17 -.1  -.1 -.17 -.1  0 0 .2"/>'
    '<mesh name="big" vertex=".5 .4 -.3  .5 -.4 -.3  -.5 .4 -.3  -.5 -.4 -.3  .3 0 .2  -.3 .1 .2"/>'
    '<hfield name="h" nrow="3" ncol="3" size="2 2 .2 .1" elevation="0 .2 0 .1 .3 .2 0 .1 0"/>'
    "</asset>"
)


def _arm(**parts: str) -> str:
    """Returns two links that swing freely, moved at their first joint, with parts added."""
    empty = dict.fromkeys(("option", "flags", "top", "world", "upper", "joint", "rest"), "")
    return _ARM.format_map({**empty, "hinge": 'axis="0 1 0"', "actuator": _MOTOR, **parts})


def _actuated(actuator: str, rest: str = "", **parts: str) -> str:
    return _arm(actuator=actuator, rest=rest, **parts)


def _scene(geom: str, **parts: str) -> str:
    """Returns a free body just in contact with the floor, with parts added."""
    empty = dict.fromkeys(("option", "flags", "top", "world", "rest"), "")
    plane = 'type="plane" size="5 5 .1"'
    return _SCENE.format_map({**empty, "floor": plane, "pos": "0 0 .099", "geom": geom, **parts})


def _wrapped(pin: str, side: str = "") -> str:
    return _arm(
        world=f'<geom name="pin" {pin} zaxis="0 1 0" pos=".35 0 .55"/>'
        '<site name="side" pos=".35 0 .55"/>',
        rest=_SPATIAL.format('stiffness="40" springlength=".2"', f'<geom geom="pin" {side}/>'),
    )


def _equal(equality: str, tendon: str = "", **parts: str) -> str:
    return _arm(rest=f"{tendon}<equality>{equality}</equality>", **parts)


def _sensors(*sensors: str) -> str:
    return _arm(rest=f"<sensor>{''.join(f'<{sensor}/>' for sensor in sensors)}</sensor>")


#: What moves beside the mechanisms of a program.
MOTOR = _arm()
#: Name -> MJCF.
MODELS = {
    # Actuators
    "muscle": _actuated(
        '<muscle tendon="t" ctrlrange="0 1" lengthrange=".2 1.2" force="30"/>',
        _SPATIAL.format("", ""),
    ),
    "filter": _actuated('<general joint="a" dyntype="filter" dynprm=".1" gainprm="5"/>'),
    "filter, RK4": _actuated(
        '<general joint="a" dyntype="filter" dynprm=".1" gainprm="5"/>', option='integrator="RK4"'
    ),
    "actearly": _actuated(
        '<general joint="a" dyntype="filter" dynprm=".1" gainprm="5" actearly="true"/>'
    ),
    "two actuators": _actuated('<motor joint="a"/><intvelocity joint="b" kp="5" actrange="-2 2"/>'),
    "jointinparent": _actuated('<motor jointinparent="b"/>', hinge='type="ball"'),
    "motor of a ball": _actuated('<motor joint="b" gear="1 .5 .2"/>', hinge='type="ball"'),
    "site transmission": _actuated('<motor site="tip" gear="1 0 2 0 .1 0"/>'),
    "site with refsite": _actuated(
        '<position site="tip" refsite="wall" gear="1 0 1 0 0 0" kp="30"/>'
    ),
    "armature of an actuator": _actuated('<motor joint="a" armature=".05"/>'),
    "damping of an actuator": _actuated('<motor joint="a" damping=".3"/>'),
    "adhesion": _actuated('<adhesion body="lower" ctrlrange="0 1" gain="2"/>'),
    "slider-crank": _actuated(
        '<general cranksite="tip" slidersite="wall" cranklength=".5" gainprm="3"/>'
    ),
    "delay": _actuated('<motor joint="a" delay=".01" nsample="8"/>'),
    "plugin": _actuated(
        '<plugin joint="a" plugin="mujoco.pid"><config key="kp" value="4"/></plugin>',
        top='<extension><plugin plugin="mujoco.pid"/></extension>',
    ),
    # Joints
    "ball joint": _arm(hinge='type="ball" damping=".05"'),
    "slide joint": _arm(hinge='type="slide" axis="1 0 0" stiffness="50" damping="1"'),
    "joint limit": _arm(joint='range="-6 6"'),
    "joint limit, margin": _arm(joint='range="-6 6" margin=".05"'),
    "both joint limits at once": _arm(joint='range="-1 1" margin=".1"'),
    "limit off, one row": _scene(
        'type="sphere" condim="1" priority="1"',
        flags='<flag limit="disable"/>',
        world='<body pos="3 0 0"><joint range="-6 6"/><geom size=".1" contype="0"/></body>',
    ),
    "ball limit": _arm(hinge='type="ball" range="0 20"'),
    "armature": _arm(joint='armature=".1"'),
    "joint spring": _arm(joint='stiffness="5" springref="20"'),
    "polynomial spring": _arm(joint='stiffness="5 1 .5"'),
    "polynomial damping": _arm(hinge='axis="0 1 0" damping=".5 .3 .2"'),
    "springyield": _arm(joint='stiffness="5" springyield=".1"'),
    "friction loss": _arm(joint='frictionloss=".3"'),
    "gravity compensation": _arm(upper='gravcomp="1"'),
    "gravity compensation by actuators": _arm(
        upper='gravcomp="1"', joint='actuatorgravcomp="true" actuatorfrcrange="-3 3"'
    ),
    # Tendons
    "fixed tendon": _arm(rest=_FIXED.format('stiffness="4" damping=".2"')),
    "spatial tendon": _arm(rest=_SPATIAL.format('stiffness="40" springlength=".2"', "")),
    "polynomial spring of a tendon": _arm(rest=_FIXED.format('stiffness="4 2 1"')),
    "tendon limit": _arm(rest=_FIXED.format('range="-.1 .1"')),
    "tendon friction": _arm(rest=_FIXED.format('frictionloss=".3"')),
    "tendon armature": _arm(rest=_SPATIAL.format('armature=".2"', "")),
    "tendon over a sphere": _wrapped('type="sphere" size=".1"'),
    "tendon over a cylinder": _wrapped('type="cylinder" size=".1 .2"'),
    "tendon through a cylinder": _wrapped('type="cylinder" size=".1 .2"', 'sidesite="side"'),
    "pulley": _arm(
        rest=_SPATIAL.format(
            'stiffness="40" springlength=".2"',
            '<site site="middle"/><pulley divisor="2"/><site site="middle"/>',
        )
    ),
    # Equalities
    "connect": _equal('<connect body1="lower" body2="world" anchor=".3 0 0"/>'),
    "weld": _equal('<weld body1="lower" body2="world"/>'),
    "joint equality": _equal('<joint joint1="b" joint2="a" polycoef=".1 .5 .2 0 0"/>'),
    "tendon equality": _equal('<tendon tendon1="t" polycoef=".1 0 0 0 0"/>', _FIXED.format("")),
    "inactive equality": _equal('<weld body1="lower" body2="world" active="false"/>'),
    # Sensors
    "sensors of positions": _sensors(
        'jointpos joint="a"',
        'actuatorpos actuator="act"',
        'framepos objtype="site" objname="tip"',
        'framequat objtype="body" objname="lower"',
        'subtreecom body="upper"',
        "clock",
    ).replace("<motor ", '<motor name="act" '),
    "sensors of velocities": _sensors(
        'jointvel joint="a"',
        'gyro site="tip"',
        'velocimeter site="tip"',
        'framelinvel objtype="site" objname="tip"',
        'subtreeangmom body="upper"',
    ),
    "sensors of accelerations": _sensors(
        'accelerometer site="tip"',
        'force site="tip"',
        'torque site="tip"',
        'frameangacc objtype="site" objname="tip"',
    ),
    "rangefinder": _sensors('rangefinder site="tip"'),
    # Integrators, solvers, cones, flags
    "implicit": _arm(option='integrator="implicit"'),
    "discrete": _arm(option='integrator="discrete"'),
    "RK4": _arm(option='integrator="RK4"', hinge='type="ball"'),
    "CG": _scene('type="sphere"', option='solver="CG"'),
    "PGS": _scene('type="sphere"', option='solver="PGS"'),
    "noslip": _scene('type="sphere"', option='noslip_iterations="5"'),
    "energy": _arm(flags='<flag energy="enable"/>'),
    "sleep": _scene('type="sphere"', flags='<flag sleep="enable"/>'),
    "disabled actuators": _actuated(
        '<motor joint="a" group="2"/>', option='actuatorgroupdisable="2"'
    ),
    "wind": _arm(option='density="10" viscosity=".5" wind="3 0 1"'),
    "fluid": _arm(option='density="100" viscosity="1"'),
    "ellipsoid fluid": _arm(option='density="100" viscosity="1"').replace(
        'name="lower" type', 'fluidshape="ellipsoid" name="lower" type'
    ),
    # Contacts
    "condim 1": _scene('type="sphere" condim="1"', floor='type="plane" size="5 5 .1" condim="1"'),
    "condim 3": _scene('type="sphere"'),
    "condim 4": _scene('type="sphere" condim="4"'),
    "condim 6": _scene('type="sphere" condim="6" friction="1 .02 .01"'),
    "contact pair": _scene(
        'type="sphere" contype="0"',
        rest='<contact><pair geom1="thing" geom2="floor" condim="3" friction=".3 .3 .01 .01 .01"/>'
        "</contact>",
    ),
    "margin": _scene('type="sphere" margin=".05" gap=".02"'),
    "solref and solimp": _scene('type="sphere" solref="-300 -20" solimp=".5 .9 .1 .4 3"'),
    "adhesive geom": _scene('type="sphere" adhesion="5"'),
    "moving surface": _scene(
        'type="sphere"', floor='type="plane" size="5 5 .1" surfacevel="1 0 0"'
    ),
    "flex": _scene(
        'type="sphere"',
        world='<flexcomp name="f" type="grid" count="3 3 1" spacing=".1 .1 .1" pos="0 0 2" '
        'radius=".01"><edge equality="true"/></flexcomp>',
    ),
}


# What follows is crossed with one another by ``matrix.py``.

#: Integrators that MJX has.
INTEGRATORS = ("Euler", "RK4", "implicitfast")
#: Actuators of a joint or a tendon (``on``).
ACTUATORS = {
    "motor": '<motor {on} gear="3"/>',
    "position": '<position {on} kp="20" kv="2"/>',
    "position, timeconst": '<position {on} kp="20" kv="2" timeconst=".05"/>',
    "velocity": '<velocity {on} kv="3"/>',
    "position and velocity": '<position {on} kp="20"/><velocity {on} kv="2"/>',
    "intvelocity": '<intvelocity {on} kp="20" kv="1" actrange="-9 9"/>',
    "damper": '<damper {on} kv="3" ctrlrange="0 9"/>',
    "affine": '<general {on} gaintype="affine" gainprm="3 .5 -.2" biastype="affine" '
    'biasprm="0 -2 -.3"/>',
    "cylinder": '<cylinder {on} timeconst=".1" area="5" bias="0 -2 -.3"/>',
    "muscle": '<muscle {on} ctrlrange="0 1" lengthrange="-1 1" force="9"/>',
    "integrator": '<general {on} dyntype="integrator" gainprm="5"/>',
    "filter": '<general {on} dyntype="filter" dynprm=".1" gainprm="5"/>',
    "filterexact": '<general {on} dyntype="filterexact" dynprm=".1" gainprm="5"/>',
    "affine filter": '<general {on} dyntype="filterexact" dynprm=".1" gaintype="affine" '
    'gainprm="3 .5 -.2" biastype="affine" biasprm="0 -2 -.3"/>',
}
#: Actuators with an activation.
STATEFUL = ("intvelocity", "integrator", "filter", "filterexact", "affine filter")
#: What bounds an actuator: whose attribute, and its value.
CLAMPS = {
    "none": ("actuator", "none", ""),
    "forcerange": ("actuator", "forcerange", "-.4 .3"),
    "ctrlrange": ("actuator", "ctrlrange", "0 .2"),
    "actrange": ("actuator", "actrange", "-.1 .2"),
    "its joint's range": ("joint", "actuatorfrcrange", "-.4 .3"),
    "its tendon's range": ("tendon", "actuatorfrcrange", "-.4 .3"),
}
#: Where an actuator starts: the joint's velocity, the activation, the control.
ACTUATED = {
    "free": (0.02, 0.02, 0.02),
    "high": (0.1, 0.5, 2),
    "low": (-0.1, -0.5, -2),
    "fast": (6, 0, 0.1),
    "fast back": (-6, 0, 0.1),
}
#: What lies below (the flatter geom of a pair), at the origin.
BELOW = {
    "plane": 'type="plane" size="5 5 .1"',
    "hfield": 'type="hfield" hfield="h"',
    "box": 'type="box" size=".4 .5 .2"',
    "mesh": 'type="mesh" mesh="big"',
    "cylinder": 'type="cylinder" size=".4 .2"',
    "ellipsoid": 'type="ellipsoid" size=".5 .4 .3"',
    "capsule": 'type="capsule" size=".2 .4"',
    "sphere": 'type="sphere" size=".4"',
}
ABOVE = ("box", "mesh", "cylinder", "ellipsoid", "capsule", "sphere")
#: How a geom lies on another: turned by a quaternion, from which x, moved up (or aside), how close.
POSES = {
    "upright": ((1, 0, 0, 0), 0.03, 2, -0.002),
    "flat": ((1, 1, 0, 0), 0.03, 2, -0.002),
    "nearly flat": ((1, 0.03, 0.04, 0), 0.03, 2, -0.015),
    "on edge": ((0.9, 0.3, 0.2, 0.1), 0.03, 2, -0.002),
    "over the edge": ((0.9, 0.1, 0.4, 0.1), 0.41, 2, -0.002),
    "deep": ((0.9, 0.1, 0.3, 0.2), 0.03, 2, -0.03),
    "side by side": ((1, 0, 0, 0), 0.03, 0, -0.002),
}
MARGIN = {"within the margin": ((0.9, 0.2, 0.1, 0.2), 0.03, 2, 0.005)}
#: Flags that disable something; those that have nothing to do with one another, together.
FLAGS = (
    *("constraint", "equality limit", "frictionloss contact", "spring", "damper", "nativeccd"),
    *("multiccd", "gravity eulerdamp clampctrl refsafe warmstart"),
    "actuation sensor filterparent midphase autoreset island",
)
#: What they are crossed with: each kind of constraint row, and what else they disable.
ROWS = (
    *("friction loss", "tendon friction", "joint limit", "ball limit", "tendon limit", "connect"),
    *("weld", "joint equality", "tendon equality", "condim 1", "condim 3", "condim 4", "condim 6"),
    *("joint spring", "fixed tendon", "gravity compensation", "muscle", "sensors of accelerations"),
)
#: Cones, and what touches.
CONES = tuple(
    f'cone="{cone}" impratio="{impratio}"'
    for cone in ("pyramidal", "elliptic")
    for impratio in (1, 5)
)
TOUCHING = {
    "sphere": 'type="sphere"',
    "capsule": 'type="capsule" euler="0 80 0"',
    "ellipsoid": 'type="ellipsoid" euler="0 10 0"',
}
#: How it moves on a plane: up (m), velocities (m/s, rad/s).
MOVING = {
    "resting": (-0.001, (0, 0, 0, 0, 0, 0)),
    "sliding": (-0.001, (1, 0.3, 0, 0, 0, 0)),
    "spinning": (-0.001, (0, 0, 0, 0.3, 0, 5)),
    "rolling": (-0.001, (0.5, 0, 0, 0, 5, 1)),
    "deep": (-0.02, (0.2, 0, -0.5, 0, 1, 0)),
    "leaving": (-0.001, (0.1, 0, 0.5, 0, 0, 0)),
}


#: Positions, velocities, activations, and controls.
Start: TypeAlias = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


@dataclasses.dataclass(frozen=True)
class Mechanism:
    """What moves, with its options, and where it starts."""

    axis: str
    case: str
    name: str
    xml: str
    starts: dict[str, Start] = dataclasses.field(compare=False)
    steps: int = 10

    @property
    def option(self) -> str:
        """The options, as MJCF."""
        return re.findall("<option.*?</option>", self.xml, re.DOTALL)[0]

    @property
    def title(self) -> tuple[str, str, str]:
        """Axis, option and name."""
        return self.axis, self.case, self.name


def _pushed(model: Any) -> dict[str, Start]:
    """Returns starts at a model's own pose, beside it, and far from it on both sides."""
    speed, starts = 0.3 * np.cos(1 + np.arange(model.nv)), {}
    for name, size in {"at its pose": 0, "near": 0.1, "far": 1.5, "far back": -1.5}.items():
        qpos = model.qpos0.copy()
        mujoco.mj_integratePos(model, qpos, speed, size * (0.1 if model.njnt == 1 else 1))
        starts[name] = qpos, speed, np.zeros(model.na), np.cos(np.arange(model.nu))
    return starts


def _actuated_starts(model: Any) -> dict[str, Start]:
    """Returns starts of a pendulum."""
    return {
        name: (np.full(1, 0.02), np.full(1, qvel), np.full(model.na, act), np.full(model.nu, ctrl))
        for name, (qvel, act, ctrl) in ACTUATED.items()
    }


def _moving(model: Any) -> dict[str, Start]:
    """Returns starts of a free body on a plane."""
    return {
        name: (model.qpos0 + up * np.eye(7)[2], np.array(qvel, float), np.zeros(0), np.zeros(0))
        for name, (up, qvel) in MOVING.items()
    }


def _posed(model: Any, poses: dict[str, Any]) -> dict[str, Start]:
    """Returns starts in which the free body is so far from the other geom, found by C MuJoCo."""
    data, starts = mujoco.MjData(model), {}
    endless = model.geom_type[0] <= int(mujoco.mjtGeom.mjGEOM_HFIELD)
    for name, (quaternion, x, axis, gap) in poses.items():
        along = np.eye(7)[2 if endless else axis]
        at = np.array([x, 0.02, 0.03, *np.array(quaternion) / np.linalg.norm(quaternion)])
        low, high = 0.0, 3.0
        while high - low > 1e-9:
            middle = (low + high) / 2
            data.qpos[:] = at + middle * along
            mujoco.mj_fwdPosition(model, data)
            low, high = (middle, high) if (data.contact.dist < 0).any() else (low, middle)
        starts[name] = at + (low + gap) * along, 0.3 * np.cos(1 + np.arange(6)), at[:0], at[:0]
    return starts


def _clamped(actuator: str, clamp: str, integrator: str) -> str:
    """Returns a pendulum with an actuator that is bounded so."""
    whose, attribute, bounds = CLAMPS[clamp]
    bounded = dict.fromkeys(("actuator", "joint", "tendon"), "") | {
        whose: f'{attribute}="{bounds}"'
    }
    element = ACTUATORS[actuator].format(on='tendon="t"' if whose == "tendon" else 'joint="a"')
    if bounds and whose == "actuator":
        element = re.sub(f' {attribute}="[^"]*"', "", element)
        element = element.replace("/>", f" {bounded['actuator']}/>")
    return _PENDULUM.format_map(
        bounded | {"actuator": element, "option": f'integrator="{integrator}"'}
    )


def mechanisms() -> Iterator[Mechanism]:
    """Yields all mechanisms."""

    def made(axis: str, case: str, name: str, xml: str, starts: Any, steps: int = 10) -> Mechanism:
        model = mujoco.MjModel.from_xml_string(xml)
        return Mechanism(axis, case, name, xml, starts(model), steps)

    for name, xml in MODELS.items():
        yield made("features", "", name, xml, _pushed, 40)
    for case, actuator, clamp in itertools.product(INTEGRATORS, ACTUATORS, CLAMPS):
        if clamp != "actrange" or actuator in STATEFUL:
            xml = _clamped(actuator, clamp, case)
            yield made("actuators", case, f"{actuator}, {clamp}", xml, _actuated_starts)
    for (i, below), geom in itertools.product(enumerate(BELOW), ABOVE):
        if geom in list(BELOW)[i:]:
            parts = {"floor": BELOW[below], "top": _ASSETS, "pos": "0 0 0"}
            for case, margin, poses in (("", "", POSES), ("margin", 'margin=".02"', MARGIN)):
                mesh = 'mesh="m"' if geom == "mesh" else ""
                xml = _scene(f'type="{geom}" {mesh} {margin}', **parts)
                starts = functools.partial(_posed, poses=poses)
                yield made("geoms", case, f"{geom} on {below}", xml, starts)
    for flag, name in itertools.product(FLAGS, ROWS):
        disabled = "".join(f' {each}="disable"' for each in flag.split())
        xml = MODELS[name].replace("<option >", f"<option ><flag{disabled}/>")
        yield made("flags", flag, name, xml, _pushed)
    for option, condim, geom in itertools.product(CONES, (1, 3, 4, 6), TOUCHING):
        friction = f'condim="{condim}" friction="1 .02 .01" priority="1"'
        xml = _scene(f"{TOUCHING[geom]} {friction}", option=option)
        yield made("cones", option, f"{geom}, condim {condim}", xml, _moving)
