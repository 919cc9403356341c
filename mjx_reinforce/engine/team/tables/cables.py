"""Cables of a model: what has a length, and pulls at degrees of freedom along its moments.

Tendons are cables, and so are the transmissions of actuators of sites and of free and ball joints,
and the angle of a ball joint that has a limit.
"""

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np

from mjx_reinforce.engine.team.frames import Frame, rotation
from mjx_reinforce.engine.team.supported import BALL, FREE, pulling_tendons
from mjx_reinforce.engine.team.tables.store import Tables

_C: Any = mujoco  # a C extension without stubs
#: The kinds of parts, by ``device/cables.h``.
_COEFFICIENT, _SEGMENT, _WRENCH, _APART, _TWIST, _ANGLE = range(6)
_ZEROS = (0.0, 0.0, 0.0)


class Part(NamedTuple):
    """What a cable is the sum of.

    kind: one of those above
    on: the link that it pulls at; of a coefficient the degree of freedom
    off: the link whose degrees of freedom it does not pull at; of a segment its other end's
    frame: the link in whose axes the gear is
    at: a place of link ``on`` (m)
    gear: a force and a torque; of a segment the place of its other end, and one by its divisor; of
      a coefficient what it pulls and what its position adds to the length
    bodies: of the ends of a segment
    """

    kind: int
    on: int
    off: int = -1
    frame: int = -1
    at: Any = _ZEROS
    gear: Any = (*_ZEROS, *_ZEROS)
    bodies: Sequence[int] = (0, 0)


class Cable(NamedTuple):
    """A cable: its parts, and the tendon, actuator or ball joint whose it is."""

    parts: list[Part]
    tendon: int = -1
    actuator: int = -1
    joint: int = -1


class Bound(NamedTuple):
    """A row of a limit or of friction loss.

    cable: the number of the cable
    sides: 1 for its least length, 2 for its most, 3 for the nearer one of both
    limit: these lengths, from how far on they push (m, or rad), and the inverse mass of the row
    soft: solref and solimp
    loss: the most that friction loss pushes
    """

    cable: int
    sides: int
    limit: tuple[float, ...]
    soft: tuple[Any, Any]
    loss: float = 0.0


def fill(tables: Tables) -> None:
    """Makes the tables of cables."""
    model = tables.model
    tables.cables = _of_model(model, tables.frames, tables.parents, tables.reals["link_quat"])
    parts = [part for cable in tables.cables for part in cable.parts]
    tables.ints["cable_part"] = np.cumsum([0, *(len(x.parts) for x in tables.cables)])
    tables.ints["part_kind"] = [x.kind for x in parts]
    tables.ints["part_on"] = [tables.link_number(x.on) for x in parts]
    tables.ints["part_off"] = [tables.link_number(x.off) for x in parts]
    tables.ints["part_body"] = [x.bodies for x in parts]
    tables.constants["SEGMENTS"] = int(any(x.kind == _SEGMENT for x in parts))
    tables.ints["part_frame"] = [tables.link_number(x.frame) for x in parts]
    tables.reals["part"] = [(*x.at, *x.gear) for x in parts]
    tendons = [_spring(model, x.tendon) for x in tables.cables]
    is_tense = any(any(x[:6]) for x in tendons)
    tables.constants["TENDON_FORCES"] = int(is_tense)
    tables.reals["tendon"] = tendons if is_tense else []
    tables.constants["NCABLE"] = len(tables.cables)


def fill_bounds(tables: Tables) -> None:
    """Makes the tables of limits and, behind them, of friction loss of cables."""
    limits, losses = _bounds(tables.model, tables.cables)
    rows = [*limits, *losses]
    tables.ints["bound_cable"] = [x.cable for x in rows]
    tables.ints["bound_soft"] = [tables.softness_number(*x.soft) for x in rows]
    tables.ints["bound_sides"] = [x.sides for x in limits]
    tables.reals["bound"] = [x.limit for x in rows]
    tables.reals["bound_loss"] = [x.loss for x in losses]
    tables.constants["NLIMITED"] = len(limits)
    tables.constants["NLOSS"] = len(losses)
    tables.constants["NE"] += len(rows)


