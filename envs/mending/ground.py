"""What of a model may touch what, and on which geoms its robot stands."""

from typing import Any, NamedTuple

import mujoco
import numpy as np

from mjx_reinforce.engine.base import MjModel
from mjx_reinforce.engine.physics.mjx_internals import geom_pairs
from mjx_reinforce.envs import refusals

#: MuJoCo's own names; it is a C extension without stubs.
_C: Any = mujoco
#: Feet end at most this part of the robot's height above the lowest one. In 18 scenes of Menagerie
#: with robots on legs, feet were at 0.3% at most, and what is no foot at 2.2% or more.
_TOLERANCE = 0.015
#: Legs keep the trunk so high over the feet, as a part of that height. It is 0.45 or more of robots
#: on legs, and less than 0.39 of cars, what lies, and Gymnasium's ants, whose legs are level.
_CLEARANCE = 0.4
#: The least cosine between the normal of a floor and the vertical.
_LEVEL = 0.9
#: How far ``mj_geomDistance`` looks (m).
_FAR = 100.0


class Pair(NamedTuple):
    """Two geoms that may touch.

    geom1, geom2: their numbers, in MJX's order
    pair: the number of the <pair> element that names them, or -1
    """

    geom1: int
    geom2: int
    pair: int


class Stance(NamedTuple):
    """What a robot stands on.

    feet: the geoms of the robot that come nearest the floor in its first pose
    pairs: those of a foot and a geom that cannot move
    """

    feet: list[int]
    pairs: list[Pair]


def pairs(model: MjModel) -> list[Pair]:
    """Returns the pairs of geoms of a model that may touch."""
    if not refusals.may_touch(model):
        return []
    return [Pair(*map(int, numbers)) for numbers in geom_pairs(model)]


def is_ground(model: MjModel, geom: int) -> bool:
    """Returns whether a geom cannot move."""
    return bool(model.body_weldid[model.geom_bodyid[geom]] == 0)


def contact_counts(model: MjModel) -> str:
    """Returns in words how many contacts are possible, and how many of them with the ground.

    A contact is one of two geoms: MuJoCo's points of contact are more.
    """
    possible_pairs = pairs(model)
    of_ground = [
        x for x in possible_pairs if is_ground(model, x.geom1) or is_ground(model, x.geom2)
    ]
    noun = "contact" if len(possible_pairs) == 1 else "contacts"
    line = f"{len(possible_pairs):,} possible {noun}, {len(of_ground):,} with the ground"
    if not of_ground and model.njnt and model.jnt_type[0] == _C.mjtJoint.mjJNT_FREE:
        line += '; if the robot stands, give the file of its scene, or add <geom type="plane"/>'
    return line


def first_pose(model: MjModel) -> Any:
    """Returns an ``MjData`` with the poses of a model's first key frame, or else of ``qpos0``."""
    data = _C.MjData(model)
    if model.nkey:
        _C.mj_resetDataKeyframe(model, data, 0)
    _C.mj_kinematics(model, data)
    return data


def stance(model: MjModel) -> Stance | None:
    """Returns on what a robot on legs stands in its first pose.

    Returns:
      None where that is not one robot with a free joint, over a floor, whose trunk is off it.
    """
    if model.ntree != 1 or model.jnt_type[0] != _C.mjtJoint.mjJNT_FREE:
        return None
    data = first_pose(model)
    # Of each pair with a floor: how far the other geom is from it.
    gaps: dict[int, float] = {}
    for floor, geom, _ in pairs(model):
        is_plane = model.geom_type[floor] == _C.mjtGeom.mjGEOM_PLANE
        is_level = data.geom_xmat[floor].reshape(3, 3)[2, 2] > _LEVEL
        if is_plane and is_level and is_ground(model, floor):
            gap = _C.mj_geomDistance(model, data, floor, geom, _FAR, np.zeros(6))
            gaps[geom] = min(gap, gaps.get(geom, _FAR))
    if not gaps:
        return None
    lowest, highest = min(gaps.values()), max(gaps.values())
    trunk = [gap for geom, gap in gaps.items() if model.geom_bodyid[geom] == model.jnt_bodyid[0]]
    if min(trunk, default=highest) < lowest + _CLEARANCE * (highest - lowest):
        return None
    limit = lowest + _TOLERANCE * (highest - lowest)
    feet = sorted(geom for geom, gap in gaps.items() if gap <= limit)
    of_feet = [
        x
        for x in pairs(model)
        if any(g in feet and is_ground(model, h) for g, h in (x[:2], x[1::-1]))
    ]
    return Stance(feet, of_feet)
