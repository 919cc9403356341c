"""Contacts as C MuJoCo makes them, where MJX makes others.

Gymnasium runs C MuJoCo, and MJX 3.17 departs from it in these collision functions, by enough to
change an episode. Those here agree with MuJoCo 4.0 to rounding, with exceptions at the end.

- ``plane_capsule``: MJX's contact frame no longer follows a capsule that is more than 60 degrees
  from the plane, and the friction pyramid turns with the frame.
- ``plane_box`` and ``plane_cylinder``: MJX leaves out corners that are more than 1 mm above the
  lowest, and the far end of a cylinder whose end is more than 1 mm deeper.
- ``sphere_capsule`` and ``capsule_capsule``: MJX adds 1e-6 to its denominators.
- ``sphere_cylinder`` and ``capsule_cylinder``: MJX looks for their contacts in ten steps of
  gradient descent.
- Boxes on spheres, capsules and boxes: see ``boxes.py``.

``envs/models.py`` refuses the pairs of ``UNLIKE_C``. These differences remain:

- Capsules within 1e-4 rad of parallel meet in two contacts in C, at the ends of their overlap, and
  here in one, at its middle: the number of rows is static in JAX, so that every pair of capsules
  would pay for a second row (a fifth of Humanoid's time on a CPU). None of 60,000 states of
  Humanoid, HumanoidStandup and Hopper under random actions had such a pair.
- C finds capsule and cylinder by an iteration that ends at 1e-6 m. Its normals are then right to
  some 1e-5, and its position between parallel surfaces may be anywhere along them. A capsule whose
  axis enters the cylinder is pushed out by the shortest way of its deepest point, and in C of the
  whole capsule. Of a capsule that lies on a cap with one end beyond the margin, C doubles the
  contact at the other end if the rim cuts it.
- Of a cylinder that is within the margin of a plane by more than most of its thickness C has four
  contacts, and here are three, as in Pusher, whose cylinder never is.
- Where a capsule is parallel to a face of a box but for rounding, the sign of the rounding decides
  whether C finds one contact or two.

``fwd_position`` is MJX's with these functions in the table of collision functions. MJX collides all
pairs of one kind at once, which is best where XLA computes many episodes. Machine code for one
episode is a loop over the pairs (``one_by_one``): short, and quick where geoms are apart, since
only pairs whose bounding spheres meet are collided, as in C.
"""

import types
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from mujoco import mjx

from mjx_reinforce.engine.physics import boxes, inertia, mjx_internals
from mjx_reinforce.engine.physics.mjx_internals import Collision, GeomInfo, collider, make_frame
from mjx_reinforce.engine.physics.rows import make_constraint
from mjx_reinforce.engine.scalar import is_written_out, short_scan

# What C takes for zero (mjMINVAL); in single precision, what rounding may leave of a zero distance
# between points a few meters from the origin. Axes that cross, as in a planar Hopper, have that.
_MIN_LENGTH = {"float64": 1e-15, "float32": 2e-6}
# Capsules are parallel in C (``mjc_segWeights``) below this square of their angle's sine.
_PARALLEL_SINE_SQUARE = 1e-8
# The sine of the angle to a cap up to which a capsule lies on it in C.
_CAP_SINE = 0.0888
# A distance at which nothing touches, in meters.
_GAP = 1e3
#: A collision function of MJX: (model, data, key, geoms [P, 2]) -> dist, pos, frame of contacts.
Collide = Callable[..., Any]


@collider(ncon=2)
def plane_capsule(plane: GeomInfo, capsule: GeomInfo) -> Collision:
    """Collides both ends of a capsule with a plane; the first tangents follow its axis."""
    normal = plane.mat[:, 2]
    axis = capsule.mat[:, 2]
    # ``mjc_PlaneCapsule`` aligns the frame with the axis at any angle, MJX up to 60 degrees.
    tangent, _ = _direction(axis - normal * jnp.dot(normal, axis))
    frame = jnp.stack([normal, tangent, jnp.cross(normal, tangent)])
    segment = axis * capsule.size[1]
    end_points = capsule.pos + jnp.stack([segment, -segment])
    dist = (end_points - plane.pos) @ normal - capsule.size[0]
    pos = end_points - normal * (capsule.size[0] + dist[:, None] / 2)
    return dist, pos, jnp.stack([frame, frame])


