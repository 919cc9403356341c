"""The edits of ``new --fix``: what is changed in an ``MjSpec``, where a remedy is mechanical.

Each function changes the model in place and yields in words what it changed. What stays is what
``refusals`` names of the mended model.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import mujoco
import numpy as np
from mujoco import mjx

from mjx_reinforce.engine.base import MjModel, MjSpec
from mjx_reinforce.engine.physics.early_stop import stops_early
from mjx_reinforce.envs import instability, models, refusals
from mjx_reinforce.envs.mending import ground

#: MuJoCo's own names; it is a C extension without stubs.
_C: Any = mujoco
#: Attributes that are removed wherever they are not zero, as ``refusals`` advises.
_REMOVED = {
    "actuators": ("actearly", "delay", "nsample", "interp"),
    "geoms": ("adhesion", "fluid_ellipsoid", "surfacevel"),
    "joints": ("springyield",),
    "pairs": ("adhesion",),
    "sensors": ("delay", "interval", "nsample", "interp"),
    "tendons": ("springyield",),
}
#: What a box that takes the place of a mesh in contacts has of the mesh.
_OF_CONTACTS = (
    *("contype", "conaffinity", "condim", "priority", "friction"),
    *("solmix", "solref", "solimp", "margin", "gap"),
)


class Mended(NamedTuple):
    """A model of which everything is changed that has a mechanical remedy.

    spec: the changed model
    edits: in words, each change; none where nothing is to be changed
    """

    spec: MjSpec
    edits: list[str]


def mend(xml_file: models.ModelSource) -> Mended:
    """Changes a copy of a model so that more engines play it, faster, and so that it is stable.

    Args:
      xml_file: as of ``load_model``.
    """
    spec: Any = models.spec(xml_file)
    edits: list[str] = []
    # Each begins at what the former ones left, compiled, by whose numbers it finds the elements.
    model = spec.compile()
    for edit in (_options, _attributes, _feet_alone, _refused_contacts, _stability):
        changes = [*edit(spec, model)]
        if changes:
            model = spec.compile()
            edits += changes
    return Mended(spec, edits)


def _options(spec: Any, model: MjModel) -> Iterator[str]:
    """Changes what <option> has."""
    option = spec.option
    if option.solver == _C.mjtSolver.mjSOL_PGS:
        option.solver = _C.mjtSolver.mjSOL_NEWTON
        yield 'solver="Newton" in place of PGS'
    types = _C.mjtIntegrator
    fluid = option.density or option.viscosity or option.wind.any()
    if option.integrator in (types.mjINT_IMPLICIT, types.mjINT_DISCRETE):
        option.integrator = types.mjINT_IMPLICITFAST
        yield 'integrator="implicitfast"'
    if fluid and option.integrator == types.mjINT_IMPLICITFAST:
        option.integrator = types.mjINT_EULER
        yield 'integrator="Euler", since there is a fluid'
    if option.cone == _C.mjtCone.mjCONE_ELLIPTIC and ground.pairs(model):
        option.cone = _C.mjtCone.mjCONE_PYRAMIDAL
        yield 'cone="pyramidal" in place of elliptic'
    if stops_early(model) and option.solver == _C.mjtSolver.mjSOL_CG:
        option.iterations, option.ls_iterations = 100, 50
        yield 'iterations="100" ls_iterations="50"'
    if option.noslip_iterations:
        option.noslip_iterations = 0
        yield "noslip_iterations removed"
    sleep = int(_C.mjtEnableBit.mjENBL_SLEEP)
    if option.enableflags & sleep:
        option.enableflags &= ~sleep
        yield "sleep removed"
    ccd = int(_C.mjtDisableBit.mjDSBL_NATIVECCD | _C.mjtDisableBit.mjDSBL_MULTICCD)
    if option.disableflags & ccd:
        option.disableflags &= ~ccd
        yield "flags nativeccd and multiccd not disabled"


def _attributes(spec: Any, model: MjModel) -> Iterator[str]:
    """Removes attributes and sensors that MJX ignores or lacks, or gives them to joints."""
    for actuator in spec.actuators:
        yield from _to_joint(spec, actuator)
    for collection, attributes in _REMOVED.items():
        for attribute in attributes:
            elements = [
                x
                for x in getattr(spec, collection)
                if np.any(getattr(x, attribute)) and not _needs(x, attribute)
            ]
            for element in elements:
                setattr(element, attribute, 0 * getattr(element, attribute))
            if elements:
                yield f"{attribute} removed from {_names(elements)}"
    kinds = {int(kind) for kind in mjx.SensorType}
    sensors = [x for x in spec.sensors if int(x.type) not in kinds]
    if sensors:
        yield f"sensors removed: {_names(sensors)}"
    for sensor in sensors:
        spec.delete(sensor)
    if _C.mjtSensor.mjSENS_RANGEFINDER in model.sensor_type and not model.nmat:
        spec.add_material(name="any")
        yield "a material for rangefinders added"


def _needs(element: Any, attribute: str) -> bool:
    """Returns whether MuJoCo compiles an element only with an attribute."""
    return attribute == "actearly" and element.dyntype == _C.mjtDyn.mjDYN_DCMOTOR


def _to_joint(spec: Any, actuator: Any) -> Iterator[str]:
    """Gives the armature and the damping of an actuator to its joint, times the gear's square."""
    if actuator.trntype != _C.mjtTrn.mjTRN_JOINT:
        return
    joint = spec.joint(actuator.target)
    for attribute in ("armature", "damping"):
        if np.any(getattr(actuator, attribute)):
            share = actuator.gear[0] ** 2 * getattr(actuator, attribute)
            setattr(joint, attribute, getattr(joint, attribute) + share)
            setattr(actuator, attribute, 0 * share)
            yield f"{attribute} of actuator {actuator.name} given to joint {joint.name}"


