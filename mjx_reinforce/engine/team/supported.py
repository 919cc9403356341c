"""What teams of lanes play: which models of MuJoCo the device code covers."""

import itertools
from collections.abc import Collection, Iterable
from typing import Any, NamedTuple

import mujoco
import numpy as np

from mjx_reinforce.engine.base import MjModel
from mjx_reinforce.engine.physics.early_stop import stops_early
from mjx_reinforce.engine.physics.mjx_internals import meeting_pairs
from mjx_reinforce.engine.team import flags

_C: Any = mujoco  # a C extension without stubs
#: MuJoCo's mjtJoint.
FREE, BALL, SLIDE, HINGE = range(4)
#: MuJoCo's mjtGeom.
PLANE, SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX, MESH = (
    int(getattr(_C.mjtGeom, f"mjGEOM_{name}"))
    for name in ("PLANE", "SPHERE", "CAPSULE", "ELLIPSOID", "CYLINDER", "BOX", "MESH")
)
#: Bits of a mask of degrees of freedom, of which the widest is an unsigned long long.
MAX_DOFS = 64
#: Bits of a geom's number in a packed item, two of which and a part's number fit into an int.
GEOM_BITS = 12
_MAX_GEOMS = 2**GEOM_BITS
MAX_ITEMS = 4096
#: Contacts that a team has memory for, of some 250 bytes each.
_MAX_CONTACTS = 4 * MAX_ITEMS
#: How many contacts two geoms of these types may have, each of which is a part of the pair.
NUM_PARTS = {
    (PLANE, SPHERE): 1,
    (SPHERE, SPHERE): 1,
    (SPHERE, CAPSULE): 1,
    (SPHERE, BOX): 1,
    (SPHERE, CYLINDER): 1,
    (PLANE, ELLIPSOID): 1,
    (CAPSULE, CAPSULE): 1,
    (PLANE, CAPSULE): 2,
    (CAPSULE, BOX): 2,
    (PLANE, MESH): 4,
    (PLANE, BOX): 4,
    (PLANE, CYLINDER): 4,
    (BOX, BOX): 8,
}
#: The same of what MuJoCo's convex collider meets, which finds all contacts of a pair at once.
CONVEX_CONTACTS = {
    (SPHERE, ELLIPSOID): 1,
    (CAPSULE, ELLIPSOID): 1,
    (ELLIPSOID, ELLIPSOID): 1,
    (ELLIPSOID, CYLINDER): 1,
    (ELLIPSOID, BOX): 1,
    (SPHERE, MESH): 1,
    (ELLIPSOID, MESH): 1,
    (CAPSULE, CYLINDER): 2,
    (CAPSULE, MESH): 2,
    (CYLINDER, CYLINDER): 4,
    (CYLINDER, BOX): 4,
    (CYLINDER, MESH): 4,
    (BOX, MESH): 4,
    (MESH, MESH): 4,
}
#: Steps of the convex collider that a lane has room for: it numbers its triangles in a byte.
_MAX_CONVEX_STEPS = 100


class GeomPair(NamedTuple):
    """Two geoms that may meet.

    geom1: the number of the flatter one
    geom2: that of the other one
    pair: the number of the pair that the model names; -1 where it names none
    """

    geom1: int
    geom2: int
    pair: int


def why(mj_model: MjModel, random: Collection[str] = ()) -> str | None:
    """Returns in one line why teams cannot play a model, or None if they can.

    Args:
      mj_model: the model.
      random: the names of its fields that differ from episode to episode.
    """
    model = flags.without_disabled(mj_model)
    features = itertools.chain(
        _lacking_options(model),
        _lacking_parts(model),
        _lacking_actuators(model),
        _lacking_draws(model, random),
        _lacking_contacts(model),
    )
    for feature, has_feature in features:
        if has_feature:
            return f"the model has {feature}, which teams of lanes do not play"
    return None


