"""Tables of a model of MuJoCo, as C++ text, for the device code in which a team plays it.

A link is what one joint moves; its frame is turned as the body after that joint, and its origin is
the joint's anchor. A body without a joint belongs to the link that carries it, to the world, or to
a mocap body: bodies, geoms and anchors have fixed places in the frames of these.
"""

from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np

from mjx_reinforce.engine.base import MjModel
from mjx_reinforce.engine.physics import sensors
from mjx_reinforce.engine.physics.early_stop import stops_early
from mjx_reinforce.engine.scalar import UnsupportedPrimitive
from mjx_reinforce.engine.team import cables, draws, flags, hulls, last_pass, records, supported
from mjx_reinforce.engine.team.contact_kinds import (
    MIN_VALUE,
    ContactKind,
    contact_kind,
    softness_of,
)
from mjx_reinforce.engine.team.frames import Frame, Inertial, rotation, six, times
from mjx_reinforce.engine.team.records import Softness
from mjx_reinforce.engine.team.supported import (
    BALL,
    BOX,
    CAPSULE,
    CYLINDER,
    ELLIPSOID,
    FREE,
    HINGE,
    MESH,
    PLANE,
    SLIDE,
    SPHERE,
    why,
)

_C: Any = mujoco  # a C extension without stubs
#: The files of the device code, each after those that it uses. What the tables use is before them.
_PRELUDE = ["lanes", "records"]
_HEADERS = [
    "algebra",
    "state",
    "block",
    "kinematics",
    "impedance",
    "bounds",
    "draws",
    "cones",
    "cables",
    "contact_rows",
    "vectors",
    "passive",
    "dynamics",
    "rounds",
    "boxes",
    "cylinders",
    "hulls",
    "two_boxes",
    "support",
    "gjk",
    "epa",
    "faces",
    "convex",
    "collision",
    "equality",
    "elimination",
    "newton",
    "islands",
    "early_stop",
    "no_slip",
    "touch",
    "report",
    "free_bodies",
    "integrators",
    "scalar",
    "launch",
]
#: Contacts that the state of a team has room for; more go to memory.
NUM_NEAR = 8
#: How a degree of freedom moves what it carries, by ``device/kinematics.h``.
_TURNS, _SHIFTS, _SHIFTS_IN_THE_WORLD = range(3)
#: Geoms by the enum of ``device/rounds.h``.
_GEOM_KINDS = {PLANE: 0, SPHERE: 1, CAPSULE: 1, ELLIPSOID: 2, CYLINDER: 3, BOX: 4, MESH: 5}
_NO_LIMIT = 1e30


def physics_text(mj_model: MjModel, num_near: int = NUM_NEAR, random: Collection[str] = ()) -> str:
    """Returns the device code for a model.

    Args:
      mj_model: the model.
      num_near: contacts that the state of a team has room for.
      random: the names of its fields that differ from episode to episode.

    Raises:
      UnsupportedPrimitive: the device code lacks something that the model has; see ``why``.
    """
    if reason := why(mj_model, random):
        raise UnsupportedPrimitive(reason)
    device = Path(__file__).parent / "device"
    prelude, headers = (
        [(device / f"{name}.h").read_text("utf-8") for name in names]
        for names in (_PRELUDE, _HEADERS)
    )
    # One text, as NVRTC has no folders: nothing is included, and no file may come twice.
    text = "\n".join([*prelude, _Tables(mj_model, num_near, random).text(), *headers])
    return text.replace("#pragma once\n", "")


def far_words(mj_model: MjModel, num_near: int = NUM_NEAR, random: Collection[str] = ()) -> int:
    """Returns how many 4-byte words of memory the contacts need that a team has no room for."""
    sizes = _Tables(mj_model, num_near, random).constants
    # The Contact of state.h.
    contact_words = 13 + 5 * sizes["CD"] + sizes["ELLIPTIC"] + 5 * sizes["DRAWS_FRICTION"]
    words = max(0, int(sizes["NC"] - sizes["NEAR"])) * int(contact_words)
    return words + words % 2  # numbers of 8 bytes may follow


def drawn_numbers(
    mj_model: MjModel, random: Collection[str], fields: Mapping[str, Any]
) -> jax.Array:
    """Returns what an episode draws of the device code's tables [n], for ``draw`` of C++.

    Args:
      mj_model: the model.
      random: the names of its fields that differ from episode to episode.
      fields: these fields, and what MuJoCo derives of them, by their names in mjModel.
    """
    tables = _Tables(mj_model, NUM_NEAR, random)
    return draws.numbers(draws.entries(tables, tables.random, fields))