def _of_model(model: Any, frames: Sequence[Frame], parents: Any, quats: Any) -> list[Cable]:
    """Returns a model's cables.

    Args:
      model: the MjModel.
      frames: of bodies.
      parents: of links.
      quats: [links, 4] of links in their parents where joints do not move.
    """
    cables = [Cable([*_tendon(model, frames, n)], tendon=n) for n in pulling_tendons(model)]
    for actuator, kind in enumerate(model.actuator_trntype):
        joint = model.actuator_trnid[actuator, 0]
        if kind == _C.mjtTrn.mjTRN_SITE:
            cables.append(Cable([*_sites(model, frames, actuator)], actuator=actuator))
        elif kind != _C.mjtTrn.mjTRN_TENDON and model.jnt_type[joint] <= BALL:
            parts = [*_joint(model, actuator, parents[joint], quats[joint])]
            cables.append(Cable(parts, actuator=actuator))
    is_ball = model.jnt_type == BALL
    for joint in np.flatnonzero(np.asarray(model.jnt_limited, bool) & is_ball).tolist():
        angle = Part(_ANGLE, on=joint, off=parents[joint], frame=joint)
        cables.append(Cable([angle], joint=joint))
    return cables


def _tendon(model: Any, frames: Sequence[Frame], tendon: int) -> Iterable[Part]:
    """Yields the parts of a tendon (mj_tendon)."""
    start = model.tendon_adr[tendon]
    wraps = range(start, start + model.tendon_num[tendon])
    inverse_divisor = 1.0
    for wrap, after in zip(wraps, [*wraps[1:], -1], strict=True):
        kind = model.wrap_type[wrap]
        number = model.wrap_objid[wrap]
        if kind == _C.mjtWrap.mjWRAP_JOINT:
            coefficient = model.wrap_prm[wrap]
            gear = (coefficient, coefficient, *_ZEROS, 0)
            yield Part(_COEFFICIENT, on=model.jnt_dofadr[number], gear=gear)
        elif kind == _C.mjtWrap.mjWRAP_PULLEY:
            inverse_divisor = 1 / model.wrap_prm[wrap]
        elif after >= 0 and model.wrap_type[after] == _C.mjtWrap.mjWRAP_SITE:
            sites = [model.wrap_objid[after], number]
            ends = [_site(model, frames, site) for site in sites]
            yield Part(
                kind=_SEGMENT,
                on=ends[0].link,
                off=ends[1].link,
                at=ends[0].pos,
                gear=(*ends[1].pos, inverse_divisor, 0, 0),
                bodies=model.site_bodyid[sites],
            )


def _site(model: Any, frames: Sequence[Frame], site: int) -> Frame:
    """Returns the frame of a site."""
    body_frame = frames[model.site_bodyid[site]]
    return body_frame.then(model.site_pos[site], model.site_quat[site])


def _sites(model: Any, frames: Sequence[Frame], actuator: int) -> Iterable[Part]:
    """Yields the parts of an actuator of a site, or of a site as another one sees it."""
    site, reference = model.actuator_trnid[actuator]
    gear = model.actuator_gear[actuator].reshape(2, 3)
    end = _site(model, frames, site)
    base = end if reference < 0 else _site(model, frames, reference)
    # The gear is in the axes of the reference.
    gear = (gear @ rotation(base.quat).T).ravel()
    if reference < 0:
        yield Part(_WRENCH, on=end.link, frame=end.link, at=end.pos, gear=gear)
    else:
        yield Part(_APART, on=end.link, off=base.link, frame=base.link, at=end.pos, gear=gear)
        yield Part(_APART, on=base.link, off=end.link, frame=base.link, at=base.pos, gear=-gear)