def _lacking_options(model: Any) -> Iterable[tuple[str, Any]]:
    """Yields what of a model's options the device code lacks, and whether the model has it."""
    opt = model.opt
    types = _C.mjtIntegrator
    integrators = (types.mjINT_EULER, types.mjINT_RK4, types.mjINT_IMPLICITFAST)
    yield "an integrator other than Euler, RK4 and implicitfast", opt.integrator not in integrators
    yield "a solver other than Newton", opt.solver != _C.mjtSolver.mjSOL_NEWTON
    # Where C stops early it does so in each stage.
    is_early = stops_early(model)
    limits = f"few iterations of its solver ({opt.iterations}, {opt.ls_iterations} along a line)"
    yield f"{limits} under Runge-Kutta", is_early and opt.integrator == types.mjINT_RK4
    yield "flags that enable parts of the physics", flags.enabled_physics(model)
    has_noslip = opt.noslip_iterations > 0
    yield f"{limits} and noslip iterations", is_early and has_noslip
    pulls = model.ntendon and np.any(model.tendon_frictionloss)
    yield "noslip iterations and friction loss of tendons", has_noslip and pulls
    has_medium = opt.density > 0 or opt.viscosity > 0
    is_fast = opt.integrator == types.mjINT_IMPLICITFAST
    yield "a medium under implicitfast", has_medium and is_fast
    yield "ellipsoids in a medium", has_medium and np.any(model.geom_fluid[:, 0])


def _lacking_parts(model: Any) -> Iterable[tuple[str, Any]]:
    """Yields what of bodies and constraints the device code lacks, and whether a model has it."""
    yield "no joints", not model.njnt
    yield f"more than {MAX_DOFS} degrees of freedom", model.nv > MAX_DOFS
    yield f"{_MAX_GEOMS} geoms or more", model.ngeom >= _MAX_GEOMS
    yield "flexes or plugins", model.nflex or model.nplugin
    pulling = pulling_tendons(model)
    wrap_tendons = np.repeat(np.arange(model.ntendon), model.tendon_num)
    wraps = model.wrap_type[np.isin(wrap_tendons, pulling)]
    wrapping = (_C.mjtWrap.mjWRAP_SPHERE, _C.mjtWrap.mjWRAP_CYLINDER)
    yield "tendons that wrap geoms", np.isin(wraps, wrapping).any()
    of_tendons = model.actuator_trntype == _C.mjtTrn.mjTRN_TENDON
    armatures = (model.tendon_armature, model.actuator_armature[of_tendons])
    yield "tendons with armature", any(np.any(x) for x in armatures)
    yield "tendons that yield", np.any(model.tendon_springyield)
    yield "tendons with a range of actuators' forces", np.any(model.tendon_actfrclimited)
    yield "joints that yield", np.any(model.jnt_springyield)
    active = model.eq_type[np.asarray(model.eq_active0, bool)]
    equalities = (_C.mjtEq.mjEQ_CONNECT, _C.mjtEq.mjEQ_WELD, _C.mjtEq.mjEQ_JOINT)
    yield "equalities other than connect, weld and joint", not np.isin(active, equalities).all()


def _lacking_actuators(model: Any) -> Iterable[tuple[str, Any]]:
    """Yields what of actuators the device code lacks, and whether a model has it."""
    kinds = model.actuator_trntype
    types = _C.mjtTrn
    joint_types = (types.mjTRN_JOINT, types.mjTRN_JOINTINPARENT)
    covered = (*joint_types, types.mjTRN_TENDON, types.mjTRN_SITE)
    yield "actuators other than of joints, tendons and sites", not np.isin(kinds, covered).all()
    is_relative = (kinds == types.mjTRN_SITE) & (model.actuator_trnid[:, 1] >= 0)
    turns = model.actuator_gear[: len(kinds), 3:].any(1)
    yield "actuators that turn a site against another one", np.any(is_relative & turns)
    # MuJoCo takes the representative of their control that is nearest.
    joints = np.where(np.isin(kinds, joint_types), model.actuator_trnid[:, 0], 0)
    is_of_ball = np.isin(kinds, joint_types) & (model.jnt_type[joints] == BALL)
    stiffness = model.actuator_gainprm[:, 0]
    is_servo = (stiffness != 0) & (stiffness == -model.actuator_biasprm[:, 1])
    yield "servos of ball joints", np.any(is_of_ball & is_servo)
    gains = np.isin(model.actuator_gaintype, (_C.mjtGain.mjGAIN_FIXED, _C.mjtGain.mjGAIN_AFFINE))
    biases = np.isin(model.actuator_biastype, (_C.mjtBias.mjBIAS_NONE, _C.mjtBias.mjBIAS_AFFINE))
    yield "gains or biases other than fixed and affine", not (gains.all() and biases.all())
    yield "activations of actuators", model.na
    yield "delays of actuators", np.any(model.actuator_delay)
    yield "actuators of several controls", np.any(model.actuator_ctrlnum != 1)