@collider(ncon=4)
def plane_box(plane: GeomInfo, box: GeomInfo) -> Collision:
    """Collides a plane with the lower corner of each of a box's four diagonals."""
    # One corner of each diagonal; the opposite one is its negative. C stops at four contacts, too.
    corners = np.array([[1, 1, 1], [-1, 1, 1], [1, -1, 1], [1, 1, -1]]) * box.size @ box.mat.T
    is_upper = corners @ plane.mat[:, 2] > 0
    return _collide_points(plane, box.pos + jnp.where(is_upper[:, None], -corners, corners))


@collider(ncon=3)
def plane_cylinder(plane: GeomInfo, cylinder: GeomInfo) -> Collision:
    """Collides a plane with a cylinder's lowest point and with two more.

    They are two of the lower rim, a third around, or the lowest of the other rim if it is lower: C
    has that one in addition, which matters only where all four are within the margin.
    """
    normal = plane.mat[:, 2]
    # Down along the axis, and down across it; an upright cylinder has its own x axis for that, as
    # in ``mjc_PlaneCylinder``.
    axis = cylinder.mat[:, 2]
    axis = jnp.where(jnp.dot(normal, axis) > 0, -axis, axis)
    down, length = _direction(axis * jnp.dot(axis, normal) - normal)
    down = cylinder.size[0] * jnp.where(length == 0, cylinder.mat[:, 0], down)
    # Three points of the lower rim, 120 degrees apart.
    rim_offset = jnp.cross(down, axis) * np.sqrt(0.75)
    half = cylinder.size[1] * axis
    rim = half + jnp.stack([down, rim_offset - down / 2, -rim_offset - down / 2])
    # The upper rim's lowest point takes the second's place if it is lower, as where it lies.
    upper = down - half
    is_lower = jnp.dot(upper, normal) < jnp.dot(rim[1], normal)
    return _collide_points(plane, cylinder.pos + rim.at[1].set(jnp.where(is_lower, upper, rim[1])))


@collider(ncon=1)
def sphere_capsule(sphere: GeomInfo, capsule: GeomInfo) -> Collision:
    """Collides a sphere with the point of a capsule's axis that is closest to it."""
    axis = capsule.mat[:, 2]
    half = capsule.size[1]
    axis_place = jnp.clip(jnp.dot(axis, sphere.pos - capsule.pos), -half, half)
    return _collide_spheres(sphere, sphere.pos, capsule, capsule.pos + axis_place * axis)


@collider(ncon=1)
def capsule_capsule(capsule1: GeomInfo, capsule2: GeomInfo) -> Collision:
    """Collides two capsules where their axes are closest."""
    point1, point2 = _closest_points(capsule1, capsule2)
    return _collide_spheres(capsule1, point1, capsule2, point2)


def _closest_points(capsule1: GeomInfo, capsule2: GeomInfo) -> tuple[jax.Array, jax.Array]:
    """Returns the point of each capsule's axis that is closest to the other's axis, [3] each."""
    axis1 = capsule1.mat[:, 2] * capsule1.size[1]
    axis2 = capsule2.mat[:, 2] * capsule2.size[1]
    offset = capsule1.pos - capsule2.pos

    def meet(place1: float | jax.Array) -> jax.Array:
        """Returns a place on the first axis and the closest on the second, in half lengths."""
        foot2 = jnp.dot(offset + place1 * axis1, axis2) / jnp.dot(axis2, axis2)
        place2 = jnp.clip(foot2, -1, 1)
        # Past the second axis' end, the first place is that closest to the end.
        foot1 = jnp.dot(place2 * axis2 - offset, axis1) / jnp.dot(axis1, axis1)
        return jnp.stack([jnp.where(foot2 == place2, place1, jnp.clip(foot1, -1, 1)), place2])

    # Two lines cross where the determinant of ``mjraw_CapsuleCapsule`` is not zero. It is computed
    # as the square of a cross product, which keeps its digits between almost parallel axes.
    normal = jnp.cross(axis1, axis2)
    square = jnp.dot(normal, normal)
    scale = jnp.dot(axis1, axis1) * jnp.dot(axis2, axis2)
    is_parallel = square <= _PARALLEL_SINE_SQUARE * scale
    crossing = jnp.dot(normal, jnp.cross(axis2, offset)) / jnp.where(is_parallel, scale, square)
    # Parallel axes are closest all along their overlap. C has a contact at each of its ends.
    midpoint = (meet(-1.0) + meet(1.0)) / 2
    place1, place2 = jnp.where(is_parallel, midpoint, meet(jnp.clip(crossing, -1, 1)))
    return capsule1.pos + place1 * axis1, capsule2.pos + place2 * axis2


