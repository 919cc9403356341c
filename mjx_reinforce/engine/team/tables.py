"""Tables of a model of MuJoCo, as C++ text, for the device code in which a team plays it.

A link is what one joint moves; its frame is turned as the body after that joint, and its origin is
the joint's anchor. A body without a joint belongs to the link that carries it: bodies, geoms and
anchors have fixed places in the frames of links.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np

from mjx_reinforce.engine.base import MjModel
from mjx_reinforce.engine.physics.early_stop import stops_early
from mjx_reinforce.engine.physics.mjx_internals import geom_pairs
from mjx_reinforce.engine.scalar import UnsupportedPrimitive

_C: Any = mujoco  # a C extension without stubs
_GEOM, _EQUALITY = _C.mjtGeom, _C.mjtEq
_FREE, _BALL, _SLIDE, _HINGE = range(4)  # MuJoCo's mjtJoint
_FILES = (
    *("algebra", "state", "block", "kinematics", "dynamics", "impedance", "bounds", "contact_rows"),
    *("rounds", "boxes", "collision", "equality", "elimination", "newton", "report"),
    *("integrators", "scalar", "launch"),
)
#: Contacts that the state of a team has room for; more go to memory.
NEAR = 8
_MOST_DOFS, _MOST_GEOMS, _MOST_ITEMS = 64, 4096, 4096
_PLANE, _SPHERE, _CAPSULE, _BOX = (
    int(getattr(_GEOM, f"mjGEOM_{name}")) for name in ("PLANE", "SPHERE", "CAPSULE", "BOX")
)
#: How many contacts two geoms of these types may have.
_PARTS = dict.fromkeys(
    ((_PLANE, _SPHERE), (_SPHERE, _SPHERE), (_SPHERE, _CAPSULE), (_SPHERE, _BOX)), 1
)
_PARTS |= {(_CAPSULE, _CAPSULE): 1, (_PLANE, _CAPSULE): 2, (_CAPSULE, _BOX): 2, (_PLANE, _BOX): 4}
#: MuJoCo's mjMINVAL, mjMINIMP and mjMAXIMP.
_TINY, _LEAST, _MOST = 1e-15, 1e-4, 1 - 1e-4
_NO_LIMIT = 1e30


class _Frame(NamedTuple):
    """A place in the frame of a link.

    link: -1 is the world
    at: [3] (m)
    quat: [4]
    """

    link: int
    at: np.ndarray
    quat: np.ndarray

    def place(self, at: Any) -> np.ndarray:
        """Returns a point [3] of this frame in the link's."""
        return self.at + _rotation(self.quat) @ np.asarray(at)

    def then(self, at: Any, quat: Any) -> "_Frame":
        """Returns a frame that has this pose in this one."""
        return _Frame(self.link, self.place(at), _times(self.quat, quat))


def physics_text(mj_model: MjModel, near: int = NEAR) -> str:
    """Returns the device code for a model.

    Args:
      mj_model: the model.
      near: contacts that the state of a team has room for.

    Raises:
      UnsupportedPrimitive: the device code lacks something that the model has; see ``why``.
    """
    m: Any = mj_model
    if reason := why(m):
        raise UnsupportedPrimitive(reason)
    device = Path(__file__).parent / "device"
    parts = [(device / f"{name}.h").read_text("utf-8") for name in _FILES]
    first = (device / "lanes.h").read_text("utf-8")
    return "\n".join([first, _Tables(m, near).text(), *parts]).replace("#pragma once\n", "")


def far_words(mj_model: MjModel, near: int = NEAR) -> int:
    """Returns how many 4-byte words of memory the contacts need that a team has no room for."""
    sizes = _Tables(mj_model, near).constants
    a_contact = 13 + 5 * sizes["CD"]  # the Contact of state.h
    words = max(0, int(sizes["NI"] - sizes["NEAR"])) * int(a_contact)
    return words + words % 2  # numbers of 8 bytes may follow


def why(mj_model: MjModel) -> str | None:
    """Returns in one line why teams cannot play a model, or None if they can."""
    m: Any = mj_model
    for lacking in (_lacking_options, _lacking_parts, _lacking_actuators, _lacking_contacts):
        for what, found in lacking(m):
            if found:
                return f"the model has {what}, which teams of lanes do not play"
    return None


