"""Mechanisms that each have one feature of MuJoCo, and what `matrix.py` crosses them with."""

import dataclasses
import functools
import importlib
import itertools
import re
import tomllib
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

mujoco: Any = importlib.import_module("mujoco")  # pyright does not know what is in it

_TABLES: dict[str, Any] = tomllib.loads(Path(__file__).with_suffix(".toml").read_text("utf-8"))
_LISTS = _TABLES["lists"]
_FAILURES = tomllib.loads(Path(__file__).with_name("failures.toml").read_text("utf-8"))["failures"]


def _mjcf(template: str, **parts: str) -> str:
    """Returns the MJCF of a template with parts in it, the template's own where none is given."""
    said = _TABLES["defaults"].get(template, {}) | parts
    return _TABLES["templates"][template].format_map(defaultdict(str, said))


#: A mesh and a height field.
ASSETS = _LISTS["assets"]
#: What moves beside the mechanisms of a program.
MOTOR = _mjcf("arm")
#: Whose cells are a reading each, in the axis ``forces``.
FORCES = tuple(_LISTS["forces"])
#: Name -> MJCF.
MODELS = {
    name: _mjcf(template, **parts)
    for template, groups in _TABLES["features"].items()
    for group in groups.values()
    for name, parts in group.items()
}

#: The joints that a sensor of actuator forces may be at.
_SCALAR = (mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE)

#: Positions, velocities, activations, and controls.
Start: TypeAlias = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


@dataclasses.dataclass(frozen=True)
class Mechanism:
    """What moves, with its options, and where it starts."""

    axis: str
    case: str
    name: str
    xml: str
    start: Callable[[Any], dict[str, Start]] = dataclasses.field(compare=False)
    steps: int = 10

    @functools.cached_property
    def starts(self) -> dict[str, Start]:
        """Starts by their names."""
        return self.start(mujoco.MjModel.from_xml_string(self.xml))

    @property
    def option(self) -> str:
        """The options, as MJCF."""
        return re.findall("<option.*?</option>", self.xml, re.DOTALL)[0]

    @functools.cached_property
    def readings(self) -> np.ndarray:
        """What each number of sensordata is a reading of, by MuJoCo's name of the sensor."""
        model = mujoco.MjModel.from_xml_string(self.xml)
        kinds = [mujoco.mjtSensor(kind).name.lower()[7:] for kind in model.sensor_type]
        return np.repeat(np.array(kinds, str), model.sensor_dim)

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


def _close(model: Any) -> dict[str, Start]:
    """Returns the starts of ``_pushed`` that are not deep in the floor."""
    starts = _pushed(model)
    return {name: starts["near" if "near" in name else "at its pose"] for name in starts}


def _actuated(model: Any) -> dict[str, Start]:
    """Returns starts of a pendulum."""
    return {
        name: (np.full(1, 0.02), np.full(1, qvel), np.full(model.na, act), np.full(model.nu, ctrl))
        for name, (qvel, act, ctrl) in _TABLES["actuated"].items()
    }