@collider(ncon=1)
def sphere_cylinder(sphere: GeomInfo, cylinder: GeomInfo) -> Collision:
    """Collides a sphere with the point of a cylinder's surface that is closest to its center."""
    dist, outward = _from_cylinder((sphere.pos - cylinder.pos) @ cylinder.mat, cylinder.size)
    normal = -cylinder.mat @ outward
    dist = dist - sphere.size[0]
    return dist, sphere.pos + normal * (sphere.size[0] + dist / 2), make_frame(normal)


@collider(ncon=2)
def capsule_cylinder(capsule: GeomInfo, cylinder: GeomInfo) -> Collision:
    """Collides a capsule with a cylinder where its axis is closest, or with a cap it lies on.

    On a cap are two contacts, at the ends of the part of the capsule's lowest line that is above a
    polygon of 16 corners in the cap's rim, as in C; elsewhere one, and one that is far.
    """
    # In the cylinder's frame: one contact where the capsule's axis is closest.
    radius = capsule.size[0]
    half = capsule.size[1]
    center = (capsule.pos - cylinder.pos) @ cylinder.mat
    axis = capsule.mat[:, 2] @ cylinder.mat
    axis_place = _closest_along(center, axis, half, cylinder.size)
    dist, outward = _from_cylinder(center + axis_place * axis, cylinder.size)
    contact = center + axis_place * axis - outward * (radius + (dist - radius) / 2)

    # Two contacts on a cap, at the ends of what the cap holds of the capsule's lowest line.
    cap = jnp.where(outward[2] > 0, 1.0, -1.0) * jnp.eye(3, dtype=axis.dtype)[2]
    line = center - radius * (outward - axis * jnp.dot(axis, outward))
    start, end = _above_polygon(line, axis, half, cylinder.size[0])
    is_flat = (jnp.abs(axis[2]) < _CAP_SINE) & (outward[2] != 0) & (start < end)
    points = line + jnp.stack([start, end])[:, None] * axis
    depths = points @ cap - cylinder.size[1]

    dist = jnp.where(is_flat, depths, jnp.stack([dist - radius, jnp.full((), _GAP, axis.dtype)]))
    pos = jnp.where(is_flat, points - depths[:, None] / 2 * cap, contact)
    frame = make_frame(-cylinder.mat @ jnp.where(is_flat, cap, outward))
    return dist, cylinder.pos + pos @ cylinder.mat.T, jnp.stack([frame, frame])