class _Tables:
    """The tables of one model.

    constants, real_constants: numbers that the compiler knows, such as sizes of arrays
    functions: tables that the compiler knows, for loops that it writes out
    ints, masks, reals: the arrays of the struct Model, which the lanes read
    soft: the rows of the softnesses that were met, with their numbers
    random: the names of fields that differ from episode to episode
    hulls: of the meshes that may meet something
    layout: of the tables that such fields change
    """

    def __init__(self, mj_model: MjModel, num_near: int, random: Collection[str]):
        """Makes them; see ``physics_text``."""
        model = flags.without_disabled(mj_model)
        self.model = model
        self.random = draws.effective(model, random)
        self.constants: dict[str, int] = {}
        self.real_constants: dict[str, float] = {}
        self.functions: dict[str, Iterable[int]] = {}
        self.ints: dict[str, Any] = {}
        self.masks: dict[str, Any] = {}
        self.reals: dict[str, Any] = {}
        self.soft: dict[Softness, int] = {}
        self.dof_joint = np.asarray(model.dof_jntid)
        self._links()
        self._bodies()
        self._dofs()
        self._compensation()
        self._medium()
        self._cables()
        self._actuators()
        self._equalities()
        self._cable_bounds()
        self._pairs(num_near)
        self._sensors()
        self._jumps()
        self._search()
        self.constants["NQ"] = model.nq
        self.constants["NV"] = model.nv
        self.constants["NL"] = model.njnt
        self.constants["NB"] = model.nbody
        self.constants["NU"] = max(model.nu, 1)
        self.constants["IMPLICIT"] = self._implicit()
        self.constants["MAY_SKIP"] = self._may_skip()
        is_passive = any(self.constants[x] for x in ("NCOMPENSATED", "TENDON_FORCES", "JOINT_LAWS"))
        self.constants["PASSIVE"] = int(is_passive)
        self.constants["RK4"] = int(model.opt.integrator == _C.mjtIntegrator.mjINT_RK4)
        self.constants["ELLIPTIC"] = self._is_elliptic()
        self.constants["ANY_POWER"] = int(any(x.power != 2 for x in self.soft))
        self.reals["soft"] = list(self.soft)
        self.reals["gravity"] = model.opt.gravity
        self.layout = draws.Layout(self, self.random)

    def text(self) -> str:
        """Returns the tables as C++."""
        lines = [f"constexpr int {name} = {int(x)};" for name, x in self.constants.items()]
        # Not constexpr: a constant of floats would be a symbol of the machine code.
        lines += [f"#define {name} real({x!r})" for name, x in self.real_constants.items()]
        mask = "unsigned long long" if self.model.nv > 32 else "unsigned"
        lines.append(f"typedef {mask} Mask;")
        for name, values in self.functions.items():
            table = ", ".join(str(int(x)) for x in values) or "0"
            lines.append(f"DEV constexpr int {name}(int i) {{")
            lines.append(f"  constexpr int table[] = {{{table}}};\n  return table[i];\n}}")
        lines += hulls.text(self.hulls)
        lines.append("struct Fixed {")
        lines.append("  real timestep, smallest_gain;")
        empty = []
        ints = self.ints
        reals = {name: x for name, x in self.reals.items() if name not in self.layout.starts}
        has_draws = bool(self.layout.places)
        if has_draws:
            ints = ints | {"drawn_place": self.layout.places}
            reals["drawn_base"] = self.layout.base
        names = ["timestep", "smallest_gain", *ints, *self.masks, *reals]
        # In float32 a step that lowers the cost by less is rounding; in float64 the search goes on
        # until no row changes. The cost of an elliptic cone that slides is not quadratic, and no
        # step is the last by itself: in float32 one of a tenth of C's tolerance is, in float64 one
        # whose square is rounding, as Newton's method squares what is left.
        single, double = (2e-9, 1e-20) if self._is_elliptic() else (1e-10, 0.0)
        scale = float(self.model.stat.meaninertia * self.model.nv)
        initial_values = [
            f"real({float(self.model.opt.timestep)!r})",
            f"SINGLE ? real({single * scale!r}) : real({double * scale!r})",
        ]
        for type_name, literal, arrays in (
            ("int", lambda x: f"{int(x):d}", ints),
            ("Mask", lambda x: f"{int(x):d}ull", self.masks),
            ("real", lambda x: f"real({float(x)!r})", reals),
        ):
            for name, values in arrays.items():
                entries = np.asarray(values).ravel().tolist()
                struct = records.STRUCTS.get(name, type_name)
                if not entries:
                    is_row = struct in records.FIELDS
                    empty.append(f"Some<{struct}, 0> {name};" if is_row else f"{struct} {name}[1];")
                    continue
                row_size = records.size(struct)
                lines.append(f"  {struct} {name}[{-(-len(entries) // row_size)}];")
                initial_values.append("{" + ",".join(map(literal, entries)) + "}")
        # C++ has no empty array: those that are share a place.
        lines += [f"  union {{ int none; {' '.join(empty)} }};", "};"]
        initial_values.append("{0}")
        lines += draws.view(names, self.layout, records.STRUCTS) if has_draws else draws.NO_VIEW
        lines += records.checks()
        lines.append("#define MODEL_INIT {" + ",\\\n".join(initial_values) + "}")
        return "\n".join(lines)

    def _search(self) -> None:
        """Makes the numbers of the constraint solver that are C's own."""
        model = self.model
        self.constants["STOPS_EARLY"] = stops_early(model)
        self.constants["STEPS"] = model.opt.iterations
        self.constants["LENGTHS"] = model.opt.ls_iterations
        self.constants["WARM"] = not flags.is_off(model, "warmstart")
        is_one = flags.is_off(model, "island")
        self.constants["ONE_ISLAND"] = is_one
        self.constants["NOSLIP"] = model.opt.noslip_iterations
        self.real_constants["NOSLIP_TOLERANCE"] = float(model.opt.noslip_tolerance)
        # The degrees of freedom of each tree, where C solves the trees that rows join apart.
        trees = np.asarray(model.dof_treeid)
        masks = [sum(1 << int(dof) for dof in np.flatnonzero(trees == x)) for x in sorted({*trees})]
        is_approximate = stops_early(model) or model.opt.noslip_iterations > 0
        has_islands = is_approximate and not is_one and len(masks) > 1
        self.constants["NTREES"] = len(masks) if has_islands else 1
        fixed_links = [0] * (1 + model.nmocap)
        links = [masks[trees[dof]] for dof in model.jnt_dofadr] + fixed_links
        self.masks["tree_dofs"] = masks if has_islands else []
        self.masks["link_tree"] = links if has_islands else []
        self.real_constants["TOLERANCE"] = float(model.opt.tolerance)
        self.real_constants["LENGTH_TOLERANCE"] = float(model.opt.ls_tolerance)
        self.real_constants["MEAN_TRACE"] = float(model.stat.meaninertia * model.nv)

    def _is_elliptic(self) -> bool:
        return self.model.opt.cone == _C.mjtCone.mjCONE_ELLIPTIC

    def _implicit(self) -> int:
        """Returns how damping is implicit: 0 not at all, 1 of joints, 2 of actuators, too."""
        opt = self.model.opt
        if opt.integrator == _C.mjtIntegrator.mjINT_IMPLICITFAST:
            return 2
        is_euler = opt.integrator == _C.mjtIntegrator.mjINT_EULER
        is_off = any(flags.is_off(self.model, x) for x in ("eulerdamp", "damper"))
        is_damped = self.damping.any() or "dof_damping" in self.random
        return int(is_euler and not is_off and (is_damped or self._solves_again()))

    def _solves_again(self) -> bool:
        """Returns whether C solves once more for the armature of an actuator (mj_EulerSkip).

        This only matters for a search that stops early.
        """
        return stops_early(self.model) and bool(np.any(self.model.jnt_actuatorid != -1))

    def _may_skip(self) -> bool:
        """Returns whether C does not solve once more in an episode that draws no damping."""
        is_drawn = stops_early(self.model) and "dof_damping" in self.random
        is_damped = bool(self.damping[:, 1:].any()) or self._solves_again()
        return self._implicit() == 1 and is_drawn and not is_damped

    def _records(self, name: str, order: Any = slice(None), **columns: np.ndarray) -> None:
        """Makes a table of structs from the columns of their fields, [rows] or [rows, numbers]."""
        field_sizes = records.FIELDS[records.STRUCTS[name]]
        assert {*columns} == {*field_sizes}
        rows = [columns[field].reshape(-1, count) for field, count in field_sizes.items()]
        self.reals[name] = np.hstack(rows)[order]

    def _link_number(self, link: int) -> int:
        """Returns the number of a ``Frame.link`` in the state: the world is behind the links."""
        return self.model.njnt - 1 - link if link < 0 else link

    def _links(self) -> None:
        """Makes the tables of links, and finds the frames of bodies."""
        model = self.model
        identity = np.eye(4)[0]
        self.frames = [Frame(-1, np.zeros(3), identity)]
        self.parents = []
        rows = []
        for body in range(1, model.nbody):
            parent = self.frames[model.body_parentid[body]]
            frame = parent.then(model.body_pos[body], model.body_quat[body])
            if model.body_mocapid[body] >= 0:
                frame = Frame(-2 - model.body_mocapid[body], np.zeros(3), identity)
            start = model.body_jntadr[body]
            # The joints of a body are a chain: each moves the frame of the next.
            for joint in range(start, start + model.body_jntnum[body]):
                kind = model.jnt_type[joint]
                axis = model.jnt_axis[joint]
                anchor = model.jnt_pos[joint]
                parent_link = frame.link
                if kind == FREE:  # qpos has its place in the world
                    anchor = np.zeros(3)
                    parent_link = -1
                # The pose is linear in these two: for a hinge at angle q, the quaternion is
                # cos(q/2) quat + sin(q/2) turned; for a slide, the place is at + q turned.
                axis_quat = times(frame.quat, [0, *axis])
                if kind == SLIDE:
                    axis_quat = [*(rotation(frame.quat) @ axis), 0]
                zero_qpos = 0
                if kind in (HINGE, SLIDE):
                    zero_qpos = model.qpos0[model.jnt_qposadr[joint]]
                rows.append((frame.place(anchor), frame.quat, axis_quat, zero_qpos))
                self.parents.append(parent_link)
                frame = Frame(joint, -np.asarray(anchor), identity)
            self.frames.append(frame)
        joint_kinds = model.jnt_type
        columns = ("link_at", "link_quat", "link_turned", "link_zero")
        self.reals |= zip(columns, zip(*rows, strict=True), strict=True)
        self.ints["link_kind"] = joint_kinds
        self.ints["link_qpos"] = model.jnt_qposadr
        self.ints["link_dof"] = model.jnt_dofadr
        self.functions["link_parent"] = self.parents
        self.functions["has_children"] = [int(x in self.parents) for x in range(model.njnt)]
        joints = np.flatnonzero(joint_kinds <= BALL)
        self.ints["turn_dof"] = model.jnt_dofadr[joints] + 3 * (joint_kinds[joints] == FREE)
        self.constants["NTURN"] = len(joints)
        # Where an episode does not say otherwise.
        mocap_bodies = np.flatnonzero(model.body_mocapid >= 0)
        self.constants["NMOCAP"] = model.nmocap
        self.reals["mocap_pos"] = model.body_pos[mocap_bodies]
        self.reals["mocap_quat"] = model.body_quat[mocap_bodies]

    def _bodies(self) -> None:
        """Makes the tables of bodies, and of the inertias of links."""
        model = self.model
        bodies = []
        for body in range(model.nbody):
            frame = self.frames[body].then(model.body_ipos[body], model.body_iquat[body])
            turn = rotation(frame.quat)
            bodies.append(Inertial(frame.pos, turn @ np.diag(model.body_inertia[body]) @ turn.T))
        self.ints["body_link"] = [self._link_number(x.link) for x in self.frames]
        self.ints["body_root"] = model.body_rootid
        self.reals["body_at"] = [x.pos for x in self.frames]
        self.reals["body_com"] = [x.com for x in bodies]
        self.reals["body_inertia"] = [six(x.inertia) for x in bodies]
        self.reals["body_mass"] = model.body_mass
        masses = []
        links = []
        for link in range(model.njnt):
            link_bodies = [x for x in range(model.nbody) if self.frames[x].link == link]
            mass = sum(model.body_mass[x] for x in link_bodies)
            # A link may carry nothing: that of the first of two hinges of one body.
            com = np.zeros(3)
            if link_bodies and mass != 0:
                mass_moments = (model.body_mass[x] * bodies[x].com for x in link_bodies)
                com = sum(mass_moments, start=np.zeros(3)) / max(mass, MIN_VALUE)
            inertia = np.zeros((3, 3))
            for x in link_bodies:  # the parallel axis theorem
                arm = bodies[x].com - com
                shift = arm @ arm * np.eye(3) - np.outer(arm, arm)
                inertia += bodies[x].inertia + model.body_mass[x] * shift
            masses.append(mass)
            links.append(Inertial(com, inertia))
        self.reals["link_mass"] = masses
        self.reals["link_com"] = [x.com for x in links]
        self.reals["link_inertia"] = [six(x.inertia) for x in links]

    def _compensation(self) -> None:
        """Makes the tables of what gravity compensation holds, a row a link."""
        model = self.model
        masses = model.body_mass * model.body_gravcomp
        weights: dict[int, np.ndarray] = {}
        is_held = model.body_gravcomp != 0
        if "body_mass" not in self.random:
            is_held &= model.body_mass != 0
        for body in np.flatnonzero(is_held):
            frame = self.frames[body]
            mass = masses[body]
            ipos = model.body_ipos[body]
            if frame.link >= 0:
                row = mass * np.array([*frame.place(ipos), 1])
                weights[frame.link] = weights.get(frame.link, 0) + row
        self.ints["compensated_link"] = list(weights)
        self.reals["compensated"] = list(weights.values())
        # Of these joints the actuators' force includes it; without an actuator there is none.
        acts = np.asarray(model.jnt_actgravcomp, bool)[self.dof_joint] & bool(weights)
        self.ints["dof_actuator_compensation"] = acts if weights else []
        self.constants["NCOMPENSATED"] = len(weights)
        has_actuators = model.nu > 0 and not flags.is_off(model, "actuation")
        self.constants["ACTUATOR_COMPENSATION"] = int(acts.any() and has_actuators)

    def _medium(self) -> None:
        """Makes the tables of what a medium does to bodies, in the order of their links."""
        model = self.model
        opt = model.opt
        links = np.array([self._link_number(x.link) for x in self.frames])
        is_resisted = (model.body_mass >= MIN_VALUE) | ("body_mass" in self.random)
        bodies = np.flatnonzero(is_resisted & (links < model.njnt))
        bodies = bodies[np.argsort(links[bodies], kind="stable")]
        has_medium = opt.density > 0 or opt.viscosity > 0
        self.constants["MEDIUM"] = int(has_medium)
        self.fluid_bodies = bodies if has_medium else bodies[:0]
        self.ints["link_fluid"] = []
        self.reals |= {"fluid_body": [], "wind": []}
        if not has_medium:
            return
        resistances = draws.fluid(np, model, bodies).values()
        turns = [
            rotation(self.frames[x].then(model.body_ipos[x], model.body_iquat[x]).quat).T
            for x in bodies
        ]
        places = [self.frames[x].place(model.body_ipos[x]) for x in bodies]
        turns = np.reshape(turns, (-1, 9))
        self.reals["fluid_body"] = np.hstack([np.array(places), turns, *resistances])
        self.ints["link_fluid"] = np.searchsorted(links[bodies], np.arange(model.njnt + 1))
        self.reals["wind"] = opt.wind

    def _dofs(self) -> None:
        """Makes the tables of degrees of freedom."""
        model = self.model
        joint = self.dof_joint
        joint_kind = model.jnt_type[joint]
        axis_index = np.arange(model.nv) - model.jnt_dofadr[joint]
        is_single = joint_kind >= SLIDE
        # A ball or a free joint moves along the axes of its own frame.
        axes = np.where(is_single[:, None], model.jnt_axis[joint], np.eye(3)[axis_index % 3])
        dof_kinds = np.full(model.nv, _TURNS)
        dof_kinds[joint_kind == SLIDE] = _SHIFTS
        # A free joint shifts by the axes of the world, and turns about those of the body.
        dof_kinds[(joint_kind == FREE) & (axis_index < 3)] = _SHIFTS_IN_THE_WORLD
        qpos = model.jnt_qposadr[joint]
        self.ints["dof_link"] = joint
        self.ints["dof_kind"] = dof_kinds
        self.ints["dof_qpos"] = qpos
        self.ints["dof_turns"] = ~is_single & ~(dof_kinds == _SHIFTS_IN_THE_WORLD)
        self.reals["dof_axis"] = axes
        joint_types = (_C.mjtTrn.mjTRN_JOINT, _C.mjtTrn.mjTRN_JOINTINPARENT)
        inherited = cables.of_actuators(model, joint_types, model.njnt)[joint]
        self.damping = np.column_stack([model.dof_damping, model.dof_dampingpoly])
        self.damping += inherited[:, 1:]
        self.reals["dof_damping"] = self.damping[:, 0]
        self.reals["dof_armature"] = model.dof_armature + inherited[:, 0]
        self.reals["dof_stiffness"] = np.where(is_single, model.jnt_stiffness[joint], 0)
        # Beyond these: higher powers, and the springs of free and ball joints.
        laws = np.column_stack([model.jnt_stiffness, model.jnt_stiffnesspoly])[joint]
        laws = np.hstack([laws, self.damping])
        laws[is_single, 0] = laws[:, 3] = 0
        has_laws = laws.any() or ("jnt_stiffness" in self.random and not is_single.all())
        self.constants["JOINT_LAWS"] = int(has_laws)
        self.reals["dof_law"] = laws if has_laws else []
        self.reals["rest"] = model.qpos_spring if has_laws else []
        self.reals["dof_spring"] = model.qpos_spring[qpos]
        self.reals["dof_zero"] = model.qpos0[qpos]
        # Free bodies without others in their tree, which implicitfast turns in a way of its own.
        is_alone = np.bincount(model.dof_treeid, minlength=1)[model.dof_treeid] == 6
        is_lone = (model.jnt_type == FREE) & is_alone[model.jnt_dofadr]
        free_links = np.flatnonzero(is_lone) if self._implicit() == 2 else []
        self.ints["free_link"] = free_links
        self.constants["NFREE"] = len(free_links)
        self.functions["dof_parent"] = model.dof_parentid
        self.functions["last_of_link"] = np.where(np.diff(joint, append=-1), joint, -1)
        self._chains(dof_kinds)
        self._bounds(is_single)

    def _chains(self, dof_kinds: np.ndarray) -> None:
        """Makes the tables of which degrees of freedom move a link, and which meet in M."""
        model = self.model
        # None moves the world and mocap bodies, the last.
        link_chains = [[] for _ in range(model.njnt + 1 + model.nmocap)]
        dof_pairs = []
        for i in range(model.nv):
            chain = []
            j = i
            while j >= 0:
                chain.append(j)
                # The three shifts of a free body are orthogonal: their entries of M are zero.
                is_shift_pair = dof_kinds[i] == dof_kinds[j] == _SHIFTS_IN_THE_WORLD
                if j < i and not is_shift_pair:
                    dof_pairs.append(records.packed(j, i))
                j = int(model.dof_parentid[j])  # NumPy's would overflow in a mask
            # The last degree of freedom of a link has the longest chain, and overwrites the others.
            link_chains[self.dof_joint[i]] = chain
        self.ints["paired"] = dof_pairs
        self.constants["NPAIRED"] = len(dof_pairs)
        self.masks["link_dofs"] = [sum(1 << x for x in chain) for chain in link_chains]

    def _bounds(self, is_single: np.ndarray) -> None:
        """Makes the tables of limits and friction loss."""
        model = self.model
        joint = self.dof_joint
        is_limited = np.asarray(model.jnt_limited, bool)[joint] & is_single
        span = np.diff(model.jnt_range[joint]).ravel()
        # Both limits of a joint push at once only where their margins overlap.
        overlap = is_limited & (span < 2 * model.jnt_margin[joint])
        self.constants["LIMITS"] = int(is_limited.any()) + int(overlap.any())
        self.constants["LOSSES"] = int(np.any(model.dof_frictionloss))
        self.ints["dof_limited"] = is_limited
        self._records(
            "dof_limit",
            range=model.jnt_range[joint],
            margin=model.jnt_margin[joint],
            weight=model.dof_invweight0,
        )
        self.ints["dof_limit_soft"] = self._softs(
            model.jnt_solref[joint], model.jnt_solimp[joint], is_limited
        )
        self._records("dof_loss", most=model.dof_frictionloss, weight=model.dof_invweight0)
        self.ints["dof_loss_soft"] = self._softs(
            model.dof_solref, model.dof_solimp, model.dof_frictionloss
        )

    def _softs(self, solrefs: np.ndarray, solimps: np.ndarray, row_mask: np.ndarray) -> list[int]:
        """Returns ``_soft`` of each row that is present, 0 for the others."""
        rows = zip(solrefs, solimps, row_mask, strict=True)
        return [self._soft(ref, imp) if is_present else 0 for ref, imp, is_present in rows]

    def _soft(self, solref: np.ndarray, solimp: np.ndarray) -> int:
        """Returns the number of the softness of rows with these parameters."""
        return self._number(softness_of(self.model, solref, solimp))

    def _number(self, softness: Softness) -> int:
        """Returns the number of a softness, a new one where it was not met before."""
        return self.soft.setdefault(softness, len(self.soft))

    def _cables(self) -> None:
        """Makes the tables of cables."""
        model = self.model
        self.cables = cables.of_model(model, self.frames, self.parents, self.reals["link_quat"])
        parts = [part for cable in self.cables for part in cable.parts]
        self.ints["cable_part"] = np.cumsum([0, *(len(x.parts) for x in self.cables)])
        self.ints["part_kind"] = [x.kind for x in parts]
        self.ints["part_on"] = [self._link_number(x.on) for x in parts]
        self.ints["part_off"] = [self._link_number(x.off) for x in parts]
        self.ints["part_body"] = [x.bodies for x in parts]
        self.constants["SEGMENTS"] = int(any(x.kind == cables.SEGMENT for x in parts))
        self.ints["part_frame"] = [self._link_number(x.frame) for x in parts]
        self.reals["part"] = [(*x.at, *x.gear) for x in parts]
        tendons = [cables.spring(model, x.tendon) for x in self.cables]
        is_tense = any(any(x[:6]) for x in tendons)
        self.constants["TENDON_FORCES"] = int(is_tense)
        self.reals["tendon"] = tendons if is_tense else []
        self.constants["NCABLE"] = len(self.cables)

    def _cable_bounds(self) -> None:
        """Makes the tables of limits and, behind them, of friction loss of cables."""
        limits, losses = cables.bounds(self.model, self.cables)
        rows = [*limits, *losses]
        self.ints["bound_cable"] = [x.cable for x in rows]
        self.ints["bound_soft"] = [self._soft(*x.soft) for x in rows]
        self.ints["bound_sides"] = [x.sides for x in limits]
        self.reals["bound"] = [x.limit for x in rows]
        self.reals["bound_loss"] = [x.loss for x in losses]
        self.constants["NLIMITED"] = len(limits)
        self.constants["NLOSS"] = len(losses)
        self.constants["NE"] += len(rows)

    def _targets(self) -> np.ndarray:
        """Returns what actuators drive: a degree of freedom, or the number of a cable after all."""
        model = self.model
        of_tendons = {x.tendon: n for n, x in enumerate(self.cables)}
        of_actuators = {x.actuator: n for n, x in enumerate(self.cables)}
        targets = []
        for actuator, (number, _) in enumerate(model.actuator_trnid):
            if actuator in of_actuators:
                targets.append(model.nv + of_actuators[actuator])
            elif model.actuator_trntype[actuator] == _C.mjtTrn.mjTRN_TENDON:
                targets.append(model.nv + of_tendons[number])
            else:
                targets.append(model.jnt_dofadr[number])
        return np.array(targets, int)

    def _actuators(self) -> None:
        """Makes the tables of actuators, in the order of the degrees of freedom that they move."""
        model = self.model
        targets = self._targets()
        gear = model.actuator_gear[:, 0].copy()
        # The moments of an actuator's own cable have its gear.
        gear[[x.actuator for x in self.cables if x.actuator >= 0]] = 1
        order = np.argsort(targets, kind="stable")
        self.actuator_order = order
        no_range = (-_NO_LIMIT, _NO_LIMIT)
        controls = np.where(model.actuator_ctrllimited[:, None], model.actuator_ctrlrange, no_range)
        forces = np.where(model.actuator_forcelimited[:, None], model.actuator_forcerange, no_range)
        gain = model.actuator_gainprm[:, :3].copy()
        bias = model.actuator_biasprm[:, :3].copy()
        # All are affine here: what MuJoCo does not read of the others is zero.
        gain[model.actuator_gaintype == _C.mjtGain.mjGAIN_FIXED, 1:] = 0
        bias[model.actuator_biastype == _C.mjtBias.mjBIAS_NONE] = 0
        self._records(
            "actuator",
            order,
            gear=gear,
            control_low=controls[:, 0],
            control_high=controls[:, 1],
            gain=gain[:, 0],
            bias=bias[:, 0],
            bias_by_length=bias[:, 1],
            bias_by_speed=bias[:, 2],
            force_low=forces[:, 0],
            force_high=forces[:, 1],
            gain_by_length=gain[:, 1],
            gain_by_speed=gain[:, 2],
        )
        self.ints["actuator_ctrl"] = model.actuator_ctrladr[order]
        # Those of a degree of freedom or a cable are from its entry up to the next one's.
        counts = np.arange(model.nv + len(self.cables) + 1)
        self.ints["target_actuator"] = np.searchsorted(targets[order], counts)
        joint = self.dof_joint
        is_limited = model.jnt_actfrclimited[joint, None]
        bounds = np.where(is_limited, model.jnt_actfrcrange[joint], no_range)
        self._records("dof_force", low=bounds[:, 0], high=bounds[:, 1])

    def _equalities(self) -> None:
        """Makes the tables of equality constraints."""
        model = self.model
        eq_kinds = np.where(model.eq_active0, model.eq_type, -1)
        weld_eqs = np.flatnonzero(eq_kinds == _C.mjtEq.mjEQ_WELD)
        connect_eqs = np.flatnonzero(eq_kinds == _C.mjtEq.mjEQ_CONNECT)
        connect_eqs = np.concatenate([connect_eqs, weld_eqs])
        joint_eqs = np.flatnonzero(eq_kinds == _C.mjtEq.mjEQ_JOINT)
        self.constants["NCONNECT"] = len(connect_eqs)
        self.constants["NWELD"] = len(weld_eqs)
        self.constants["NE"] = 3 * len(connect_eqs) + 3 * len(weld_eqs) + len(joint_eqs)
        links = []
        turns = []
        places = []
        bodies = []
        for equality in connect_eqs:
            ends = (model.eq_obj1id[equality], model.eq_obj2id[equality])
            anchors = model.eq_data[equality, :6].reshape(2, 3)
            # A weld has them the other way around, and a relative pose.
            is_weld = model.eq_type[equality] == _C.mjtEq.mjEQ_WELD
            quats = np.array([model.eq_data[equality, 6:10], [1, 0, 0, 0]])
            if is_weld:
                anchors = anchors[::-1]
            # Between sites there are no anchors in eq_data: the sites are.
            if model.eq_objtype[equality] == _C.mjtObj.mjOBJ_SITE:
                anchors = model.site_pos[list(ends)]
                quats = model.site_quat[list(ends)]
                ends = model.site_bodyid[list(ends)]
            frames = [self.frames[body] for body in ends]
            bodies.append([int(body) for body in ends])
            links.append([self._link_number(frame.link) for frame in frames])
            places.append([frame.place(x) for frame, x in zip(frames, anchors, strict=True)])
            if is_weld:
                ends_quats = [times(x.quat, quat) for x, quat in zip(frames, quats, strict=True)]
                turns.append([rotation(quat) for quat in ends_quats])
        self.ints["connect_link"] = links
        self.ints["connect_body"] = bodies
        self.reals["connect_at"] = places
        self.reals["connect_weight"] = [model.body_invweight0[x, 0].sum() for x in bodies]
        weld_bodies = bodies[len(bodies) - len(weld_eqs) :]
        self.reals["weld_turn"] = turns
        self.reals["weld_scale"] = model.eq_data[weld_eqs, 10]
        self.reals["weld_weight"] = [model.body_invweight0[x, 1].sum() for x in weld_bodies]
        self.ints["connect_soft"] = self._equality_softs(connect_eqs)
        # A joint alone is held at a value: its second is -1.
        joints = np.stack([model.eq_obj1id[joint_eqs], model.eq_obj2id[joint_eqs]], 1)
        dofs = np.where(joints >= 0, model.jnt_dofadr[joints], -1)
        self.ints["joined_dof"] = dofs
        self.ints["joined_soft"] = self._equality_softs(joint_eqs)
        self.reals["joined_poly"] = model.eq_data[joint_eqs, :5]
        self.reals["joined_weight"] = [
            sum(model.dof_invweight0[dof] for dof in pair if dof >= 0) for pair in dofs
        ]

    def _equality_softs(self, equalities: np.ndarray) -> list[int]:
        """Returns ``_soft`` of equality constraints."""
        model = self.model
        return [self._soft(model.eq_solref[n], model.eq_solimp[n]) for n in equalities]

    def _jumps(self) -> None:
        """Makes the table by which poses of links are joined to those of the world."""
        # After a round, a link's pose is in the frame of an ancestor twice as far up as before:
        # log2(depth) rounds, where going down the tree takes as many as the tree is deep.
        ancestors = list(self.parents)
        jumps = []
        starts = [0]
        while any(x != -1 for x in ancestors):
            for row in range(3):
                jumps += [
                    records.packed(3 * link + row, 3 * self._link_number(ancestor) + row)
                    for link, ancestor in enumerate(ancestors)
                    if ancestor != -1
                ]
            starts.append(len(jumps))
            ancestors = [ancestors[x] if x >= 0 else -1 for x in ancestors]
        self.ints["jump"] = jumps
        self.functions["jump_start"] = starts
        self.constants["ROUNDS"] = len(starts) - 1

    def _pairs(self, num_near: int) -> None:
        """Makes the tables of geoms that may meet."""
        model = self.model
        pairs = [(pair, contact_kind(model, pair)) for pair in supported.meeting(model)]
        geoms = sorted({geom for pair, _ in pairs for geom in (pair.geom1, pair.geom2)})
        geom_ids = {geom: number for number, geom in enumerate(geoms)}
        # Contacts whose friction an episode draws also have in common which geom's it is.
        has_friction = "geom_friction" in self.random
        kind_numbers: dict[tuple[ContactKind, int], int] = {}
        kind_pairs = 0
        num_contacts = 0
        # Where parts are many, their table leaves little shared memory, and going through it takes
        # long.
        is_whole = supported.num_parts(model) > supported.MAX_ITEMS
        items = []
        item_kinds = []
        weights = []
        for pair, kind in pairs:
            mix = draws.mix(model, pair) if has_friction else draws.Mix.LARGER
            number = kind_numbers.setdefault((kind, mix), len(kind_numbers))
            bodies = model.geom_bodyid[[pair.geom1, pair.geom2]]
            weight = sum(model.body_invweight0[body, 0] for body in bodies)
            if kind.dim > 1 and not self._is_elliptic():
                # Of an edge of the pyramid, which pushes along a tangent, too.
                friction = kind.friction[0]
                weight *= 2 * friction**2 / model.opt.impratio * (1 + friction**2)
            geom_types = supported.geom_kinds(model, pair)
            flat, other = (_GEOM_KINDS[x] for x in geom_types)
            kind_pairs |= 1 << (other * (other + 1) // 2 + flat)
            # The convex collider finds all contacts of a pair at once.
            num_parts = supported.NUM_PARTS.get(geom_types, 1)
            num_contacts += supported.CONVEX_CONTACTS.get(geom_types, num_parts)
            for part in [num_parts - 1] if is_whole else range(num_parts):
                items.append(records.packed_item(geom_ids[pair.geom1], geom_ids[pair.geom2], part))
                item_kinds.append(number)
                weights.append(weight)
        self.ints["item"] = items
        self.ints["item_kind"] = item_kinds
        has_weights = has_friction or bool(draws.INERTIAL.intersection(self.random))
        self.constants["DRAWS_FRICTION"] = int(has_friction)
        self.constants["DRAWS_WEIGHTS"] = int(has_weights)
        self.real_constants["CONE_SCALE"] = float(max(model.opt.impratio, MIN_VALUE) ** -0.5)
        self.reals["item_weight"] = [] if has_weights else weights
        self.reals["body_weight"] = model.body_invweight0[:, 0] if has_weights else []
        self.reals["geom_friction"] = model.geom_friction[geoms] if has_friction else []
        self.ints["kind_mix"] = [mix for _, mix in kind_numbers] if has_friction else []
        self.geoms = np.array(geoms, int)
        kinds = [kind for kind, _ in kind_numbers]
        self._kinds(kinds)
        self.constants["KIND_PAIRS"] = kind_pairs
        self.constants["NI"] = len(items)
        self.constants["WHOLE_PAIRS"] = int(is_whole)
        self.constants["NC"] = num_contacts
        self.constants["NEAR"] = max(1, min(num_near, num_contacts))
        self._convex([pair for pair, _ in pairs], kinds)
        self.constants["CD"] = max((x.dim for x in kinds), default=1)
        self.constants["NG"] = max(len(geoms), 1)
        self._geoms(self.geoms)

    def _kinds(self, kinds: list[ContactKind]) -> None:
        """Makes the tables of what contacts of several pairs have in common."""
        self.ints["kind_dim"] = [x.dim for x in kinds]
        self.ints["kind_soft"] = [self._number(x.softness) for x in kinds]
        self.reals["kind_margin"] = [x.margin for x in kinds]
        self.reals["kind_friction"] = [x.friction for x in kinds]
        self.reals["kind_mu"] = []
        self.ints["kind_soft_friction"] = []
        if self._is_elliptic():
            # C's regularized friction of the cone.
            root = np.sqrt(max(self.model.opt.impratio, MIN_VALUE))
            self.reals["kind_mu"] = [x.friction[0] / root for x in kinds]
            self.ints["kind_soft_friction"] = [self._number(x.friction_softness) for x in kinds]

    def _convex(self, pairs: Iterable[supported.GeomPair], kinds: Iterable[ContactKind]) -> None:
        """Makes the tables of the convex collider."""
        model = self.model
        all_types = [supported.geom_kinds(model, x) for x in pairs]
        convex_types = [x for x in all_types if x in supported.CONVEX_CONTACTS]
        num_contacts = [supported.CONVEX_CONTACTS[x] for x in convex_types]
        geom_kinds = {_GEOM_KINDS[x] for types in convex_types for x in types}
        self.constants["CONVEX_KINDS"] = sum(1 << x for x in geom_kinds)
        self.constants["CONVEX_CONTACTS"] = max(num_contacts, default=0)
        self.constants["MORE_CONTACTS"] = not flags.is_off(model, "multiccd")
        self.constants["CONVEX_STEPS"] = model.opt.ccd_iterations
        self.real_constants["CONVEX_TOLERANCE"] = float(model.opt.ccd_tolerance)
        self.reals["kind_gap"] = [x.gap for x in kinds] if convex_types else []

    def _geoms(self, geoms: np.ndarray) -> None:
        """Makes the tables of the geoms that may meet."""
        model = self.model
        bodies = model.geom_bodyid[geoms]
        frames = [
            self.frames[body].then(model.geom_pos[geom], model.geom_quat[geom])
            for geom, body in zip(geoms, bodies, strict=True)
        ]
        types = model.geom_type[geoms]
        size = model.geom_size[geoms]
        has_radius = np.isin(types, (SPHERE, CAPSULE, CYLINDER))
        has_length = np.isin(types, (CAPSULE, CYLINDER))
        turns = [rotation(frame.quat) for frame in frames]
        self.ints["geom_kind"] = [_GEOM_KINDS[x] for x in types]
        self.ints["geom_body"] = bodies
        self.ints["geom_link"] = [self._link_number(frame.link) for frame in frames]
        self.reals["geom_at"] = [frame.pos for frame in frames]
        self.reals["geom_axis"] = [turn[:, 2] for turn in turns]
        self.reals["geom_radius"] = np.where(has_radius, size[:, 0], 0)
        self.reals["geom_half"] = np.where(has_length, size[:, 1], 0)
        self.reals["geom_reach"] = model.geom_rbound[geoms]
        # Shared memory is scarce: what has no turn about the axis needs neither that nor sizes.
        has_size = np.isin(types, (BOX, CYLINDER, ELLIPSOID)).any()
        has_meshes = MESH in types
        self.reals["geom_turn"] = turns if has_size or has_meshes else []
        self.reals["geom_size"] = size if has_size else []
        has_convex = self.constants["CONVEX_CONTACTS"] > 0
        self.reals["geom_box"] = model.geom_aabb[geoms] if has_convex else []
        self.hulls = hulls.of_geoms(model, geoms)
        meshes = model.geom_dataid[geoms]
        numbers = [self.hulls.numbers.get(int(x), -1) for x in meshes]
        self.ints["geom_hull"] = numbers if has_meshes else []
        # Of a box, and of the polygon that a cylinder's end is.
        self.constants["CONVEX_SIDES"] = max(16, *(x for _, x in self.hulls.face_corners), 0)
        self.constants["CONVEX_DEGREE"] = max(3, hulls.degree(self.hulls))

    def _sensors(self) -> None:
        """Makes the tables of sensors of touch."""
        model = self.model
        is_of_forces = np.isin(model.sensor_type, sensors.BODY_TYPES)
        self.constants["SENSES_FORCES"] = int(is_of_forces.any())
        sites = model.sensor_objid[last_pass.touch_sensors(model)]
        self.constants["NTOUCH"] = len(sites)
        if not len(sites):
            return
        bodies = model.site_bodyid[sites]
        frames = [
            self.frames[body].then(model.site_pos[site], model.site_quat[site])
            for site, body in zip(sites, bodies, strict=True)
        ]
        size = model.site_size[sites]
        is_sphere = model.site_type[sites] == SPHERE
        is_cylinder = model.site_type[sites] == CYLINDER
        size[is_sphere] = size[is_sphere, :1]
        size[is_cylinder] = size[is_cylinder][:, [0, 0, 1]]
        self.ints["touch_body"] = bodies
        self.ints["touch_link"] = [self._link_number(frame.link) for frame in frames]
        self.ints["touch_round"] = [last_pass.ROUND_AXES[x] for x in model.site_type[sites]]
        self.reals["touch_at"] = [frame.pos for frame in frames]
        self.reals["touch_turn"] = [rotation(frame.quat) for frame in frames]
        self.reals["touch_size"] = size
