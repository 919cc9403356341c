"""From MJCF to a model that MJX runs, or a clear error."""

import copy
import importlib.resources
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeAlias

import jax
import mujoco
import numpy as np
from mujoco import MjModel, MjSpec, mjx  # pyright: ignore[reportAttributeAccessIssue]

from mjx_reinforce.engine.checks import explain
from mjx_reinforce.engine.physics import contacts
from mjx_reinforce.engine.physics.early_stop import stops_early
from mjx_reinforce.engine.physics.mjx_internals import geom_pairs

#: MuJoCo's own names; it is a C extension without stubs.
_C: Any = mujoco
#: Everything that MuJoCo carries from a step to the next, by its names in mjData; mjdata.h lists it
#: as mjtState. Here is what an env step hands to the next.
CARRIED = ("time", "qpos", "qvel", "act", "qacc_warmstart")
#: What stays as the model has it, since no task changes it.
CONSTANT = ("qfrc_applied", "xfrc_applied", "eq_active", "mocap_pos", "mocap_quat", "userdata")
#: Fields of a model that ``MujocoEnv.randomize`` may replace in an episode.
RANDOM = (
    *("body_mass", "body_inertia", "body_ipos", "geom_friction", "dof_damping", "dof_armature"),
    *("jnt_stiffness", "actuator_gainprm", "actuator_biasprm", "actuator_gear"),
)
#: What MJX does not carry: its size in the model, what it is, and how to do without.
NOT_CARRIED = {
    "history": ("nhistory", "delays", "remove delay and interval from actuators and sensors"),
    "plugin": ("nplugin", "plugins", "remove them"),
    "plastic": ("nplastic", "plastic springs", "remove springyield"),
}
_HOLDS = (int(_C.mjtEq.mjEQ_CONNECT), int(_C.mjtEq.mjEQ_WELD))
_WITHIN_MARGIN = "give it a margin of at most half of its range"
_ON_JOINT = "give it to the joint, times the square of gear"
_ONE_NUMBER = "give one number"
_ONE_SIGN = "give two positive numbers, or two that are not"
_RISING = "give a second number that is not below it, and a width above zero"
_GO_ON = 'set <option iterations="100" ls_iterations="50"/>, or solver="Newton" cone="pyramidal"'
#: Fields of a model that say how soft its constraints are.
_SOFT = ("dof_{}", "eq_{}", "geom_{}", "jnt_{}", "pair_{}", "tendon_{}_lim", "tendon_{}_fri")
#: What else MJX ignores in silence.
_IGNORED = (
    ("actuator_armature", "the armature of an actuator", _ON_JOINT),
    ("actuator_damping", "the damping of an actuator", _ON_JOINT),
    ("actuator_dampingpoly", "the polynomial damping of an actuator", _ON_JOINT),
    ("actuator_actearly", "actearly of an actuator", 'remove actearly="true"'),
    ("jnt_stiffnesspoly", "the polynomial stiffness of a joint", _ONE_NUMBER),
    ("dof_dampingpoly", "the polynomial damping of a joint", _ONE_NUMBER),
    ("tendon_stiffnesspoly", "the polynomial stiffness of a tendon", _ONE_NUMBER),
    ("tendon_dampingpoly", "the polynomial damping of a tendon", _ONE_NUMBER),
    ("geom_adhesion", "adhesive geoms", "remove adhesion"),
    ("pair_adhesion", "adhesive contact pairs", "remove adhesion"),
    ("geom_surfacevel", "moving surfaces", "remove surfacevel"),
    ("geom_fluid", "the fluid forces on ellipsoids", "remove fluidshape"),
)
#: Part of MJX's message -> what to change in the MJCF.
_REMEDIES = {
    "SOL_PGS": 'set <option solver="Newton"/>',
    "INT_IMPLICIT": 'set <option integrator="implicitfast"/>',
    "fluid drag": 'set <option integrator="Euler"/> or remove density and viscosity',
    "collisions": "keep that pair apart with contype and conaffinity, or use spheres, capsules, "
    "boxes and planes",
    "margin/gap": "remove margin and gap from those geoms",
    "condim=1": 'set <option cone="pyramidal"/> or condim="3"',
    "sensor": "remove that sensor",
    "mjSENS_": "remove those sensors",
    "mjTRN_BODY": "replace the adhesion actuators by friction (friction, condim of the geoms), or "
    "by a <weld> equality",
    "mjTRN_SLIDERCRANK": "replace the slider-crank by the <motor> of a joint, or make its rod a "
    "body that a <connect> equality holds",
    "_USER": "replace the user-defined actuators by <motor>, <position>, <velocity> or <muscle>",
    "mjEQ_": "replace those equalities by <connect>, <weld>, <joint> or <tendon>",
    "ENBL_OVERRIDE": 'set <flag override="disable"/> and give geoms solref and solimp of their own',
    "mjENBL_": "take that <flag> out of <option>",
    "Flex": "remove the flexible body",
}
#: What MJX refuses and no step depends on: the energy, and a check of the inverse dynamics.
_ONLY_REPORTS = int(_C.mjtEnableBit.mjENBL_ENERGY | _C.mjtEnableBit.mjENBL_FWDINV)
_ELSE = "remove it; MuJoCo's documentation lists what MJX supports under 'MJX, feature parity'"
#: What MuJoCo calls a model without a name.
_NAMELESS = "MuJoCo Model"
#: The name of a file, an ``MjSpec`` or an ``MjModel``, which MuJoCo does not declare.
ModelSource: TypeAlias = Any


