"""Fields of a model that differ from episode to episode, in the tables of the device code.

A team has the tables that depend on such fields in its state. The program of a task computes their
entries from what ``MujocoEnv.randomize`` drew, and from what MuJoCo derives of that. Poses of mocap
bodies, of mjData, are always among these tables.
"""

from collections.abc import Collection, Iterable, Mapping
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_reinforce.engine.team import flags, records
from mjx_reinforce.engine.team.contact_kinds import MIN_VALUE
from mjx_reinforce.engine.team.frames import rotation, times
from mjx_reinforce.engine.team.supported import SLIDE
from mjx_reinforce.engine.team.tables import passive
from mjx_reinforce.engine.team.tables.store import Tables

_C: Any = mujoco  # a C extension without stubs
#: Fields that the inertias of links depend on, and those that inverse masses do.
_OF_LINKS = frozenset(("body_mass", "body_inertia", "body_ipos"))
INERTIAL = _OF_LINKS | {"dof_armature"}
#: The entries of a symmetric matrix that ``frames.six`` returns.
_ROWS = np.array([0, 1, 2, 0, 0, 1])
_COLUMNS = np.array([0, 1, 2, 1, 2, 2])
#: Parts of tables by the name of a table and the field of ``records.FIELDS`` that they begin at, ""
#: where a row has none, each [rows, columns].
Entries: TypeAlias = dict[tuple[str, str], Any]


def effective(model: Any, random: Collection[str]) -> frozenset[str]:
    """Returns those of random fields that the flags of a model let it read."""
    return frozenset(random) - flags.disabled_fields(model)


def entries(tables: Tables, fields: Mapping[str, Any]) -> Entries:
    """Returns what of a model's tables depends on random fields.

    Args:
      tables: all of them.
      fields: what an episode has in place of the model's fields, and what follows from it, by
        their names in mjModel; and ``mocap_pos`` and ``mocap_quat``.
    """
    random = tables.random
    parts: Entries = {}
    model = _Episode(tables.model, fields)
    if _OF_LINKS.intersection(random):
        parts |= _bodies(tables, model)
    if INERTIAL.intersection(random):
        parts |= _weights(tables, model)
    # Degrees of freedom inherit armature and damping of actuators, too.
    for field in {"dof_armature", "dof_damping"}.intersection(random):
        inherited = tables.reals[field] - getattr(tables.model, field)
        parts[field, ""] = (getattr(model, field) + inherited)[:, None]
    if "jnt_stiffness" in random:
        joint = tables.dof_joint
        is_single = tables.model.jnt_type[joint] >= SLIDE
        stiffness = model.jnt_stiffness[joint]
        parts["dof_stiffness", ""] = jnp.where(is_single, stiffness, 0)[:, None]
        parts["dof_law", "stiffness"] = jnp.where(is_single, 0, stiffness)[:, None]
    parts |= _actuators(tables, model)
    if "geom_friction" in random:
        parts["geom_friction", ""] = model.geom_friction[tables.geoms]
    for field in ("mocap_pos", "mocap_quat"):
        parts[field, ""] = fields.get(field, tables.reals[field])
    return {key: part for key, part in parts.items() if np.size(tables.reals[key[0]])}


class _Episode:
    """A model as it is in an episode."""

    def __init__(self, model: Any, fields: Mapping[str, Any]):
        self._model = model
        self._fields = fields

    def __getattr__(self, name: str) -> Any:
        return self._fields[name] if name in self._fields else getattr(self._model, name)