def _lacking_options(m: Any) -> Iterable[tuple[str, Any]]:
    """Yields what of a model's options the device code lacks, and whether the model has it."""
    opt, kinds = m.opt, _C.mjtIntegrator
    known = (kinds.mjINT_EULER, kinds.mjINT_RK4, kinds.mjINT_IMPLICITFAST)
    yield "an integrator other than Euler, RK4 and implicitfast", opt.integrator not in known
    yield "a solver other than Newton", opt.solver != _C.mjtSolver.mjSOL_NEWTON
    few = f"few iterations of its solver ({opt.iterations}, {opt.ls_iterations} along a line)"
    yield few, stops_early(m)
    yield "elliptic friction cones", opt.cone != _C.mjtCone.mjCONE_PYRAMIDAL
    flags = opt.disableflags | opt.enableflags | opt.disableactuator
    yield "flags that disable or enable parts of the physics", flags
    yield "noslip iterations", opt.noslip_iterations
    yield "a medium with density or viscosity", opt.density or opt.viscosity


def _lacking_parts(m: Any) -> Iterable[tuple[str, Any]]:
    """Yields what of bodies and constraints the device code lacks, and whether a model has it."""
    hinged = np.isin(m.jnt_type, (_HINGE, _SLIDE))
    yield "no joints", not m.njnt
    yield f"more than {_MOST_DOFS} degrees of freedom", m.nv > _MOST_DOFS
    yield f"{_MOST_GEOMS} geoms or more", m.ngeom >= _MOST_GEOMS
    yield "flexes or plugins", m.nflex or m.nplugin
    yield "mocap bodies", m.nmocap
    yield "gravity compensation", np.any(m.body_gravcomp)
    tendons = (m.tendon_stiffness, m.tendon_damping, m.tendon_frictionloss, m.tendon_limited)
    yield "tendons that push", any(np.any(x) for x in (*tendons, m.tendon_armature))
    polynomials = (m.jnt_stiffnesspoly, m.dof_dampingpoly, m.jnt_springyield)
    yield "polynomial springs or damping", any(np.any(x) for x in polynomials)
    yield "springs of free or ball joints", np.any(m.jnt_stiffness[~hinged])
    yield "limits of ball joints", np.any(m.jnt_limited[~hinged])
    alone = np.bincount(m.dof_treeid, minlength=1) == 6
    free = m.jnt_dofadr[m.jnt_type == _FREE]
    fast = m.opt.integrator == _C.mjtIntegrator.mjINT_IMPLICITFAST
    yield "lone free bodies under implicitfast", fast and np.any(alone[m.dof_treeid[free]])
    active = m.eq_type[np.asarray(m.eq_active0, bool)]
    known = (_EQUALITY.mjEQ_CONNECT, _EQUALITY.mjEQ_JOINT)
    yield "equalities other than connect and joint", not np.isin(active, known).all()


def _lacking_actuators(m: Any) -> Iterable[tuple[str, Any]]:
    """Yields what of actuators the device code lacks, and whether a model has it."""
    of_joints = m.actuator_trntype == _C.mjtTrn.mjTRN_JOINT
    yield "actuators of anything but joints", not of_joints.all()
    one = np.isin(m.jnt_type[m.actuator_trnid[of_joints, 0]], (_HINGE, _SLIDE))
    yield "actuators of free or ball joints", not one.all()
    gains = np.isin(m.actuator_gaintype, (_C.mjtGain.mjGAIN_FIXED, _C.mjtGain.mjGAIN_AFFINE))
    biases = np.isin(m.actuator_biastype, (_C.mjtBias.mjBIAS_NONE, _C.mjtBias.mjBIAS_AFFINE))
    yield "gains or biases other than fixed and affine", not (gains.all() and biases.all())
    yield "activations of actuators", m.na
    own = (m.actuator_armature, m.actuator_damping, m.actuator_dampingpoly)
    yield "actuators with armature or damping", any(np.any(x) for x in own)
    yield "delays of actuators", np.any(m.actuator_delay)
    yield "actuators of several controls", np.any(m.actuator_ctrlnum != 1)


