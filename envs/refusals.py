"""What of a model would be simulated otherwise than by C MuJoCo, all at once and in words."""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np
from mujoco import MjModel, mjx  # pyright: ignore[reportAttributeAccessIssue]

from mjx_reinforce.engine.checks import BadEnvironmentError
from mjx_reinforce.engine.physics.contacts import UNLIKE_C, UNLIKE_C_WITHIN_MARGIN
from mjx_reinforce.engine.physics.early_stop import stops_early
from mjx_reinforce.engine.physics.mjx_internals import (
    geom_groups,
    geom_pairs,
    has_collider,
)

#: MuJoCo's own names; it is a C extension without stubs.
_C: Any = mujoco
_GEOM = _C.mjtGeom
_DISABLED = _C.mjtDisableBit
_ENABLED = _C.mjtEnableBit
#: What MJX does not carry: its size in the model, what it is, and how to do without.
NOT_CARRIED = {
    "history": ("nhistory", "delays", "remove delay and interval from actuators and sensors"),
    "plugin": ("nplugin", "plugins", "remove them"),
    "plastic": ("nplastic", "plastic springs", "remove springyield"),
}
_JOINT_REMEDY = "give it to the joint, times the square of gear"
_ONE_NUMBER = "give one number"
_SOLVER = 'set <option iterations="100" ls_iterations="50"/>, or solver="Newton" cone="pyramidal"'
#: What else MJX ignores in silence.
_IGNORED = (
    ("actuator_armature", "the armature of an actuator", _JOINT_REMEDY),
    ("actuator_damping", "the damping of an actuator", _JOINT_REMEDY),
    ("actuator_dampingpoly", "the polynomial damping of an actuator", _JOINT_REMEDY),
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
#: Fields whose values are of a kind: MJX's kinds, and MuJoCo's.
_KINDS = (
    ("actuator_biastype", mjx.BiasType, _C.mjtBias),
    ("actuator_dyntype", mjx.DynType, _C.mjtDyn),
    ("actuator_gaintype", mjx.GainType, _C.mjtGain),
    ("actuator_trntype", mjx.TrnType, _C.mjtTrn),
    ("eq_type", mjx.EqType, _C.mjtEq),
    ("sensor_type", mjx.SensorType, _C.mjtSensor),
    ("wrap_type", mjx.WrapType, _C.mjtWrap),
)
#: The same of <option>.
_OPTIONS = (
    ("integrator", mjx.IntegratorType, _C.mjtIntegrator),
    ("solver", mjx.SolverType, _C.mjtSolver),
)
#: Part of the name of a kind that MJX has not -> how to do without.
_REMEDIES = {
    "mjSOL_": 'set <option solver="Newton"/>',
    "mjINT_": 'set <option integrator="implicitfast"/>',
    "mjSENS_": "remove those sensors",
    "mjTRN_BODY": "replace the adhesion actuators by friction (friction, condim of the geoms), or "
    "by a <weld> equality",
    "mjTRN_SLIDERCRANK": "replace the slider-crank by the <motor> of a joint, or make its rod a "
    "body that a <connect> equality holds",
    "_USER": "replace the user-defined actuators by <motor>, <position>, <velocity> or <muscle>",
    "mjEQ_": "replace those equalities by <connect>, <weld>, <joint> or <tendon>",
    "mjENBL_OVERRIDE": 'set <flag override="disable"/> and give geoms solref and solimp of their '
    "own",
    "mjENBL_": "take that <flag> out of <option>",
}
_REMOVAL = "remove it; MuJoCo's documentation lists what MJX supports under 'MJX, feature parity'"
#: Fields of a model that say how stiff its constraints are.
_SOLREF = ("dof_{}", "eq_{}", "geom_{}", "jnt_{}", "pair_{}", "tendon_{}_lim", "tendon_{}_fri")
#: A message names so many geoms, or pairs of them.
_MAX_NAMED = 3


class Difference(NamedTuple):
    """Why contacts would be others than C's.

    reason: in words
    remedy: in words
    of_margin: whether they would be the same without margin and gap
    """

    reason: str
    remedy: str
    of_margin: bool


class UnsupportedError(BadEnvironmentError):
    """A model has what would be simulated otherwise than by C MuJoCo; the message says all of it.

    This is the only error that means a refusal. Any other is a mistake, of the model's file or of
    this package.
    """


def check_supported(model: MjModel, name: str, *faults: str) -> None:
    """Checks that a model can be simulated as by C MuJoCo.

    Args:
      model: the compiled model.
      name: what a message calls it.
      *faults: what else is wrong with it, each with its remedy.

    Raises:
      UnsupportedError: it cannot; the message has every reason, each with its remedy.
    """
    # Keys of a dict, so that no sentence stands twice.
    differences = dict.fromkeys(f"{feature}; {remedy}" for feature, remedy in _reasons(model))
    reasons = [*faults, *differences]
    if len(reasons) == 1:
        raise UnsupportedError(f"MJX cannot run {name}: {reasons[0]}")
    if reasons:
        listed = "".join(f"\n  {i}. {reason}" for i, reason in enumerate(reasons, start=1))
        raise UnsupportedError(f"MJX cannot run {name}, for {len(reasons)} reasons:{listed}")


def is_off(model: MjModel, flag: str) -> bool:
    """Returns whether a flag of <option> is disabled."""
    return bool(model.opt.disableflags & getattr(_DISABLED, f"mjDSBL_{flag.upper()}"))


def may_touch(model: MjModel) -> bool:
    """Returns whether some geoms of a model can push each other."""
    # Without constraints C makes no contacts, either.
    is_disabled = is_off(model, "contact") or is_off(model, "constraint")
    return not is_disabled and any(True for _ in geom_pairs(model))


def _reasons(model: MjModel) -> Iterator[tuple[str, str]]:
    """Yields what a model has that would be simulated otherwise, and how to do without it."""
    for feature, remedy in _ignored(model):
        yield f"MJX would ignore {feature}", remedy
    yield from _missing(model)
    if may_touch(model) or model.npair:  # MJX looks at pairs even where none may touch
        yield from _of_contacts(model)


def _ignored(model: MjModel) -> Iterator[tuple[str, str]]:
    """Yields what MJX would ignore in silence, and how to do without it."""
    for field, feature, remedy in (*NOT_CARRIED.values(), *_IGNORED):
        if np.any(getattr(model, field)):
            yield feature, remedy
    # Joints and tendons with a lower and an upper limit; a ball's limit is one angle. MJX has one
    # row for both limits, C a row for each that is nearer than the margin.
    is_scalar = model.jnt_type != _C.mjtJoint.mjJNT_BALL
    for kind, limited, ends, margin in (
        ("joint", model.jnt_limited & is_scalar, model.jnt_range, model.jnt_margin),
        ("tendon", model.tendon_limited, model.tendon_range, model.tendon_margin),
    ):
        narrow_ranges = np.flatnonzero(limited & (np.ptp(ends, axis=1) < 2 * margin))
        if narrow_ranges.size:
            names = listed([getattr(model, kind)(i).name or f"number {i}" for i in narrow_ranges])
            remedy = "give it a margin of at most half of its range"
            yield f"one of two limits that a {kind} meets at once ({names})", remedy
    refs = (getattr(model, field_format.format("solref")) for field_format in _SOLREF)
    if any(np.any((ref[:, 0] > 0) != (ref[:, 1] > 0)) for ref in refs):
        remedy = "give two positive numbers, or two that are not"
        yield "MuJoCo's default in place of a solref of mixed signs", remedy
    if model.opt.enableflags & _ENABLED.mjENBL_SLEEP:
        yield "sleeping bodies", 'remove <flag sleep="enable"/>'
    if model.opt.noslip_iterations:
        yield "noslip_iterations", "remove it"
    if stops_early(model):
        early_stop = f"where C stops after so few iterations ({model.opt.iterations}), with "
        if model.opt.solver == _C.mjtSolver.mjSOL_CG:
            yield early_stop + "conjugate gradients", _SOLVER
        if model.opt.cone == _C.mjtCone.mjCONE_ELLIPTIC and any(geom_pairs(model)):
            yield early_stop + "elliptic cones", _SOLVER
    if model.opt.disableactuator:
        yield "disabled groups of actuators", "remove actuatorgroupdisable, or those actuators"
    for flag, values in (("spring", "stiffness"), ("damper", "damping")):
        if is_off(model, flag):
            yield f'parts of <flag {flag}="disable"/>', f"remove it, and give no {values}"
    for flag in ("nativeccd", "multiccd"):
        if is_off(model, flag):
            yield f'<flag {flag}="disable"/>', "remove it"
    if model.opt.integrator == _C.mjtIntegrator.mjINT_DISCRETE:
        yield "the integrator INT_DISCRETE", _REMEDIES["mjINT_"]


def _missing(model: MjModel) -> Iterator[tuple[str, str]]:
    """Yields what MJX has not, and how to do without it."""
    # The model's values, MJX's enum of those that it has, and C's of all, which has their names.
    enums = [(getattr(model, field), in_mjx, in_c) for field, in_mjx, in_c in _KINDS]
    enums += [([getattr(model.opt, field)], in_mjx, in_c) for field, in_mjx, in_c in _OPTIONS]
    flags = [1 << bit for bit in range(_ENABLED.mjNENABLE) if model.opt.enableflags & 1 << bit]
    for values, in_mjx, in_c in (*enums, (flags, mjx.EnableBit, _ENABLED)):
        for kind in sorted({*map(int, values)} - {*map(int, in_mjx)}):
            name = in_c(kind).name
            remedy = next((x for part, x in _REMEDIES.items() if part in name), _REMOVAL)
            # MJX would ignore the discrete integrator, which _ignored says.
            if name != "mjINT_DISCRETE":
                yield f"MJX has no {name}", remedy
    if model.nu and not model.nv:
        yield "nothing in it moves, and MJX needs a joint", "add a <joint>"
    if model.nflex:
        yield "MJX has no flexible bodies", "remove the <flexcomp> or <flex>"
    fluid = model.opt.density or model.opt.viscosity or model.opt.wind.any()
    if fluid and model.opt.integrator == _C.mjtIntegrator.mjINT_IMPLICITFAST:
        remedy = 'set <option integrator="Euler"/> or remove density, viscosity and wind'
        yield "MJX has no fluid drag with the integrator implicitfast", remedy
    if _C.mjtSensor.mjSENS_RANGEFINDER in model.sensor_type and not model.nmat:
        remedy = 'add <asset><material name="any"/></asset>'
        yield "its rangefinders work only with a material, a bug of MJX", remedy
    # [2, n]: what each of the contact sensors looks at, on both sides. The second of its integers
    # says how contacts are reduced: 3 is reduce="netforce".
    is_contact = model.sensor_type == _C.mjtSensor.mjSENS_CONTACT
    sides = np.stack([model.sensor_objtype, model.sensor_reftype])[:, is_contact]
    is_wide = np.isin(sides, (_C.mjtObj.mjOBJ_SITE, _C.mjtObj.mjOBJ_BODY, _C.mjtObj.mjOBJ_XBODY))
    if is_wide.any() or np.any(model.sensor_intprm[is_contact, 1] == 3):
        remedy = "name two geoms, and do not reduce to the net force"
        yield "MJX has contact sensors between geoms alone, without net force", remedy


def _of_contacts(model: MjModel) -> Iterator[tuple[str, str]]:
    """Yields which contacts MJX has not, or finds elsewhere, and how to do without them."""
    groups: dict[tuple[str, str], list[tuple[int, int]]] = {}
    for geom1, geom2, pair in geom_pairs(model):
        geoms = (int(geom1), int(geom2))
        for difference in unlike(model, *geoms, int(pair)):
            groups.setdefault(difference[:2], []).append(geoms)
    # A sentence for all pairs of one reason: there may be hundreds of them.
    for (reason, remedy), pairs in groups.items():
        noun = "pairs" if len(pairs) > 1 else "pair"
        sentence = f"{len(pairs):,} {noun} of {reason} ({listed(_pair_names(model, pairs))})"
        yield sentence, remedy.format(exclude=_exclude(model, pairs))
    if model.opt.cone == _C.mjtCone.mjCONE_ELLIPTIC:
        frictionless = [pair for condim, *pair in geom_groups(model) if condim == 1]
        if frictionless:
            names = listed(_pair_names(model, frictionless))
            count = len(frictionless)
            sentence = f"MJX has no contacts of condim 1 in elliptic cones: {count} ({names})"
            yield sentence, 'set <option cone="pyramidal"/> or condim="3"'


def unlike(model: MjModel, geom1: int, geom2: int, pair: int) -> Iterator[Difference]:
    """Yields why the contacts of two geoms would be others than C's, and a remedy.

    Args:
      model: the compiled model.
      geom1: the number of the first geom, in the order of ``geom_pairs``.
      geom2: that of the second.
      pair: the number of their <pair> element, which has a margin of its own, or -1.
    """
    kinds = (int(model.geom_type[geom1]), int(model.geom_type[geom2]))
    margin = model.geom_margin[[geom1, geom2]].sum() if pair < 0 else model.pair_margin[pair]
    names = " on ".join(_GEOM(kind).name[len("mjGEOM_") :].lower() for kind in reversed(kinds))
    # ``_of_contacts`` fills in an <exclude> of the first pair.
    advice = (
        "keep those apart with contype and conaffinity{exclude}, or use "
        "spheres, capsules, boxes and planes"
    )
    if _GEOM.mjGEOM_SDF in kinds or not has_collider(*kinds):
        yield Difference(f"{names}, which MJX has not", advice, of_margin=False)
    elif kinds in UNLIKE_C:
        reason = UNLIKE_C[tuple(map(mjx.GeomType, kinds))]
        yield Difference(f"{names}, {reason}", advice, of_margin=False)
    elif margin and kinds in UNLIKE_C_WITHIN_MARGIN:
        remedy = "remove margin and gap from those geoms"
        reason = f"{names} with a margin or gap, which MJX ignores"
        yield Difference(reason, remedy, of_margin=True)


def _exclude(model: MjModel, pairs: Sequence[tuple[int, int]]) -> str:
    """Returns what to write to keep the bodies of the first pair apart, if both have names."""
    names = [model.body(int(model.geom_bodyid[geom])).name for geom in pairs[0]]
    if not all(names):
        return ""
    return ', or with <contact><exclude body1="{}" body2="{}"/></contact>'.format(*names)


def _pair_names(model: MjModel, pairs: Sequence[Sequence[int]]) -> list[str]:
    """Returns what a message calls pairs of geoms."""
    return [" and ".join(geom_name(model, geom) for geom in pair) for pair in pairs]


def geom_name(model: MjModel, geom: int) -> str:
    """Returns what a message calls a geom: by its name, or by its body's and its number."""
    if model.geom(geom).name:
        return model.geom(geom).name
    body = int(model.geom_bodyid[geom])
    body_name = model.body(body).name or f"number {body}"
    # Counted within its body, as it stands in the file.
    return f"geom {geom - int(model.body_geomadr[body])} of body {body_name}"


def listed(names: Sequence[str]) -> str:
    """Returns the first names, and how many more there are."""
    text = ", ".join(names[:_MAX_NAMED])
    num_unnamed = len(names) - _MAX_NAMED
    if num_unnamed > 0:
        text += f", and {num_unnamed:,} more"
    return text


def best_in_c(model: MjModel) -> str | None:
    """Returns in a few words why C MuJoCo plays a model best; None if machine code plays it faster.

    MJX may not run the model as C MuJoCo does, or leave it to MJX's own solver, which is slow: this
    package's solvers know pyramidal cones, joint limits, equalities and friction losses.
    """
    # Without the names of geoms, which ``check_supported`` lists: this is part of a line.
    reasons = [*dict.fromkeys(feature.partition(" (")[0] for feature, _ in _reasons(model))]
    if len(reasons) > 1:
        return f"{reasons[0]}, and {len(reasons) - 1} more"
    if reasons:
        return reasons[0]
    if model.opt.cone == _C.mjtCone.mjCONE_ELLIPTIC and any(geom_pairs(model)):
        return "elliptic cones"
    return None