def _bodies(tables: Tables, model: Any) -> Entries:
    """Returns the inertias of bodies and links, what is compensated, and the medium's forces."""
    frames = tables.frames
    mass = model.body_mass
    axes = np.array(
        [rotation(times(x.quat, quat)) for x, quat in zip(frames, model.body_iquat, strict=True)]
    )
    frame_turns = np.array([rotation(x.quat) for x in frames])
    com = np.array([x.pos for x in frames]) + (frame_turns @ model.body_ipos[:, :, None])[:, :, 0]
    # Linear in the moments about the body's own axes.
    by_moment = axes[:, _ROWS] * axes[:, _COLUMNS]
    inertia = (by_moment @ model.body_inertia[:, :, None])[:, :, 0]

    links = np.array([max(x.link, -1) for x in frames])
    is_of_link = (np.arange(tables.model.njnt)[:, None] == links).astype(float)
    link_mass = is_of_link @ mass
    moment = is_of_link @ (mass[:, None] * com)
    link_com = jnp.where(
        link_mass[:, None] != 0, moment / jnp.maximum(link_mass, MIN_VALUE)[:, None], 0
    )
    # The parallel axis theorem; what the world and mocap bodies carry counts for no link.
    arm = com - link_com[links]
    shift = (arm * arm).sum(1)[:, None] * (_ROWS == _COLUMNS) - arm[:, _ROWS] * arm[:, _COLUMNS]
    held = (mass * model.body_gravcomp)[:, None] * jnp.column_stack([com, jnp.ones(len(com))])
    bodies = tables.fluid_bodies
    has_mass, has_moment, has_center = (
        name in tables.random for name in ("body_mass", "body_inertia", "body_ipos")
    )
    # Of a link that carries one body, the center is that of the body, unless nothing is there yet.
    is_shared = bool((is_of_link @ (1 + (tables.model.body_mass == 0)) > 1).any())
    parts: Entries = {}
    if has_mass:
        parts["body_mass", ""] = mass[:, None]
        parts["link_mass", ""] = link_mass[:, None]
    if has_moment:
        parts["body_inertia", ""] = inertia
    if has_center:
        parts["body_com", ""] = com
        parts["fluid_body", "at"] = com[bodies]
    if has_center or (has_mass and is_shared):
        parts["link_com", ""] = link_com
    if has_moment or is_shared:
        parts["link_inertia", ""] = is_of_link @ (inertia + mass[:, None] * shift)
    if has_mass or has_center:
        compensated = np.array(tables.ints["compensated_link"], int)
        parts["compensated", "moment"] = is_of_link[compensated] @ held
    if has_mass or has_moment:
        resistances = passive.fluid(jnp, model, bodies)
        parts |= {("fluid_body", field): part for field, part in resistances.items()}
    return parts


def _weights(tables: Tables, model: Any) -> Entries:
    """Returns the inverse masses of the rows of constraints."""
    body_weight = model.body_invweight0[:, :1]
    dof_weight = model.dof_invweight0[:, None]
    # The second joint of an equality is -1 where there is none.
    joined = np.array(tables.ints["joined_dof"]).reshape(-1, 2)
    bound_weights = [jnp.zeros((0, 1))]
    for cable in (tables.cables[x] for x in tables.ints["bound_cable"]):
        if cable.joint >= 0:
            dof = tables.model.jnt_dofadr[cable.joint]
            bound_weights.append(dof_weight[dof : dof + 1])
        else:
            bound_weights.append(model.tendon_invweight0[cable.tendon].reshape(1, 1))
    connected = np.array(tables.ints["connect_body"], int).reshape(-1, 2)
    welded = connected[len(connected) - tables.constants["NWELD"] :]
    parts: Entries = {}
    if tables.constants["LIMITS"]:
        parts["dof_limit", "weight"] = dof_weight
    if tables.constants["LOSSES"]:
        parts["dof_loss", "weight"] = dof_weight
    return parts | {
        ("body_weight", ""): body_weight,
        ("connect_weight", ""): body_weight[connected].sum(1),
        ("weld_weight", ""): model.body_invweight0[welded, 1].sum(1)[:, None],
        ("joined_weight", ""): ((joined >= 0)[:, :, None] * dof_weight[joined]).sum(1),
        ("bound", "weight"): jnp.concatenate(bound_weights),
    }