def _lacking_contacts(m: Any) -> Iterable[tuple[str, Any]]:
    """Yields what of contacts the device code lacks, and whether a model has it."""
    sticks = (m.geom_adhesion, m.geom_surfacevel, m.pair_adhesion)
    yield "adhesion or moving surfaces", any(np.any(x) for x in sticks)
    items = 0
    for a, b, _ in _meeting(m):
        kinds = _kinds(m, a, b)
        names = [_GEOM(x).name.removeprefix("mjGEOM_").lower() for x in kinds]
        yield f"a {names[1]} that meets a {names[0]}", kinds not in _PARTS
        items += _PARTS[kinds]
    yield f"more than {_MOST_ITEMS} possible contacts", items > _MOST_ITEMS


def _kinds(m: Any, a: int, b: int) -> tuple[int, int]:
    """Returns MuJoCo's types of two geoms."""
    return int(m.geom_type[a]), int(m.geom_type[b])


def _meeting(m: Any) -> list[tuple[int, ...]]:
    """Returns the pairs of geoms that may meet, the flatter first, those of C's own choice first.

    The third number is that of the pair that the model names, -1 for the others.
    """
    pairs = ((int(n), *sorted((int(g), int(h)))) for g, h, n in geom_pairs(m))
    return [(*sorted(x, key=m.geom_type.__getitem__), n) for n, *x in sorted(pairs)]


def _times(a: Any, b: Any) -> np.ndarray:
    """Returns the product of two quaternions [4]."""
    product = np.zeros(4)
    _C.mju_mulQuat(product, np.asarray(a, float), np.asarray(b, float))
    return product


def _rotation(quat: Any) -> np.ndarray:
    """Returns the rotation matrix [3, 3] of a quaternion."""
    matrix = np.zeros(9)
    _C.mju_quat2Mat(matrix, np.asarray(quat, float))
    return matrix.reshape(3, 3)