def _lacking_draws(model: Any, random: Collection[str]) -> Iterable[tuple[str, Any]]:
    """Yields what of random fields the device code lacks, and whether a model has it."""
    types = _C.mjtTrn
    kinds = model.actuator_trntype
    of_joints = np.isin(kinds, (types.mjTRN_JOINT, types.mjTRN_JOINTINPARENT))
    joint_kinds = model.jnt_type[np.where(of_joints, model.actuator_trnid[:, 0], 0)]
    # Their gear is in the parts of a cable.
    is_wrench = (kinds == types.mjTRN_SITE) | (of_joints & (joint_kinds <= BALL))
    has_gear = "actuator_gear" in random
    yield "random gears of actuators of sites, balls or free joints", has_gear and is_wrench.any()
    inherited = (model.actuator_armature, model.actuator_damping, model.actuator_dampingpoly)
    adds = any(np.any(x) for x in inherited)
    yield "random gears of actuators with armature or damping", has_gear and adds
    # One of them may be a servo.
    has_gains = {"actuator_gainprm", "actuator_biasprm"}.intersection(random)
    of_balls = of_joints & (joint_kinds == BALL)
    yield "random gains of actuators of ball joints", has_gains and of_balls.any()


def _lacking_contacts(model: Any) -> Iterable[tuple[str, Any]]:
    """Yields what of contacts the device code lacks, and whether a model has it."""
    adhesions = (model.geom_adhesion, model.geom_surfacevel, model.pair_adhesion)
    yield "adhesion or moving surfaces", any(np.any(x) for x in adhesions)
    num_contacts = 0
    has_convex = False
    pairs = meeting(model)
    for pair in pairs:
        kinds = geom_kinds(model, pair)
        flat_name, round_name = map(_geom_name, kinds)
        is_convex = kinds in CONVEX_CONTACTS
        yield f"{round_name} that meets {flat_name}", not is_convex and kinds not in NUM_PARTS
        # A kind that is lacking does not get here: ``why`` stops at the first one.
        num_contacts += CONVEX_CONTACTS[kinds] if is_convex else NUM_PARTS[kinds]
        has_convex |= is_convex
    yield f"more than {MAX_ITEMS} pairs of geoms that may meet", len(pairs) > MAX_ITEMS
    yield f"more than {_MAX_CONTACTS} possible contacts", num_contacts > _MAX_CONTACTS
    is_long = model.opt.ccd_iterations > _MAX_CONVEX_STEPS
    yield f"more than {_MAX_CONVEX_STEPS} ccd_iterations", has_convex and is_long
    yield "the flag nativeccd disabled", has_convex and flags.is_off(model, "nativeccd")


def num_parts(model: Any) -> int:
    """Returns how many parts the pairs of geoms that may meet have, that can be told apart."""
    return sum(NUM_PARTS.get(geom_kinds(model, pair), 1) for pair in meeting(model))


def _geom_name(kind: int) -> str:
    name = _C.mjtGeom(kind).name.removeprefix("mjGEOM_").lower()
    return f"an {name}" if name == "ellipsoid" else f"a {name}"


def pulling_tendons(model: Any) -> list[int]:
    """Returns the tendons that pull; one that only measures is no hindrance."""
    is_pulled = np.zeros(model.ntendon, bool)
    is_of_tendon = model.actuator_trntype == _C.mjtTrn.mjTRN_TENDON
    is_pulled[model.actuator_trnid[is_of_tendon, 0]] = True
    for field in (
        model.tendon_stiffness,
        model.tendon_stiffnesspoly.any(1),
        model.tendon_damping,
        model.tendon_dampingpoly.any(1),
        model.tendon_frictionloss,
        model.tendon_limited,
    ):
        is_pulled |= field != 0
    return np.flatnonzero(is_pulled).tolist()


def geom_kinds(model: Any, pair: GeomPair) -> tuple[int, int]:
    """Returns MuJoCo's types of two geoms."""
    return int(model.geom_type[pair.geom1]), int(model.geom_type[pair.geom2])


def meeting(model: Any) -> list[GeomPair]:
    """Returns the pairs of geoms that may meet, the flatter first; those of C's choice lead."""
    if not flags.has_contacts(model):
        return []
    pair_keys = ((int(pair), *sorted((int(g), int(h)))) for g, h, pair in meeting_pairs(model))
    pairs = []
    for pair, *geoms in sorted(pair_keys):
        flat_geom, round_geom = sorted(geoms, key=model.geom_type.__getitem__)
        pairs.append(GeomPair(flat_geom, round_geom, pair))
    return pairs