def _actuators(tables: Tables, model: Any) -> Entries:
    """Returns what actuators have, as ``actuators.fill``."""
    random = tables.random
    order = tables.actuator_order
    is_enabled = ~flags.disabled_actuators(tables.model)[:, None]
    is_affine = model.actuator_gaintype[:, None] == _C.mjtGain.mjGAIN_AFFINE
    has_bias = model.actuator_biastype[:, None] == _C.mjtBias.mjBIAS_AFFINE
    parts: Entries = {}
    if "actuator_gear" in random:
        parts["actuator", "gear"] = model.actuator_gear[order, :1]
    if "actuator_gainprm" in random:
        gain = is_enabled * model.actuator_gainprm[:, :3]
        parts["actuator", "gain"] = gain[order, :1]
        parts["actuator", "gain_by_length"] = (is_affine * gain[:, 1:])[order]
    if "actuator_biasprm" in random:
        parts["actuator", "bias"] = (is_enabled * has_bias * model.actuator_biasprm[:, :3])[order]
    return parts


class Layout:
    """Where a team has the tables that episodes draw, and which of their numbers.

    starts: of each table by its name, among the numbers of all
    base: of the model itself, all numbers
    places: of the numbers that are drawn, in the order of ``numbers``
    """

    def __init__(self, tables: Tables):
        """Finds them; the tables have these rows."""
        shapes = jax.eval_shape(lambda: entries(tables, {}))
        self.starts: dict[str, int] = {}
        self.base: list[float] = []
        self.places: list[int] = []
        for (name, field), part in sorted(shapes.items()):
            numbers = np.asarray(tables.reals[name], float).ravel()
            if name not in self.starts:
                self.starts[name] = len(self.base)
                self.base += numbers.tolist()
            rows, columns = part.shape
            first = records.column(name, field)
            spots = np.arange(len(numbers)).reshape(rows, -1)[:, first : first + columns]
            self.places += (self.starts[name] + spots).ravel().tolist()


def numbers(parts: Entries) -> jax.Array:
    """Returns the numbers of entries, in the order of ``Layout.places``."""
    real = jnp.result_type(float)
    empty = jnp.zeros(0, real)
    columns = [jnp.asarray(part, real).ravel() for _, part in sorted(parts.items())]
    return jnp.concatenate([empty, *columns])


def view(names: Iterable[str], layout: Layout) -> list[str]:
    """Returns the C++ of a model some of whose tables are in the state of a team.

    Args:
      names: of all members of the struct Fixed.
      layout: of the others.
    """
    members = [f"const decltype(Fixed::{name})& {name};" for name in names]
    values = [f"{name}(fixed.{name})" for name in names]
    for name, start in layout.starts.items():
        struct = records.STRUCTS.get(name, "real")
        members.append(f"const {struct}* {name};")
        values.append(f"{name}(reinterpret_cast<const {struct}*>(own.drawn + {start}))")
    return [
        f"struct alignas(4 * sizeof(real)) Drawn {{ real drawn[{len(layout.base)}]; }};",
        "struct Model {",
        *members,
        f"  DEV Model(const Fixed& fixed, const Drawn& own) : {', '.join(values)} {{}}",
        "};",
        "DEV Model model_of(const Fixed& fixed, Drawn& own, int lane) {",
        f"  EACH(i, {len(layout.base)}) own.drawn[i] = fixed.drawn_base[i];",
        "  return Model(fixed, own);",
        "}",
        "template <class P>",
        "DEV void draw(const Model& M, Drawn& own, const P* numbers, int lane) {",
        f"  EACH(n, {len(layout.places)}) own.drawn[M.drawn_place[n]] = numbers[n];",
        "}",
    ]


#: The C++ of a model that is the same in all episodes.
NO_VIEW = [
    "struct Drawn {};",
    "typedef Fixed Model;",
    "DEV const Model& model_of(const Fixed& fixed, Drawn&, int) { return fixed; }",
    "template <class P> DEV void draw(const Model&, Drawn&, const P*, int) {}",
]