def _six(matrix: np.ndarray) -> list[float]:
    """Returns a symmetric matrix [3, 3] as xx, yy, zz, xy, xz, yz."""
    return [matrix[i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]


class _Tables:
    """The tables of one model."""

    def __init__(self, m: Any, near: int):
        """Makes them; see ``physics_text``."""
        self.m = m
        self.constants: dict[str, int] = {}
        self.functions: dict[str, Iterable[int]] = {}
        self.ints: dict[str, Any] = {}
        self.masks: dict[str, Any] = {}
        self.reals: dict[str, Any] = {}
        self.soft: dict[tuple[float, ...], int] = {}
        self.dof_joint = np.asarray(m.dof_jntid)
        self._links()
        self._bodies()
        self._dofs()
        self._actuators()
        self._equalities()
        self._pairs(near)
        self._jumps()
        implicit = int(m.opt.integrator == _C.mjtIntegrator.mjINT_EULER and m.dof_damping.any())
        if m.opt.integrator == _C.mjtIntegrator.mjINT_IMPLICITFAST:
            implicit = 2
        rk4 = int(m.opt.integrator == _C.mjtIntegrator.mjINT_RK4)
        self.constants |= {"NQ": m.nq, "NV": m.nv, "NL": m.njnt, "NB": m.nbody, "NU": max(m.nu, 1)}
        self.constants |= {"IMPLICIT": implicit, "RK4": rk4}
        self.constants["ANY_POWER"] = int(any(x[6] != 2 for x in self.soft))
        self.reals["soft"] = list(self.soft)
        self.reals["gravity"] = m.opt.gravity

    def text(self) -> str:
        """Returns the tables as C++."""
        lines = [f"constexpr int {name} = {int(x)};" for name, x in self.constants.items()]
        lines.append(f"typedef unsigned {'long long ' * (self.m.nv > 32)}Mask;")
        for name, values in self.functions.items():
            given = ", ".join(str(int(x)) for x in values) or "0"
            lines.append(f"DEV constexpr int {name}(int i) {{")
            lines.append(f"  constexpr int table[] = {{{given}}};\n  return table[i];\n}}")
        lines.append("struct Model {")
        gain = 1e-10 * self.m.stat.meaninertia * self.m.nv
        made = [
            f"real({float(self.m.opt.timestep)!r})",
            f"SINGLE ? real({float(gain)!r}) : real(0)",
        ]
        lines.append("  real timestep, smallest_gain;")
        for kind, fields in (("int", self.ints), ("Mask", self.masks), ("real", self.reals)):
            for name, values in fields.items():
                flat = np.asarray(values).ravel().tolist() or [0]
                lines.append(f"  {kind} {name}[{len(flat)}];")
                form = {"int": "{:d}", "Mask": "{:d}ull", "real": "real({!r})"}[kind]
                numbers = (form.format(float(x) if kind == "real" else int(x)) for x in flat)
                made.append("{" + ",".join(numbers) + "}")
        return "\n".join([*lines, "};", "#define MODEL_INIT {" + ",\\\n".join(made) + "}"])

    def _world(self, link: int) -> int:
        """Returns the number of a link, the last for the world."""
        return self.m.njnt if link < 0 else link

    def _links(self) -> None:
        """Makes the tables of links, and finds the frames of bodies."""
        m = self.m
        origin = np.eye(4)[0]
        self.frames, self.parents = [_Frame(-1, np.zeros(3), origin)], []
        names = ("link_at", "link_quat", "link_turned", "link_zero")
        rows = []
        for body in range(1, m.nbody):
            frame = self.frames[m.body_parentid[body]].then(m.body_pos[body], m.body_quat[body])
            for joint in range(m.body_jntadr[body], m.body_jntadr[body] + m.body_jntnum[body]):
                kind, axis = m.jnt_type[joint], m.jnt_axis[joint]
                is_free = kind == _FREE
                anchor = np.zeros(3) if is_free else m.jnt_pos[joint]
                turned = _times(frame.quat, [0, *axis])
                if kind == _SLIDE:
                    turned = [*(_rotation(frame.quat) @ axis), 0]
                one = kind in (_HINGE, _SLIDE)
                zero = m.qpos0[m.jnt_qposadr[joint]] if one else 0
                rows.append((frame.place(anchor), frame.quat, turned, zero))
                self.parents.append(-1 if is_free else frame.link)
                frame = _Frame(joint, -np.asarray(anchor), origin)
            self.frames.append(frame)
        self.kinds = m.jnt_type
        self.reals |= zip(names, zip(*rows, strict=True), strict=True)
        self.ints |= {"link_kind": self.kinds, "link_qpos": m.jnt_qposadr, "link_dof": m.jnt_dofadr}
        self.functions["link_parent"] = self.parents
        self.functions["has_children"] = [int(x in self.parents) for x in range(m.njnt)]
        rotating = np.flatnonzero(self.kinds <= _BALL)
        self.ints["turn_dof"] = m.jnt_dofadr[rotating] + 3 * (self.kinds[rotating] == _FREE)
        self.constants["NTURN"] = len(rotating)

    def _bodies(self) -> None:
        """Makes the tables of bodies, and of the inertias of links."""
        m, rows = self.m, []
        for body in range(m.nbody):
            inertial = self.frames[body].then(m.body_ipos[body], m.body_iquat[body])
            turn = _rotation(inertial.quat)
            rows.append((inertial.at, turn @ np.diag(m.body_inertia[body]) @ turn.T))
        self.ints["body_link"] = [self._world(x.link) for x in self.frames]
        self.ints["body_root"] = m.body_rootid
        self.reals |= {"body_at": [x.at for x in self.frames], "body_com": [x[0] for x in rows]}
        self.reals |= {"body_inertia": [_six(x[1]) for x in rows], "body_mass": m.body_mass}
        masses, coms, inertias = [], [], []
        for link in range(m.njnt):
            carried = [x for x in range(m.nbody) if self.frames[x].link == link]
            mass = sum(m.body_mass[x] for x in carried)
            com = sum(m.body_mass[x] * rows[x][0] for x in carried) / max(mass, _TINY)
            com = np.zeros(3) if not carried or mass == 0 else com
            inertia = np.zeros((3, 3))
            for x in carried:
                arm = rows[x][0] - com
                inertia += rows[x][1] + m.body_mass[x] * (
                    arm @ arm * np.eye(3) - np.outer(arm, arm)
                )
            masses.append(mass)
            coms.append(com)
            inertias.append(_six(inertia))
        self.reals |= {"link_mass": masses, "link_com": coms, "link_inertia": inertias}

    def _dofs(self) -> None:
        """Makes the tables of degrees of freedom."""
        m, joint = self.m, self.dof_joint
        kind = self.kinds[joint]
        within = np.arange(m.nv) - m.jnt_dofadr[joint]
        free, one = kind == _FREE, kind >= _SLIDE
        axes = np.where(one[:, None], m.jnt_axis[joint], np.eye(3)[within % 3])
        kinds = np.where(kind == _SLIDE, 1, np.where(free & (within < 3), 2, 0))
        qpos = m.jnt_qposadr[joint]
        self.ints |= {"dof_link": joint, "dof_kind": kinds, "dof_qpos": qpos}
        self.ints["dof_turns"] = ~one & ~(kinds == 2)
        self.reals |= {"dof_axis": axes, "dof_damping": m.dof_damping}
        self.reals["dof_armature"] = m.dof_armature
        self.reals["dof_stiffness"] = np.where(one, m.jnt_stiffness[joint], 0)
        self.reals |= {"dof_spring": m.qpos_spring[qpos], "dof_zero": m.qpos0[qpos]}
        self.functions["dof_parent"] = m.dof_parentid
        self.functions["last_of_link"] = np.where(np.diff(joint, append=-1), joint, -1)
        moved = [[] for _ in range(m.njnt + 1)]
        paired = []
        for i in range(m.nv):
            j, chain = i, []
            while j >= 0:
                chain.append(j)
                if j < i and not (kinds[i] == 2 and kinds[j] == 2):
                    paired.append(i << 16 | j)
                j = m.dof_parentid[j]
            moved[joint[i]] = chain
        self.ints["paired"] = paired
        self.constants["NPAIRED"] = len(paired)
        self.masks["link_dofs"] = [sum(1 << x for x in chain) for chain in moved]
        self._bounds(joint, one)

    def _bounds(self, joint: np.ndarray, one: np.ndarray) -> None:
        """Makes the tables of limits and friction loss."""
        m = self.m
        limited = np.asarray(m.jnt_limited, bool)[joint] & one
        span = np.diff(m.jnt_range[joint]).ravel()
        both = limited & (span < 2 * m.jnt_margin[joint])
        self.constants["LIMITS"] = 2 if both.any() else int(limited.any())
        self.constants["LOSSES"] = int(np.any(m.dof_frictionloss))
        self.ints["dof_limited"] = limited
        bounds = [*m.jnt_range[joint].T, m.jnt_margin[joint], m.dof_invweight0]
        self.reals["dof_limit"] = np.stack(bounds, 1)
        refs, imps = m.jnt_solref[joint], m.jnt_solimp[joint]
        self.ints["dof_limit_soft"] = self._softs(refs, imps, limited)
        self.reals["dof_loss"] = np.stack([m.dof_frictionloss, m.dof_invweight0], 1)
        self.ints["dof_loss_soft"] = self._softs(m.dof_solref, m.dof_solimp, m.dof_frictionloss)

    def _softs(self, refs: np.ndarray, imps: np.ndarray, used: np.ndarray) -> list[int]:
        """Returns ``_soft`` of each row that is used, 0 for the others."""
        return [
            self._soft(*x) if is_used else 0 for *x, is_used in zip(refs, imps, used, strict=True)
        ]

    def _soft(self, solref: np.ndarray, solimp: np.ndarray) -> int:
        """Returns the number of MuJoCo's K, B and impedance of rows with these parameters."""
        ref, imp = np.array(solref, float), np.array(solimp, float)
        if (ref[0] > 0) != (ref[1] > 0):
            ref = np.array([0.02, 1])
        if ref[0] > 0:
            ref[0] = max(ref[0], 2 * self.m.opt.timestep)
        least, most, middle = np.clip(imp[[0, 1, 3]], _LEAST, _MOST)
        width, power = max(imp[2], 0), max(imp[4], 1)
        if ref[0] > 0:
            stiffness = 1 / max(_TINY, most**2 * ref[0] ** 2 * ref[1] ** 2)
            damping = 2 / max(_TINY, most * ref[0])
        else:
            stiffness, damping = -ref[0] / most**2, -ref[1] / most
        if least == most or width <= _TINY:
            least, most, width = (least + most) / 2, (least + most) / 2, 1.0
        key = (stiffness, damping, least, most - least, width, middle, power)
        return self.soft.setdefault(tuple(float(x) for x in key), len(self.soft))

    def _actuators(self) -> None:
        """Makes the tables of actuators, in the order of the degrees of freedom that they move."""
        m = self.m
        dofs = m.jnt_dofadr[m.actuator_trnid[:, 0]] if m.nu else np.zeros(0, int)
        order, free = np.argsort(dofs, kind="stable"), (-_NO_LIMIT, _NO_LIMIT)
        bounds = np.where(m.actuator_ctrllimited[:, None], m.actuator_ctrlrange, free)
        forces = np.where(m.actuator_forcelimited[:, None], m.actuator_forcerange, free)
        gain, bias = m.actuator_gainprm[:, :3].copy(), m.actuator_biasprm[:, :3].copy()
        gain[m.actuator_gaintype == _C.mjtGain.mjGAIN_FIXED, 1:] = 0
        bias[m.actuator_biastype == _C.mjtBias.mjBIAS_NONE] = 0
        rows = np.hstack([m.actuator_gear[:, :1], bounds, gain[:, :1], bias, forces, gain[:, 1:]])
        self.reals["actuator"] = rows[order]
        self.ints["actuator_ctrl"] = m.actuator_ctrladr[order] if m.nu else []
        self.ints["dof_actuator"] = np.searchsorted(dofs[order], np.arange(m.nv + 1))
        joint = self.dof_joint
        limited = m.jnt_actfrclimited[joint, None]
        self.reals["dof_force"] = np.where(limited, m.jnt_actfrcrange[joint], free)

    def _equalities(self) -> None:
        """Makes the tables of equality constraints."""
        m = self.m
        kinds = np.where(m.eq_active0, m.eq_type, -1)
        connects = np.flatnonzero(kinds == _EQUALITY.mjEQ_CONNECT)
        joined = np.flatnonzero(kinds == _EQUALITY.mjEQ_JOINT)
        self.constants |= {"NCONNECT": len(connects), "NE": 3 * len(connects) + len(joined)}
        links, places, bodies = [], [], []
        for e in connects:
            ends, at = (m.eq_obj1id[e], m.eq_obj2id[e]), m.eq_data[e, :6].reshape(2, 3)
            if m.eq_objtype[e] == _C.mjtObj.mjOBJ_SITE:
                ends, at = m.site_bodyid[list(ends)], m.site_pos[list(ends)]
            frames = [self.frames[x] for x in ends]
            bodies.append([int(x) for x in ends])
            links.append([self._world(x.link) for x in frames])
            places.append([x.place(y) for x, y in zip(frames, at, strict=True)])
        weights = [m.body_invweight0[x, 0].sum() for x in bodies]
        self.ints |= {"connect_link": links, "connect_body": bodies}
        self.reals |= {"connect_at": places, "connect_weight": weights}
        self.ints["connect_soft"] = [self._soft(m.eq_solref[e], m.eq_solimp[e]) for e in connects]
        joints = np.stack([m.eq_obj1id[joined], m.eq_obj2id[joined]], 1)
        dofs = np.where(joints >= 0, m.jnt_dofadr[joints], -1)
        self.ints["joined_dof"] = dofs
        self.ints["joined_soft"] = [self._soft(m.eq_solref[e], m.eq_solimp[e]) for e in joined]
        self.reals["joined_poly"] = m.eq_data[joined, :5]
        self.reals["joined_weight"] = [sum(m.dof_invweight0[x] for x in d if x >= 0) for d in dofs]

    def _jumps(self) -> None:
        """Makes the table by which poses of links are joined to those of the world."""
        poses = list(self.parents)
        jumps, starts = [], [0]
        while any(x >= 0 for x in poses):
            for row in range(3):
                jumps += [
                    (3 * link + row) | (3 * far + row) << 16
                    for link, far in enumerate(poses)
                    if far >= 0
                ]
            starts.append(len(jumps))
            poses = [poses[x] if x >= 0 else -1 for x in poses]
        self.ints["jump"] = jumps
        self.functions["jump_start"] = starts
        self.constants["ROUNDS"] = len(starts) - 1

    # ------------------------------------------------------------------------------------ contacts

    def _pairs(self, near: int) -> None:
        """Makes the tables of geoms that may meet."""
        m = self.m
        found = [(g, h, self._pair(g, h, n)) for g, h, n in _meeting(m)]
        used = sorted({g for a, b, _ in found for g in (a, b)})
        number = {g: n for n, g in enumerate(used)}
        kinds: dict[tuple, int] = {}
        items, item_kinds, weights = [], [], []
        for a, b, (dim, margin, friction, soft) in found:
            kind = kinds.setdefault((dim, margin, *map(float, friction), soft), len(kinds))
            weight = sum(m.body_invweight0[m.geom_bodyid[g], 0] for g in (a, b))
            if dim > 1:
                weight *= 2 * friction[0] ** 2 / m.opt.impratio * (1 + friction[0] ** 2)
            for part in range(_PARTS[_kinds(m, a, b)]):
                items.append(number[a] | number[b] << 12 | part << 24)
                item_kinds.append(kind)
                weights.append(weight)
        self.ints |= {"item": items, "item_kind": item_kinds}
        self.reals["item_weight"] = weights
        rows = list(kinds) or [(1, 0.0, *[0.0] * 5, 0)]
        self.ints |= {"kind_dim": [x[0] for x in rows], "kind_soft": [x[7] for x in rows]}
        self.reals |= {"kind_margin": [x[1] for x in rows], "kind_friction": [x[2:7] for x in rows]}
        self.constants |= {"NI": len(items), "NEAR": max(1, min(near, len(items)))}
        self.constants |= {"CD": max(x[0] for x in rows), "NG": max(len(used), 1)}
        self._geoms(np.array(used, int))

    def _geoms(self, used: np.ndarray) -> None:
        """Makes the tables of the geoms that may meet."""
        m = self.m
        frames = [self.frames[m.geom_bodyid[g]].then(m.geom_pos[g], m.geom_quat[g]) for g in used]
        types, size = m.geom_type[used], m.geom_size[used]
        plane, box = types == _PLANE, types == _BOX
        radii = np.where(plane | box, 0, size[:, 0])
        halves = np.where(types == _CAPSULE, size[:, 1], 0)
        reach = np.where(box, np.linalg.norm(size, axis=1), radii + halves)
        turns = [_rotation(x.quat) for x in frames]
        self.ints |= {"geom_kind": np.where(box, 2, ~plane), "geom_body": m.geom_bodyid[used]}
        self.ints["geom_link"] = [self._world(x.link) for x in frames]
        self.reals |= {"geom_at": [x.at for x in frames], "geom_axis": [x[:, 2] for x in turns]}
        self.reals |= {"geom_radius": radii, "geom_half": halves, "geom_reach": reach}
        self.constants["HAS_BOX"] = box.any()
        self.reals |= {"geom_turn": turns if box.any() else []}
        self.reals |= {"geom_size": size if box.any() else []}

    def _pair(self, g: int, h: int, n: int) -> tuple[int, float, np.ndarray, int]:
        """Returns condim, margin, friction [5] and softness of contacts, as C mixes them.

        ``n`` is the number of the model's own pair, -1 for none.
        """
        m, geoms = self.m, [g, h]
        if n >= 0:
            soft = self._soft(m.pair_solref[n], m.pair_solimp[n])
            return int(m.pair_dim[n]), float(m.pair_margin[n]), m.pair_friction[n], soft
        priority = m.geom_priority[geoms]
        if priority[0] != priority[1]:
            one = geoms[priority.argmax()]
            dim, friction = m.geom_condim[one], m.geom_friction[one]
            ref, imp = m.geom_solref[one], m.geom_solimp[one]
        else:
            dim, friction = m.geom_condim[geoms].max(), m.geom_friction[geoms].max(0)
            mix = np.where(m.geom_solmix[geoms] < _TINY, 0, m.geom_solmix[geoms])
            share = mix[0] / mix.sum() if mix.any() else 0.5
            refs, imps = m.geom_solref[geoms], m.geom_solimp[geoms]
            direct = (refs[:, 0] <= 0).any()
            ref = refs.min(0) if direct else share * refs[0] + (1 - share) * refs[1]
            imp = share * imps[0] + (1 - share) * imps[1]
        margin = float(m.geom_margin[geoms].sum())
        slide, spin, roll = friction
        frictions = np.array([slide, slide, spin, roll, roll])
        return int(dim), margin, frictions, self._soft(ref, imp)