def _from_cylinder(point: jax.Array, size: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Returns the signed distance [] from a cylinder's surface, and its gradient, of length 1 [3].

    Args:
      point: [3] in the cylinder's frame.
      size: the cylinder's radius and half length.
    """
    z_axis = jnp.eye(3, dtype=point.dtype)[2]
    outward, axis_distance = _direction(point * (1 - z_axis))
    # Beyond both the side and the cap the rim is closest; inside, whichever of the two is nearer.
    side = axis_distance - size[0]
    cap = jnp.abs(point[2]) - size[1]
    excess = jnp.maximum(jnp.stack([side, cap]), 0)
    length = jnp.sqrt(jnp.dot(excess, excess))
    surface_mask = jnp.stack([side >= cap, side < cap]).astype(point.dtype)
    share = jnp.where(length > 0, excess / jnp.where(length > 0, length, 1), surface_mask)
    gradient = share[0] * outward + share[1] * jnp.where(point[2] > 0, z_axis, -z_axis)
    return jnp.where(length > 0, length, jnp.maximum(side, cap)), gradient


def _closest_along(
    center: jax.Array, axis: jax.Array, half: jax.Array, size: jax.Array
) -> jax.Array:
    """Returns where a line segment is closest to a cylinder, from its center [].

    The distance is convex along the segment: its slope is bisected, for the first and the last of
    the places that are equally close, of which this is the middle.
    """
    # Slopes between these two count as zero: rounding leaves such of parallel lines.
    levels = jnp.asarray([-1, 1], axis.dtype) * jnp.sqrt(jnp.finfo(axis.dtype).eps)

    def halve(span: jax.Array, _: None) -> tuple[jax.Array, None]:
        places = (span[0] + span[1]) / 2
        points = center + places[:, None] * axis
        slope = jax.vmap(lambda point: _from_cylinder(point, size)[1])(points) @ axis
        is_low = slope < levels
        return jnp.where(is_low, jnp.stack([places, span[1]]), jnp.stack([span[0], places])), None

    # Both bisections at once, [lower and upper end, first and last place].
    span = half * jnp.asarray([[-1, -1], [1, 1]], axis.dtype)
    # As many halvings as the mantissa has bits: an interval cannot be smaller.
    steps = jnp.finfo(axis.dtype).nmant
    unroll = not is_written_out()  # see `fenced`
    return jnp.mean(lax.scan(halve, span, None, steps, unroll=unroll)[0])


def _above_polygon(
    center: jax.Array, axis: jax.Array, half: jax.Array, radius: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Returns from where to where a segment is above a regular polygon, in reverse if nowhere.

    The polygon has 16 corners on a circle about the origin, one of them on the x axis.
    """
    # The outward normals of the sides, and how far the segment's center is inside each of them.
    angle = (np.arange(16) + 0.5) * np.pi / 8
    normals = jnp.asarray(np.stack([np.cos(angle), np.sin(angle)], 1), axis.dtype)
    room = radius * np.cos(np.pi / 16) - normals @ center[:2]
    speed = normals @ axis[:2]
    # It is in the polygon once it has entered all sides that it goes toward, until it leaves one.
    crossings = room / jnp.where(speed == 0, 1, speed)
    start = jnp.max(jnp.where(speed < 0, crossings, -half))
    end = jnp.min(jnp.where(speed > 0, crossings, half))
    is_outside = jnp.any((speed == 0) & (room < 0))
    return jnp.where(is_outside, half, jnp.maximum(start, -half)), jnp.minimum(end, half)


def _collide_points(plane: GeomInfo, points: jax.Array) -> Collision:
    """Collides points [N, 3] with a plane."""
    normal = plane.mat[:, 2]
    dist = (points - plane.pos) @ normal
    frame = jnp.broadcast_to(make_frame(normal), (len(points), 3, 3))
    return dist, points - normal * dist[:, None] / 2, frame


def _collide_spheres(
    geom1: GeomInfo, point1: jax.Array, geom2: GeomInfo, point2: jax.Array
) -> Collision:
    """Collides spheres of two geoms' radii about given points."""
    normal, length = _direction(point2 - point1)
    # Points at one place have no direction between them: C then takes that across both axes.
    fallback_normal, _ = _direction(jnp.cross(geom1.mat[:, 2], geom2.mat[:, 2]))
    normal = jnp.where(length == 0, fallback_normal, normal)
    dist = length - (geom1.size[0] + geom2.size[0])
    return dist, point1 + normal * (geom1.size[0] + dist / 2), make_frame(normal)


def _direction(vector: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Returns a unit vector and the length; the x axis and 0 for what counts as no length."""
    square = jnp.dot(vector, vector)
    is_short = square < _MIN_LENGTH[square.dtype.name] ** 2
    length = jnp.sqrt(jnp.where(is_short, 1, square))
    unit = jnp.where(is_short, jnp.eye(3, dtype=vector.dtype)[0], vector / length)
    return unit, jnp.where(is_short, 0, length)


def one_by_one(collide: Collide) -> Collide:
    """Returns a collision function that gives the same contacts, wherever geoms touch.

    Of contacts between geoms that are apart only the sign of the distance is right.

    Args:
      collide: made by MJX's ``collider``, for geoms with a bounding sphere.
    """

    def collide_pairs(model: mjx.Model, data: mjx.Data, key: Any, geoms: Any) -> Any:
        """Collides pairs of geoms [P, 2], as ``collide``; written out, in a loop over them."""
        if model.npair or not is_written_out():  # pairs have margins of their own
            return collide(model, data, key, geoms)
        geom1, geom2 = geoms.T
        poses = data.geom_xpos, data.geom_xmat, model.geom_size
        spheres = model.geom_rbound[geom1] + model.geom_rbound[geom2]
        margins = model.geom_margin[geom1] + model.geom_margin[geom2]
        rows = *(jnp.stack([x[geom1], x[geom2]], 1) for x in poses), spheres, margins

        def collide_pair(
            pos: jax.Array, mat: jax.Array, size: jax.Array, spheres: Any, margin: jax.Array
        ) -> Any:
            """Collides one pair, whose pos, mat and size are [2, ...], if its spheres meet."""
            # All that a collision function reads of MJX's data and model.
            place = types.SimpleNamespace(geom_xpos=pos, geom_xmat=mat)
            shape = types.SimpleNamespace(geom_size=size)

            def near() -> Any:
                return collide(shape, place, key, np.array([[0, 1]]))

            dist, *pos_frame = jax.eval_shape(near)
            # A lower bound of the distance, which is above the margin: the contact is not active.
            gap = jnp.linalg.norm(pos[1] - pos[0]) - spheres
            return lax.cond(
                gap > margin,
                lambda: (
                    jnp.full(dist.shape, gap),
                    *(jnp.zeros(x.shape, x.dtype) for x in pos_frame),
                ),
                near,
            )

        contacts = short_scan(lambda _, row: (None, collide_pair(*row)), None, rows)[1]
        return jax.tree.map(jnp.concatenate, contacts)

    # MJX asks a collision function for how many contacts a pair has.
    collide_pairs.ncon = collide.ncon  # pyright: ignore
    return collide_pairs


_LIKE_C = {
    (mjx.GeomType.PLANE, mjx.GeomType.CAPSULE): plane_capsule,
    (mjx.GeomType.PLANE, mjx.GeomType.CYLINDER): plane_cylinder,
    (mjx.GeomType.PLANE, mjx.GeomType.BOX): plane_box,
    (mjx.GeomType.SPHERE, mjx.GeomType.CAPSULE): sphere_capsule,
    (mjx.GeomType.CAPSULE, mjx.GeomType.CAPSULE): capsule_capsule,
    (mjx.GeomType.SPHERE, mjx.GeomType.CYLINDER): sphere_cylinder,
    (mjx.GeomType.CAPSULE, mjx.GeomType.CYLINDER): capsule_cylinder,
    (mjx.GeomType.SPHERE, mjx.GeomType.BOX): boxes.sphere_box,
    (mjx.GeomType.CAPSULE, mjx.GeomType.BOX): boxes.capsule_box,
    (mjx.GeomType.BOX, mjx.GeomType.BOX): boxes.box_box,
}
_SEARCH_REASON = "which MJX finds in ten steps of a search"
_POINTS_REASON = "of which MJX finds fewer points than C MuJoCo, in other places"
_MESH_PAIRS = "SPHERE MESH, CAPSULE MESH, BOX MESH, MESH MESH, PLANE MESH"
_FIELD_PAIRS = "HFIELD SPHERE, HFIELD CAPSULE, HFIELD BOX, HFIELD MESH"
_ELLIPSOID_PAIRS = "SPHERE ELLIPSOID, CAPSULE ELLIPSOID, ELLIPSOID ELLIPSOID, ELLIPSOID CYLINDER"


def _pairs(pair_names: str) -> list[tuple[mjx.GeomType, ...]]:
    """Returns pairs of types of geoms."""
    return [tuple(mjx.GeomType[x] for x in pair.split()) for pair in pair_names.split(", ")]


#: Pairs of types of geoms, in MJX's order, whose contacts are at other places than C's, and how.
#: ``python -m experiments.checks.contacts`` compares all others with C.
UNLIKE_C: dict[tuple[mjx.GeomType, ...], str] = {
    **dict.fromkeys(_pairs(f"{_ELLIPSOID_PAIRS}, CYLINDER CYLINDER"), _SEARCH_REASON),
    **dict.fromkeys(_pairs(f"{_MESH_PAIRS}, {_FIELD_PAIRS}"), _POINTS_REASON),
}
#: Those that are like C's only without a margin: C leaves out contacts of boxes that an edge keeps
#: apart by more, and a collision function does not know the margin.
UNLIKE_C_WITHIN_MARGIN = frozenset(_pairs("BOX BOX"))
_SOLID_GEOMS = {getattr(mjx.GeomType, x) for x in ("SPHERE", "CAPSULE", "CYLINDER", "BOX")}


def _functions(colliders: dict[Any, Collide]) -> dict[Any, Collide]:
    """Returns the collision functions: MJX's, and in their place ours."""
    functions = colliders | _LIKE_C
    for pair, function in functions.items():
        # A plane has no bounding sphere to compare: its ``geom_rbound`` is zero.
        if set(pair) <= _SOLID_GEOMS:
            functions[pair] = one_by_one(function)
    return functions


#: ``mjx.collision`` and ``mjx.make_data`` with this module's contacts.
collision = mjx_internals.collision_with(_functions)
make_data = mjx_internals.data_with(_functions)


def fwd_position(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Computes what depends on position: ``mjx.fwd_position`` with this module's contacts."""
    # The stages of ``mj_fwdPosition``. MJX's function binds its own collisions and rows.
    data = mjx_internals.kinematics(model, data)
    data = mjx.com_pos(model, data)
    data = mjx.camlight(model, data)
    data = mjx.tendon(model, data)
    data = mjx.crb(model, data)
    data = inertia.tendon_armature(model, data)
    data = mjx.factor_m(model, data)
    data = collision(model, data)
    data = make_constraint(model, data)
    return mjx.transmission(model, data)