def _joint(model: Any, actuator: int, parent: int, quat: Any) -> Iterable[Part]:
    """Yields the parts of an actuator of a free or a ball joint."""
    joint = model.actuator_trnid[actuator, 0]
    gear = model.actuator_gear[actuator]
    is_in_parent = model.actuator_trntype[actuator] == _C.mjtTrn.mjTRN_JOINTINPARENT
    frame = parent if is_in_parent else joint
    if model.jnt_type[joint] == FREE:
        for k in range(3):
            dof = model.jnt_dofadr[joint] + k
            yield Part(_COEFFICIENT, on=dof, gear=(gear[k], 0, 0, *_ZEROS))
        yield Part(_WRENCH, on=joint, frame=frame, gear=(*_ZEROS, *gear[3:]))
    else:
        torque = rotation(quat) @ gear[:3] if is_in_parent else gear[:3]
        wrench = (*_ZEROS, *torque)
        # Its length is along the gear as the joint has it, which no force reads as a place.
        yield Part(_TWIST, on=joint, off=parent, frame=frame, at=gear[:3], gear=wrench)


def of_actuators(model: Any, types: Sequence[Any], count: int) -> np.ndarray:
    """Returns what actuators of these types add to each of ``count`` joints or tendons, [count, 4].

    Armature, then damping and the rest of its polynomial: mj_actuatorArmature, mj_actuatorDamping.
    """
    columns = model.actuator_armature, model.actuator_damping, model.actuator_dampingpoly
    rows = np.column_stack(columns) * model.actuator_gear[:, :1] ** 2
    is_driving = np.isin(model.actuator_trntype, types)
    sums = np.zeros((count, 4))
    np.add.at(sums, model.actuator_trnid[is_driving, 0], rows[is_driving])
    return sums


def _spring(model: Any, tendon: int) -> tuple[float, ...]:
    """Returns the Tendon of ``device/records.h``; -1 is no tendon, and pulls nothing."""
    if tendon < 0:
        return (0.0,) * 8
    damping = np.array([model.tendon_damping[tendon], *model.tendon_dampingpoly[tendon]])
    damping += of_actuators(model, (_C.mjtTrn.mjTRN_TENDON,), model.ntendon)[tendon, 1:]
    stiffness = (model.tendon_stiffness[tendon], *model.tendon_stiffnesspoly[tendon])
    return (*stiffness, *damping, *model.tendon_lengthspring[tendon])


def _bounds(model: Any, cables: Sequence[Cable]) -> tuple[list[Bound], list[Bound]]:
    """Returns the rows of the limits of cables, and those of their friction loss."""
    limits = []
    losses = []
    for number, cable in enumerate(cables):
        joint = cable.joint
        if joint >= 0:
            weight = model.dof_invweight0[model.jnt_dofadr[joint]]
            limit = (0.0, model.jnt_range[joint].max(), model.jnt_margin[joint], weight)
            soft = (model.jnt_solref[joint], model.jnt_solimp[joint])
            limits.append(Bound(number, sides=2, limit=limit, soft=soft))
        tendon = cable.tendon
        if tendon < 0:
            continue
        low, high = model.tendon_range[tendon]
        margin = model.tendon_margin[tendon]
        limit = (low, high, margin, model.tendon_invweight0[tendon])
        if model.tendon_limited[tendon]:
            soft = (model.tendon_solref_lim[tendon], model.tendon_solimp_lim[tendon])
            # Both limits push at once only where their margins overlap.
            sides = (1, 2) if high - low < 2 * margin else (3,)
            limits += [Bound(number, sides=x, limit=limit, soft=soft) for x in sides]
        loss = model.tendon_frictionloss[tendon]
        if loss > 0:
            soft = (model.tendon_solref_fri[tendon], model.tendon_solimp_fri[tendon])
            losses.append(Bound(number, sides=0, limit=limit, soft=soft, loss=loss))
    return limits, losses