def load_model(xml_file: ModelSource) -> Any:
    """Compiles an MJCF file of the package's assets, or the user's own by a path.

    Args:
      xml_file: the name of an asset, or a path with a folder in it, such as "./mine.xml"; or an
        ``MjSpec`` or ``MjModel``, of which a copy is taken.

    Raises:
      ValueError: there is no such file, MuJoCo cannot compile it, or nothing in it can be moved.
    """
    if isinstance(xml_file, MjModel):
        model = copy.copy(xml_file)
    else:
        with warnings.catch_warnings():
            # HalfCheetah's total mass is given as Gymnasium gives it, which MuJoCo deprecates.
            warnings.filterwarnings("ignore", ".*'settotalmass' is deprecated")
            model = _compile_model(MjSpec.compile, spec(xml_file), xml_file)
    if not model.nu:
        raise ValueError(f"{_name(xml_file)} has no actuators; add an <actuator> element")
    model.opt.enableflags &= ~_ONLY_REPORTS
    return model


def _name(xml_file: ModelSource) -> str:
    """Returns what a message calls a model: its file, the name that it has itself, or neither."""
    if isinstance(xml_file, MjSpec):
        xml_file = xml_file.modelname
    elif isinstance(xml_file, MjModel):
        xml_file = xml_file.names.split(b"\0")[0].decode()
    return "the model" if xml_file == _NAMELESS else f"the model {xml_file!r}"


def is_own(xml_file: ModelSource) -> bool:
    """Returns whether a model is the user's, by a path; raises ValueError where no file is."""
    if not isinstance(xml_file, str):
        return True
    own = "/" in xml_file or "\\" in xml_file
    if own and not Path(xml_file).is_file():
        raise ValueError(f"there is no model {xml_file!r} in {Path.cwd()}")
    return own


def spec(xml_file: ModelSource) -> Any:
    """Returns a model before it is compiled, an ``MjSpec``; otherwise as ``load_model``."""
    if isinstance(xml_file, MjSpec):
        return xml_file.copy()
    if is_own(xml_file):
        return _compile_model(MjSpec.from_file, xml_file, xml_file)
    return _compile_model(MjSpec.from_string, _asset(xml_file), xml_file)


def _asset(xml_file: str) -> str:
    """Returns the text of a model of the package, or raises ValueError."""
    asset = importlib.resources.files("mjx_reinforce.envs") / "assets" / xml_file
    if not asset.is_file():
        raise ValueError(
            f"the package has no model {xml_file!r}; give a path with a folder for your own, "
            f"such as './{xml_file}'"
        )
    return asset.read_text(encoding="utf-8")


def _compile_model(
    compiler: Callable[[Any], Any], source: ModelSource, xml_file: ModelSource
) -> Any:
    """Returns the model, or raises ValueError with the file's name and what MuJoCo says."""
    try:
        return compiler(source)
    except Exception as error:  # mujoco.FatalError is no ValueError
        raise ValueError(f"MuJoCo cannot compile {_name(xml_file)}: {explain(error)}") from error


def replaced(episode: dict[str, Any]) -> dict[str, Any]:
    """Returns the fields of the model that an episode replaces, see ``MujocoEnv.randomize``."""
    return {name: value for name, value in episode.items() if name in RANDOM}


def make_data(model: "mjx.Model") -> mjx.Data:
    """Returns MJX's simulation of a model at its start, on this process's own device."""
    return contacts.make_data(model, jax.local_devices()[0])