def _moving(model: Any) -> dict[str, Start]:
    """Returns starts of a free body on a plane."""
    return {
        name: (model.qpos0 + up * np.eye(7)[2], np.array(qvel, float), np.zeros(0), np.zeros(0))
        for name, (up, qvel) in _TABLES["moving"].items()
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
    whose, attribute, bounds = _TABLES["clamps"][clamp]
    bounded = {whose: f'{attribute}="{bounds}"'}
    on = 'tendon="t"' if whose == "tendon" else 'joint="a"'
    element = _TABLES["actuators"][actuator].format(on=on)
    if bounds and whose == "actuator":
        element = re.sub(f' {attribute}="[^"]*"', "", element)
        element = element.replace("/>", f" {bounded['actuator']}/>")
    option = f'integrator="{integrator}"'
    return _mjcf("pendulum", **bounded | {"actuator": element, "option": option})


def _sensed(xml: str) -> str:
    """Returns a mechanism with every kind of sensor at everything in it that has a name."""
    spec = mujoco.MjSpec.from_string(xml)
    moving = [body for body in spec.bodies if body.name not in ("", "world")]
    joints = [joint for joint in spec.joints if joint.type in _SCALAR]
    parts = {
        "site": [site for site in spec.sites if site.parent in moving],
        "geom": [geom for geom in spec.geoms if geom.name],
        "body": moving,
        "xbody": moving,
        "joint": joints,
        "camera": spec.cameras,
        "tendon": spec.tendons,
        "actuator": spec.actuators,
    }
    sensors = ""
    for place, kinds in _TABLES["sensors"].items():
        for (kind, key), part in itertools.product(kinds.items(), parts[place]):
            of = f'objtype="{place}" objname' if key == "obj" else key
            sensors += f'<{kind} {of}="{part.name}"/>'
    return xml.replace("</sensor>", f"{sensors}</sensor>")


def _disabled(flags: str) -> str:
    """Returns MJCF that disables flags."""
    attributes = "".join(f' {flag}="disable"' for flag in flags.split())
    return f"<flag{attributes}/>"


def _forces() -> Iterator[Mechanism]:
    """Yields trees that forces come through, each with every sensor of them."""
    features = {k: v for group in _TABLES["forces"].values() for k, v in group.items()}
    options = {case: {"option": f'integrator="{case}"'} for case in _LISTS["integrators"]}
    options |= {case: {"flags": _disabled(case)} for case in _LISTS["flags_of_forces"]}
    for (case, option), (name, parts) in itertools.product(options.items(), features.items()):
        said = option | parts
        said["option"] = f"{option.get('option', '')} {parts.get('option', '')}".strip()
        yield Mechanism("forces", case, name, _sensed(_mjcf("tree", **said)), _pushed, 2)


def mechanisms() -> Iterator[Mechanism]:
    """Yields all mechanisms."""
    for name, xml in MODELS.items():
        yield Mechanism("features", "", name, xml, _pushed, 40)
    crossed = itertools.product(_LISTS["integrators"], _TABLES["actuators"], _TABLES["clamps"])
    for case, actuator, clamp in crossed:
        if clamp != "actrange" or actuator in _LISTS["stateful"]:
            xml = _clamped(actuator, clamp, case)
            yield Mechanism("actuators", case, f"{actuator}, {clamp}", xml, _actuated)
    for (i, below), geom in itertools.product(enumerate(_TABLES["below"]), _LISTS["above"]):
        if geom in list(_TABLES["below"])[i:]:
            parts = {"floor": _TABLES["below"][below], "top": _LISTS["assets"], "pos": "0 0 0"}
            for case, margin, poses in (("", "", "poses"), ("margin", 'margin=".02"', "margin")):
                mesh = 'mesh="m"' if geom == "mesh" else ""
                xml = _mjcf("scene", geom=f'type="{geom}" {mesh} {margin}', **parts)
                starts = functools.partial(_posed, poses=_TABLES[poses])
                yield Mechanism("geoms", case, f"{geom} on {below}", xml, starts)
    for flag, name in itertools.product(_LISTS["flags"], _LISTS["rows"]):
        xml = MODELS[name].replace("<option >", f"<option >{_disabled(flag)}")
        yield Mechanism("flags", flag, name, xml, _pushed)
    yield from _forces()
    for option, condim, geom in itertools.product(
        _LISTS["cones"], (1, 3, 4, 6), _TABLES["touching"]
    ):
        friction = f'condim="{condim}" friction="1 .02 .01" priority="1"'
        xml = _mjcf("scene", geom=f"{_TABLES['touching'][geom]} {friction}", option=option)
        yield Mechanism("cones", option, f"{geom}, condim {condim}", xml, _moving)
    for limits in _LISTS["iterations"]:
        searched = {name: MODELS[name] for name in _LISTS["searched"]}
        searched |= {name: _mjcf("walker", **parts) for name, parts in _TABLES["walkers"].items()}
        for name, plain in searched.items():
            xml = plain.replace("<option ", f"<option {limits} ")
            starts = _close if name in _TABLES["walkers"] else _pushed
            yield Mechanism("iterations", limits, name, xml, starts, 20)


def failures() -> list[Mechanism]:
    """Returns all that ever differed from C, as ``failures.toml`` lists them."""
    known = {each.title: each for each in mechanisms()}
    return [known[row["axis"], row["option"], name] for row in _FAILURES for name in row["names"]]
