"""Tables of the geoms that may meet."""

import numpy as np

from mjx_reinforce.engine.team import hulls
from mjx_reinforce.engine.team.frames import rotation
from mjx_reinforce.engine.team.supported import (
    BOX,
    CAPSULE,
    CYLINDER,
    ELLIPSOID,
    MESH,
    PLANE,
    SPHERE,
)
from mjx_reinforce.engine.team.tables.store import Tables

#: The kinds of geoms by the enum of ``device/rounds.h``.
KINDS = {PLANE: 0, SPHERE: 1, CAPSULE: 1, ELLIPSOID: 2, CYLINDER: 3, BOX: 4, MESH: 5}


def fill(tables: Tables) -> None:
    """Makes the tables of the geoms that may meet."""
    model = tables.model
    geoms = tables.geoms
    bodies = model.geom_bodyid[geoms]
    frames = [
        tables.frames[body].then(model.geom_pos[geom], model.geom_quat[geom])
        for geom, body in zip(geoms, bodies, strict=True)
    ]
    types = model.geom_type[geoms]
    size = model.geom_size[geoms]
    has_radius = np.isin(types, (SPHERE, CAPSULE, CYLINDER))
    has_length = np.isin(types, (CAPSULE, CYLINDER))
    turns = [rotation(frame.quat) for frame in frames]
    tables.ints["geom_kind"] = [KINDS[x] for x in types]
    tables.ints["geom_body"] = bodies
    tables.ints["geom_link"] = [tables.link_number(frame.link) for frame in frames]
    tables.reals["geom_at"] = [frame.pos for frame in frames]
    tables.reals["geom_axis"] = [turn[:, 2] for turn in turns]
    tables.reals["geom_radius"] = np.where(has_radius, size[:, 0], 0)
    tables.reals["geom_half"] = np.where(has_length, size[:, 1], 0)
    tables.reals["geom_reach"] = model.geom_rbound[geoms]
    # Shared memory is scarce: what has no turn about the axis needs neither that nor sizes.
    has_size = np.isin(types, (BOX, CYLINDER, ELLIPSOID)).any()
    has_meshes = MESH in types
    tables.reals["geom_turn"] = turns if has_size or has_meshes else []
    tables.reals["geom_size"] = size if has_size else []
    has_convex = tables.constants["CONVEX_CONTACTS"] > 0
    tables.reals["geom_box"] = model.geom_aabb[geoms] if has_convex else []
    tables.hulls = hulls.of_geoms(model, geoms)
    meshes = model.geom_dataid[geoms]
    numbers = [tables.hulls.numbers.get(int(x), -1) for x in meshes]
    tables.ints["geom_hull"] = numbers if has_meshes else []
    # Of a box, and of the polygon that a cylinder's end is.
    tables.constants["CONVEX_SIDES"] = max(16, *(x for _, x in tables.hulls.face_corners), 0)
    tables.constants["CONVEX_DEGREE"] = max(3, hulls.degree(tables.hulls))