def _feet_alone(spec: Any, model: MjModel) -> Iterator[str]:
    """Lets only the feet of a robot collide, with what cannot move."""
    stance = ground.stance(model)
    num_pairs = len(ground.pairs(model))
    if stance is None or len(stance.pairs) == num_pairs:
        return
    geoms = _by_number(spec.geoms)
    for geom in geoms.values():
        geom.contype = geom.conaffinity = 0
    for geom1, geom2, pair in stance.pairs:
        for geom in (geom1, geom2):
            if pair < 0:
                geoms[geom].contype = int(ground.is_ground(model, geom))
                geoms[geom].conaffinity = int(not ground.is_ground(model, geom))
    kept_pairs = {x.pair for x in stance.pairs}
    for number, element in _by_number(spec.pairs).items():
        if number not in kept_pairs:
            spec.delete(element)
    count = f"possible contacts {len(stance.pairs):,} in place of {num_pairs:,}"
    feet = ", ".join(refusals.geom_name(model, foot) for foot in stance.feet)
    yield f"only the feet collide ({feet}), {count}"


def _refused_contacts(spec: Any, model: MjModel) -> Iterator[str]:
    """Removes margins, keeps a robot from itself, and puts boxes around meshes of feet."""
    geoms = _by_number(spec.geoms)
    bodies = _by_number(spec.bodies)
    elements = _by_number(spec.pairs)
    stance = ground.stance(model)
    feet = [] if stance is None else stance.feet
    mesh = _C.mjtGeom.mjGEOM_MESH
    boxed: dict[int, None] = {}
    excluded: dict[tuple[int, int], None] = {}
    close: list[int] = []
    for geom1, geom2, pair in ground.pairs(model):
        reason = next(refusals.unlike(model, geom1, geom2, pair), None)
        if reason is None:
            continue
        if reason.of_margin:
            close += [geom1, geom2]
            for element in [geoms[geom1], geoms[geom2]] if pair < 0 else [elements[pair]]:
                element.margin = element.gap = 0
            continue
        body1, body2 = sorted(int(x) for x in model.geom_bodyid[[geom1, geom2]])
        if pair < 0 and model.body_rootid[body1] == model.body_rootid[body2]:
            excluded[body1, body2] = None
            continue
        # A box around another mesh than a foot's may reach into what is beside it.
        boxed |= {x: None for x in feet if x in (geom1, geom2) and model.geom_type[x] == mesh}
    if close:
        yield f"margin and gap removed from {_geom_names(model, close)}"
    for pair_of_bodies in excluded:
        for body in pair_of_bodies:
            bodies[body].name = bodies[body].name or f"body_{body}"
        first, second = (bodies[body].name for body in pair_of_bodies)
        spec.add_exclude(bodyname1=first, bodyname2=second)
    if excluded:
        names = [f"{bodies[one].name} and {bodies[two].name}" for one, two in excluded]
        yield f"kept apart: {refusals.listed(names)}"
    data = ground.first_pose(model)
    for number in boxed:
        _put_box(geoms[number], model, data)
    if boxed:
        yield f"a box collides in place of the mesh of {_geom_names(model, boxed)}"


