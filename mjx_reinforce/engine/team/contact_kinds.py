"""What contacts have: condim, friction and softness, as C MuJoCo mixes and bounds them."""

import enum
from typing import Any, NamedTuple

import numpy as np

from mjx_reinforce.engine.team import flags
from mjx_reinforce.engine.team.records import Softness
from mjx_reinforce.engine.team.supported import (
    CONVEX_CONTACTS,
    NUM_PARTS,
    GeomPair,
    geom_kinds,
    meeting,
)

#: MuJoCo's mjMINVAL, mjMINMU, mjMINIMP and mjMAXIMP.
MIN_VALUE = 1e-15
_MIN_FRICTION = 1e-5
_MIN_IMPEDANCE = 1e-4
_MAX_IMPEDANCE = 1 - 1e-4


class Mix(enum.IntEnum):
    """Which geom's friction a contact has: the Mix of ``device/draws.h``."""

    LARGER = 0
    OF_FIRST = 1
    OF_SECOND = 2
    OF_PAIR = 3


class ContactKind(NamedTuple):
    """What contacts of many pairs have in common.

    dim: MuJoCo's condim
    margin: (m)
    gap: beyond the margin, by which the convex collider lets geoms grow; 0 for others (m)
    friction: along the two tangents, about the normal, about the two tangents
    softness: of the rows
    friction_softness: that of the rows of friction of an elliptic cone
    """

    dim: int
    margin: float
    gap: float
    friction: tuple[float, ...]
    softness: Softness
    friction_softness: Softness


def softness_of(model: Any, solref: np.ndarray, solimp: np.ndarray) -> Softness:
    """Returns MuJoCo's K, B and impedance of constraint rows with these parameters."""
    # As getsolparam and mj_makeImpedance of engine_core_constraint.c: solref is a time constant
    # and a damping ratio, or, where negative, stiffness and damping themselves.
    ref = np.array(solref, float)
    imp = np.array(solimp, float)
    if (ref[0] > 0) != (ref[1] > 0):
        ref = np.array([0.02, 1])
    if ref[0] > 0 and not flags.is_off(model, "refsafe"):
        ref[0] = max(ref[0], 2 * model.opt.timestep)
    dmin, dmax, midpoint = np.clip(imp[[0, 1, 3]], _MIN_IMPEDANCE, _MAX_IMPEDANCE)
    width = max(imp[2], 0)
    power = max(imp[4], 1)
    if ref[0] > 0:
        stiffness = 1 / max(MIN_VALUE, dmax**2 * ref[0] ** 2 * ref[1] ** 2)
        damping = 2 / max(MIN_VALUE, dmax * ref[0])
    else:
        stiffness = -ref[0] / dmax**2
        damping = -ref[1] / dmax
    if dmin == dmax or width <= MIN_VALUE:
        # Without a width the impedance is the mean everywhere; 1 keeps the division sound.
        dmin = dmax = (dmin + dmax) / 2
        width = 1.0
    numbers = (stiffness, damping, dmin, dmax - dmin, width, midpoint, power)
    return Softness(*map(float, numbers))


def contact_kind(model: Any, pair: GeomPair) -> ContactKind:
    """Returns what contacts of a pair of geoms have."""
    is_convex = geom_kinds(model, pair) in CONVEX_CONTACTS
    if pair.pair >= 0:
        ref = model.pair_solref[pair.pair]
        friction_ref = model.pair_solreffriction[pair.pair]
        imp = model.pair_solimp[pair.pair]
        return ContactKind(
            dim=int(model.pair_dim[pair.pair]),
            margin=float(model.pair_margin[pair.pair]),
            gap=float(model.pair_gap[pair.pair]) if is_convex else 0.0,
            friction=_friction(model.pair_friction[pair.pair]),
            softness=softness_of(model, ref, imp),
            friction_softness=softness_of(model, friction_ref if friction_ref.any() else ref, imp),
        )
    # mj_contactParam: the geom of higher priority decides alone.
    geoms = [pair.geom1, pair.geom2]
    priority = model.geom_priority[geoms]
    if priority[0] != priority[1]:
        geom = geoms[priority.argmax()]
        dim = model.geom_condim[geom]
        friction = model.geom_friction[geom]
        ref = model.geom_solref[geom]
        imp = model.geom_solimp[geom]
    else:
        dim = model.geom_condim[geoms].max()
        friction = model.geom_friction[geoms].max(0)
        solmix = np.where(model.geom_solmix[geoms] < MIN_VALUE, 0, model.geom_solmix[geoms])
        share = solmix[0] / solmix.sum() if solmix.any() else 0.5
        refs = model.geom_solref[geoms]
        imps = model.geom_solimp[geoms]
        # Stiffness itself and a time constant do not mix: C takes the smaller numbers.
        is_direct = (refs[:, 0] <= 0).any()
        ref = refs.min(0) if is_direct else share * refs[0] + (1 - share) * refs[1]
        imp = share * imps[0] + (1 - share) * imps[1]
    softness = softness_of(model, ref, imp)
    return ContactKind(
        dim=int(dim),
        margin=float(model.geom_margin[geoms].sum()),
        gap=float(model.geom_gap[geoms].sum()) if is_convex else 0.0,
        friction=_friction(friction[[0, 0, 1, 2, 2]]),
        softness=softness,
        friction_softness=softness,
    )


def mix_of(model: Any, pair: GeomPair) -> Mix:
    """Returns which friction the contacts of a pair of geoms have (mj_contactParam)."""
    if pair.pair >= 0:
        return Mix.OF_PAIR
    first, second = model.geom_priority[[pair.geom1, pair.geom2]]
    if first == second:
        return Mix.LARGER
    if first > second:
        return Mix.OF_FIRST
    return Mix.OF_SECOND


def _friction(coefficients: np.ndarray) -> tuple[float, ...]:
    """Returns the friction of a contact; less than MuJoCo's mjMINMU is mjMINMU."""
    return tuple(map(float, np.maximum(coefficients, _MIN_FRICTION)))


def num_frictional(model: Any) -> int:
    """Returns how many contacts with friction a model may have at once."""
    kinds = [
        geom_kinds(model, pair) for pair in meeting(model) if contact_kind(model, pair).dim > 1
    ]
    return sum(CONVEX_CONTACTS.get(kind) or NUM_PARTS.get(kind, 1) for kind in kinds)