def to_mjx(model: MjModel, xml_file: ModelSource) -> mjx.Model:
    """Returns MJX's version of a compiled model.

    Args:
      model: the compiled model.
      xml_file: where it came from, for the message.

    Raises:
      ValueError: MJX cannot run it; the message names the feature and what to change.
    """
    for feature, remedy in _ignored(model):
        raise ValueError(f"MJX cannot run {_name(xml_file)}: MJX would ignore {feature}; {remedy}")
    if _C.mjtSensor.mjSENS_RANGEFINDER in model.sensor_type and not model.nmat:
        raise ValueError(
            f"MJX cannot run {_name(xml_file)}: its rangefinders work only in a model that has a "
            'material, a bug of MJX; add <asset><material name="any"/></asset>'
        )
    try:
        for *geoms, pair in geom_pairs(model):
            kinds = tuple(mjx.GeomType(kind) for kind in model.geom_type[geoms])
            names = " on ".join(kind.name.lower() for kind in reversed(kinds))
            margin = model.geom_margin[geoms].sum() if pair < 0 else model.pair_margin[pair]
            if kinds in contacts.UNLIKE_C:
                raise NotImplementedError(f"collisions of {names}, {contacts.UNLIKE_C[kinds]}")
            if kinds in contacts.UNLIKE_C_WITHIN_MARGIN and margin:
                raise NotImplementedError(f"{names} with margin/gap, which MJX ignores")
        # Not on JAX's first device, which may be another process's.
        converted = mjx.put_model(model, impl="jax", device=jax.local_devices()[0])
        # Notices what the model alone does not show; its arrays are not made.
        jax.eval_shape(lambda: make_data(model))
    except NotImplementedError as error:
        feature = str(error)
        remedy = next((change for part, change in _REMEDIES.items() if part in feature), _ELSE)
        raise ValueError(f"MJX cannot run {_name(xml_file)}: {feature}; {remedy}") from error
    return converted


def _is_off(model: MjModel, flag: str) -> bool:
    """Returns whether a flag of <option> is disabled."""
    return bool(model.opt.disableflags & getattr(_C.mjtDisableBit, f"mjDSBL_{flag.upper()}"))


def _ignored(model: MjModel) -> Iterator[tuple[str, str]]:
    """Yields what MJX would ignore in silence, and how to do without it."""
    for field, feature, remedy in (*NOT_CARRIED.values(), *_IGNORED):
        if np.any(getattr(model, field)):
            yield feature, remedy
    scalar = model.jnt_type != _C.mjtJoint.mjJNT_BALL
    for kind, limited, ends, margin in (
        ("joint", model.jnt_limited & scalar, model.jnt_range, model.jnt_margin),
        ("tendon", model.tendon_limited, model.tendon_range, model.tendon_margin),
    ):
        if np.any(limited & (np.ptp(ends, axis=1) < 2 * margin)):
            yield f"one of two limits that a {kind} meets at once", _WITHIN_MARGIN
    for of in _SOFT:
        ref = getattr(model, of.format("solref"))
        low, high, width = getattr(model, of.format("solimp"))[:, :3].T
        if np.any((ref[:, 0] > 0) != (ref[:, 1] > 0)):
            yield "MuJoCo's default in place of a solref of mixed signs", _ONE_SIGN
        if np.any((low > high) | ((width < 1e-15) & (low != high))):  # mjMINVAL
            yield "the first number of a solimp that does not rise", _RISING
    if model.opt.enableflags & _C.mjtEnableBit.mjENBL_SLEEP:
        yield "sleeping bodies", 'remove <flag sleep="enable"/>'
    if model.opt.noslip_iterations:
        yield "noslip_iterations", "remove it"
    if stops_early(model):
        few = f"where C stops after so few iterations ({model.opt.iterations}), with "
        if model.opt.solver == _C.mjtSolver.mjSOL_CG:
            yield few + "conjugate gradients", _GO_ON
        if model.opt.cone == _C.mjtCone.mjCONE_ELLIPTIC and any(geom_pairs(model)):
            yield few + "elliptic cones", _GO_ON
    if model.opt.disableactuator:
        yield "disabled groups of actuators", "remove actuatorgroupdisable, or those actuators"
    for flag, values in (("spring", "stiffness"), ("damper", "damping")):
        if _is_off(model, flag):
            yield f'parts of <flag {flag}="disable"/>', f"remove it, and give no {values}"
    for flag in ("nativeccd", "multiccd"):
        if _is_off(model, flag):
            yield f'<flag {flag}="disable"/>', "remove it"
    # MJX adds up the forces on a body of rows that are not there.
    constraint = _is_off(model, "constraint")
    if constraint and not _is_off(model, "contact") and any(geom_pairs(model)):
        yield '<flag constraint="disable"/> for contacts', 'add contact="disable" to it'
    if (constraint or _is_off(model, "equality")) and np.isin(model.eq_type, _HOLDS).any():
        yield '<flag equality="disable"/> for a connect or a weld', 'give it active="false"'
    if model.opt.integrator == _C.mjtIntegrator.mjINT_DISCRETE:
        yield "the integrator INT_DISCRETE", _REMEDIES["INT_IMPLICIT"]