def _put_box(geom: Any, model: MjModel, data: Any) -> None:
    """Adds to a mesh's body a level box around it in the first pose, which collides in its place.

    Args:
      geom: the geom of the mesh; it keeps its looks and its mass, and loses its name.
      model: of which it is.
      data: the ``MjData`` of the first pose.
    """
    mesh = model.geom_dataid[geom.id]
    start = model.mesh_vertadr[mesh]
    points = model.mesh_vert[start : start + model.mesh_vertnum[mesh]]
    points = points @ data.geom_xmat[geom.id].reshape(3, 3).T + data.geom_xpos[geom.id]
    low, high = points.min(axis=0), points.max(axis=0)
    body = geom.parent
    axes = data.xmat[body.id].reshape(3, 3)
    quat = data.xquat[body.id] * [1, -1, -1, -1]
    box = body.add_geom(
        type=_C.mjtGeom.mjGEOM_BOX,
        size=(high - low) / 2,
        pos=axes.T @ ((low + high) / 2 - data.xpos[body.id]),
        quat=quat,
        mass=0,
        group=3,
    )
    for attribute in _OF_CONTACTS:
        setattr(box, attribute, getattr(geom, attribute))
    # What looks at the contacts of the geom, such as a sensor, looks at the box now.
    name = geom.name
    geom.name = f"{name}_mesh" if name else ""
    box.name = name
    geom.contype = geom.conaffinity = 0


def _stability(spec: Any, model: MjModel) -> Iterator[str]:
    """Writes the first remedy under which C MuJoCo plays the model for a second."""
    remedy = instability.remedy(model)
    if remedy is None:
        return
    spec.option.integrator = remedy.model.opt.integrator
    spec.option.timestep = remedy.model.opt.timestep
    for number, joint in _by_number(spec.joints).items():
        armature = remedy.model.dof_armature[model.jnt_dofadr[number]]
        if armature != model.dof_armature[model.jnt_dofadr[number]]:
            joint.armature = armature
    for number, actuator in _by_number(spec.actuators).items():
        damping = remedy.model.actuator_biasprm[number, 2]
        if damping != model.actuator_biasprm[number, 2]:
            actuator.biasprm[2] = damping
    yield f"{remedy.words}: with it the model is stable for a second in C MuJoCo"


def _by_number(elements: Any) -> dict[int, Any]:
    """Returns elements by their numbers in the compiled model."""
    return {element.id: element for element in elements}


def _names(elements: list[Any]) -> str:
    """Returns the first names of elements."""
    return refusals.listed([x.name or f"number {x.id}" for x in elements])


def _geom_names(model: MjModel, geoms: Any) -> str:
    """Returns the first names of geoms, each once."""
    return refusals.listed([refusals.geom_name(model, geom) for geom in dict.fromkeys(geoms)])
