"""Contacts of boxes as C MuJoCo makes them: with spheres, capsules, and boxes.

MJX's answers are others: a capsule that is longer than a box or inside it has one contact more or
less, and two boxes have at most four contacts instead of eight. These functions compute C's
(``mjc_SphereBox``, ``mjc_CapsuleBox`` and ``mjc_BoxBox``) without branches. A vector of booleans
with at most one True chooses among the entries of another (``_chosen``).
"""

import jax
import jax.numpy as jnp
import numpy as np

from mjx_reinforce.engine.physics.mjx_internals import Collision, GeomInfo, collider, make_frame

#: A distance at which nothing touches, in meters.
FAR_DIST = 1e3
# By precision, what C takes for zero: a length, the square of the sine between edges, a component
# of a normal, the square of the distance of two corners by that of their face, and a penetration
# by the sum of half lengths.
_ZERO = {
    "float64": {"length": 1e-15, "sine": 1e-16, "part": 1e-9, "twin": 1e-14, "depth": 1e-13},
    "float32": {"length": 2e-6, "sine": 1e-7, "part": 1e-5, "twin": 1e-10, "depth": 1e-6},
}
# The corners of a rectangle in turn, by the signs of the two coordinates.
_CORNERS = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])


def _chosen(choice: jax.Array, values: jax.Array) -> jax.Array:
    """Returns the entry of the values [N, ...] where the choice [N] is True, 0 if nowhere."""
    return jnp.sum(jnp.where(choice.reshape(-1, *[1] * (values.ndim - 1)), values, 0), axis=0)


def _first_least(values: jax.Array) -> jax.Array:
    """Returns the choice [N] of the first of the least values [N]."""
    return jnp.arange(len(values)) == jnp.argmin(values)


@collider(ncon=1)
def sphere_box(sphere: GeomInfo, box: GeomInfo) -> Collision:
    """Collides a sphere with a box at its nearest point, from inside at its nearest face."""
    center = (sphere.pos - box.pos) @ box.mat
    return _ball_on_box(center, sphere.size[0], box)


def _ball_on_box(center: jax.Array, radius: jax.Array, box: GeomInfo) -> Collision:
    """Collides a sphere, whose center [3] is in the box's frame, with the box."""
    offset = jnp.clip(center, -box.size, box.size) - center
    square = jnp.dot(offset, offset)
    is_inside = square <= _ZERO[square.dtype.name]["length"] ** 2
    length = jnp.sqrt(jnp.where(is_inside, 1, square))
    # Of the six faces, in C's order: at a tie C takes the first.
    depths = jnp.abs(jnp.stack([-box.size - center, box.size - center], axis=1)).ravel()
    face = _first_least(depths).reshape(3, 2)
    inward = face[:, 0].astype(square.dtype) - face[:, 1].astype(square.dtype)
    normal = jnp.where(is_inside, inward, offset / length)
    dist = jnp.where(is_inside, -jnp.min(depths), length) - radius
    pos = center + normal * (radius + dist / 2)
    return dist, box.pos + box.mat @ pos, make_frame(box.mat @ normal)


@collider(ncon=2)
def capsule_box(capsule: GeomInfo, box: GeomInfo) -> Collision:
    """Collides a capsule with a box where its axis is closest, and where C takes a second point."""
    center = (capsule.pos - box.pos) @ box.mat
    reach = capsule.mat[:, 2] @ box.mat * capsule.size[1]
    first_place, step = _along_capsule(center, reach, capsule, box.size)
    places = jnp.stack([first_place, first_place + step])
    is_missing = ~jnp.isfinite(places)
    # Also where no contact is, all is finite: the solver multiplies it by zero.
    centers = center + jnp.where(is_missing, 0, places)[:, None] * reach
    # As C: at both places the capsule is a sphere.
    dist, pos, frame = jax.vmap(lambda x: _ball_on_box(x, capsule.size[0], box))(centers)
    return jnp.where(is_missing, FAR_DIST, dist), pos, frame


# The edges of a box in C's order: the axis along which each runs, and the signs of the other two
# coordinates. Of 32 bits: where a process has numbers of both precisions, JAX 0.10.2 may run a
# program for 32 bits on an array of 64.
_AXES = np.repeat(np.eye(3, dtype=bool), 4, axis=0)
_CORNER_BITS = np.array([0, 2, 4, 6, 0, 1, 4, 5, 0, 1, 2, 3])[:, None] >> np.arange(3) & 1
_SIGNS = np.where(_AXES, 0, 2 * _CORNER_BITS - 1).astype(np.int32)


def _along_capsule(
    center: jax.Array, reach: jax.Array, capsule: GeomInfo, size: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Returns the point of a capsule's axis that is closest to a box, and how far on C's second is.

    Both are in half lengths of the capsule, the first from -1 to 1; infinite if there is none.

    Args:
      center: [3] of the capsule, in the box's frame.
      reach: from its center to the end of its axis [3], in the box's frame.
      capsule: the capsule.
      size: [3] of the box.
    """
    # An end that is in the box or above a face.
    tips = center + jnp.stack([-reach, reach])
    excess = tips - jnp.clip(tips, -size, size)
    # C compares squares with this length: ``bestdistmax``, which has the margin besides.
    far_square = 2 * (capsule.size[0] + capsule.size[1] + jnp.sum(size))
    is_over_face = jnp.sum(excess != 0, axis=1) <= 1
    squares = jnp.where(is_over_face, jnp.sum(excess**2, axis=1), far_square)
    end = _first_least(squares)
    least_square = jnp.min(squares)
    end_place = jnp.where(least_square < far_square, jnp.where(end[0], -1.0, 1.0), jnp.inf)
    end_step = _from_face(_chosen(end, tips), -end_place * reach, size, _chosen(end, excess) != 0)
    end_step = -end_place * end_step

    # An edge that is closer, by more than mjMINVAL: C's guard against an axis that is parallel to
    # the box but for rounding. C looks at one edge after the other, so that the margin adds up.
    edge_places, axis_places, sides, squares = _closest_on_edges(center, reach, size)
    edge_number = -1
    for n in range(len(_AXES)):
        is_closer = squares[n] < least_square - 1e-15
        least_square = jnp.where(is_closer, squares[n], least_square)
        edge_number = jnp.where(is_closer, n, edge_number)
    edge = jnp.arange(len(_AXES)) == edge_number
    axis = jnp.any(edge[:, None] & _AXES, axis=0)
    side, edge_place, axis_place = (_chosen(edge, x) for x in (sides, edge_places, axis_places))
    # Along which coordinates capsule and corner point to different sides: ``axisdir ^ clcorner``.
    is_opposed = (reach > 0) ^ jnp.where(axis, side > 0, _chosen(edge, jnp.asarray(_SIGNS)) > 0)
    corner_step = _from_corner(axis_place, reach, size, is_opposed)
    is_inner = side == 0
    edge_step = _from_edge(axis_place, edge_place, reach, size, is_opposed, axis)
    edge_step = jnp.where(is_inner, edge_step, corner_step)
    is_face = edge_number < 0
    place = jnp.where(is_face, end_place, axis_place)
    return place, jnp.where(is_face, end_step, edge_step)


def _closest_on_edges(
    center: jax.Array, reach: jax.Array, size: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Returns where each edge of a box and a capsule's axis are closest, all [12].

    They are the place on the edge and on the axis, in half lengths; the end of the edge that C
    takes it for, -1 or 1, or 0; and the square of the distance, infinite if both are parallel.
    """
    # The normal equations of the distance between the two lines, in half lengths of each: ma, mb,
    # mc, u and v of ``mjraw_CapsuleBox``.
    half = jnp.sum(jnp.where(_AXES, size, 0), axis=1)
    offset = _SIGNS * size - center
    edge_square = half**2
    axis_square = jnp.dot(reach, reach)
    product = -half * jnp.sum(jnp.where(_AXES, reach, 0), axis=1)
    edge_product = -half * jnp.sum(jnp.where(_AXES, offset, 0), axis=1)
    axis_product = offset @ reach
    determinant = edge_square * axis_square - product**2
    zero = {"float64": 1e-15, "float32": 1e-12}[determinant.dtype.name]
    is_parallel = jnp.abs(determinant) < zero
    scale = jnp.where(is_parallel, 1, determinant)
    edge_place = (axis_square * edge_product - product * axis_product) / scale
    axis_place = (edge_square * axis_product - product * edge_product) / scale
    # Off the edge's end, the place on the axis is that closest to the end. C then does the same at
    # the axis' ends; there the side stays that of before, unless the new place is off the edge.
    bound = jnp.clip(edge_place, -1, 1)
    side = jnp.sign(edge_place - bound)
    axis_place = jnp.where(side == 0, axis_place, (axis_product - product * bound) / axis_square)
    from_axis_end = (edge_product - product * jnp.clip(axis_place, -1, 1)) / edge_square
    is_clamped = jnp.abs(axis_place) > 1
    axis_place = jnp.clip(axis_place, -1, 1)
    side = jnp.where(is_clamped & (jnp.abs(from_axis_end) > 1), jnp.sign(from_axis_end), side)
    edge_place = jnp.where(is_clamped, jnp.clip(from_axis_end, -1, 1), bound)
    gap = offset - axis_place[:, None] * reach + jnp.where(_AXES, (half * edge_place)[:, None], 0)
    return edge_place, axis_place, side, jnp.where(is_parallel, jnp.inf, jnp.sum(gap**2, axis=1))


def _from_face(start: jax.Array, reach: jax.Array, size: jax.Array, face: jax.Array) -> jax.Array:
    """Returns how far an axis goes from an end above a face until it leaves the face, at most 2."""
    crossings = (jnp.stack([size, -size]) - start) / reach
    length = jnp.min(jnp.where(~face & (crossings > 0), crossings, 2))
    return jnp.where(jnp.any(face), jnp.minimum(length, 2), jnp.inf)


def _from_corner(
    place: jax.Array, reach: jax.Array, size: jax.Array, is_opposed: jax.Array
) -> jax.Array:
    """Returns how far on the second point is: along an edge of the corner, or across a face.

    Args:
      place: [] of the first point on the capsule's axis, in half lengths.
      reach: [3] as in ``_along_capsule``.
      size: [3] of the box.
      is_opposed: [3] along which coordinates capsule and corner point to different sides.
    """
    # Along one coordinate alone capsule and corner differ, or agree; C turns the second case into
    # the first by following the capsule backwards (``mul``).
    is_backward = jnp.sum(is_opposed) == 2
    axis = jnp.where(is_backward, ~is_opposed, is_opposed)
    sign = jnp.where(is_backward, -1, 1)
    # How far it is to the opposite face, in half lengths: neither way may overshoot it.
    room = 2 * size / jnp.abs(reach)
    edge_step = jnp.minimum(1 - sign * place, _chosen(axis, room))
    face_step = jnp.minimum(1 + sign * place, jnp.min(jnp.where(axis, jnp.inf, room)))
    is_along_edge = _chosen(axis, reach) ** 2 > 0.5 * jnp.dot(reach, reach)
    # A capsule that points to the corner, or away from it, meets the box there alone.
    is_missing = jnp.all(is_opposed) | ~jnp.any(is_opposed)
    return jnp.where(is_missing, jnp.inf, sign * jnp.where(is_along_edge, edge_step, -face_step))


def _from_edge(
    place: jax.Array,
    edge_place: jax.Array,
    reach: jax.Array,
    size: jax.Array,
    is_opposed: jax.Array,
    axis: jax.Array,
) -> jax.Array:
    """Returns how far on the second point is, across the face that the axis is less inclined to.

    Args:
      place: [] of the first point on the capsule's axis, in half lengths.
      edge_place: [] of that point on the edge.
      reach: [3] as in ``_along_capsule``.
      size: [3] of the box.
      is_opposed: [3] along which coordinates capsule and edge point to different sides.
      axis: [3] along which coordinate the edge runs.
    """
    # The two coordinates across the edge: the face is wide along the steeper one.
    next_axis = jnp.roll(axis, 1)
    last_axis = jnp.roll(axis, 2)
    steepness = jnp.abs(reach)
    is_next_steeper = _chosen(next_axis, steepness) > _chosen(last_axis, steepness)
    face_axis = jnp.where(is_next_steeper, next_axis, last_axis)
    is_opposed = is_opposed & ~axis
    is_ahead = jnp.any(is_opposed & face_axis)
    sign = jnp.where(is_ahead, 1, -1)
    # The way ends at the capsule's end, at the opposite face, or at the end of the edge.
    edge_room = 1 - jnp.where(jnp.any((reach > 0) & axis) == is_ahead, edge_place, -edge_place)
    length = jnp.minimum(1 - sign * place, _chosen(face_axis, 2 * size / steepness))
    length = jnp.minimum(length, _chosen(axis, size / steepness) * edge_room)
    # Where edge and capsule form a T, not an X, there is no second point.
    return jnp.where(jnp.sum(is_opposed) == 1, sign * length, jnp.inf)


@collider(ncon=8)
def box_box(box1: GeomInfo, box2: GeomInfo) -> Collision:
    """Collides boxes: at the corners of where two faces overlap, or where two edges cross."""
    # Stage 1 of ``mjc_BoxBox``: of 15 directions the one in which the boxes are farthest apart.
    turn = box1.mat.T @ box2.mat
    offset = (box2.pos - box1.pos) @ box1.mat
    offset2 = (box1.pos - box2.pos) @ box2.mat
    sizes = jnp.stack([box1.size, box2.size])
    gaps1 = jnp.abs(offset) - box1.size - jnp.abs(turn) @ box2.size
    gaps2 = jnp.abs(offset2) - box2.size - box1.size @ jnp.abs(turn)
    face_gaps = jnp.concatenate([gaps1, gaps2])
    axes, edge_gaps = _edge_axes(turn, offset, sizes)
    normals = jnp.concatenate([jnp.eye(3), turn.T])
    face, edge = _touching(face_gaps, edge_gaps, normals, axes)

    # Stage 2: the box whose face it is clips the other's. Both ways are computed, as JAX would.
    is_face1 = jnp.any(face[:3])
    face_contacts = jax.tree.map(
        lambda x, y: jnp.where(is_face1, x, y),
        _meet_at_face(face[:3], turn, offset, sizes),
        _meet_at_face(face[3:], turn.T, offset2, sizes[::-1]),
    )
    dist, pos, normal = face_contacts
    origin = jnp.where(is_face1, box1.pos, box2.pos)
    mat = jnp.where(is_face1, box1.mat, box2.mat)
    pos = origin + pos @ mat.T
    # MuJoCo's normals look from the first geom to the second.
    normal = mat @ jnp.where(is_face1, normal, -normal)

    # Two edges that cross have one contact; the other seven are far.
    is_crossing = jnp.any(edge)
    depth, edge_pos, axis = _meet_at_edges(
        edge.reshape(3, 3), _chosen(edge, axes), turn, offset, sizes
    )
    dist = jnp.where(is_crossing, jnp.where(np.arange(8) == 0, depth, FAR_DIST), dist)
    pos = jnp.where(is_crossing, box1.pos + box1.mat @ edge_pos, pos)
    frame = make_frame(jnp.where(is_crossing, box1.mat @ axis, normal))
    return dist, pos, jnp.broadcast_to(frame, (8, 3, 3))


def _edge_axes(turn: jax.Array, offset: jax.Array, sizes: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Returns the directions across an edge of each of two boxes, [9, 3], and the gaps along them.

    Args:
      turn: the axes of the second box in the first's frame, [3, 3].
      offset: its center, [3].
      sizes: of both, [2, 3].
    """
    axes = jnp.cross(jnp.eye(3)[:, None], turn.T[None]).reshape(9, 3)
    squares = jnp.sum(axes**2, axis=1)
    # Of nearly parallel edges the direction is rounding error, and the faces' normals cover it.
    is_parallel = squares < _ZERO[turn.dtype.name]["sine"]
    axes = axes / jnp.sqrt(jnp.where(is_parallel, 1, squares))[:, None]
    gaps = jnp.abs(axes @ offset) - jnp.abs(axes) @ sizes[0] - jnp.abs(axes @ turn) @ sizes[1]
    return axes, jnp.where(is_parallel, -jnp.inf, gaps)


def _touching(
    faces: jax.Array, edges: jax.Array, normals: jax.Array, axes: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Returns the face [6] that boxes touch with, or the two edges [9]: where the gap is largest.

    Edges must be better than faces, by more where both have almost one direction.

    Args:
      faces: the gap along the normal of each face, [6].
      edges: the gap across each two edges, [9].
      normals: the faces' directions, [6, 3].
      axes: the edges' directions, [9, 3].
    """
    face = _first_least(-faces)
    face_gap = jnp.max(faces)
    # At a tie a face is better for the solver: it has several contacts (``mjBOXBOX_EDGEBIAS``).
    best_gap = face_gap
    edge_number = -1
    for n in range(9):
        is_better = (edges[n] - 1e-6 * jnp.abs(edges[n]) > best_gap) & (edges[n] > face_gap)
        best_gap = jnp.where(is_better, edges[n], best_gap)
        edge_number = jnp.where(is_better, n, edge_number)
    # An edge almost along the face's normal (8 degrees) has to be better by 5% of the depth: else a
    # stack of boxes at rest would alternate between the two by rounding.
    edge = jnp.arange(9) == edge_number
    is_along_face = jnp.abs(jnp.dot(_chosen(edge, axes), _chosen(face, normals))) > 0.99
    is_face = is_along_face & (best_gap < face_gap + 0.05 * jnp.abs(face_gap) + 1e-15)
    return face & ((edge_number < 0) | is_face), edge & ~is_face


def _meet_at_face(
    axis: jax.Array, turn: jax.Array, offset: jax.Array, sizes: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Returns distances [8] and places [8, 3] of contacts, and their normal [3].

    They are the corners of what a face of the other box covers of this box's face. Each is where a
    side of one face enters the other, both followed in the same direction.

    Args:
      axis: which way this box's face looks, [3].
      turn: the axes of the other box in this box's frame, [3, 3].
      offset: its center, [3].
      sizes: of both, this box first, [2, 3].
    """
    sign = jnp.where(_chosen(axis, offset) >= 0, 1, -1)
    # The incident face: that of the other box which is most opposed to this one.
    slopes = _chosen(axis, turn)
    axis2 = _first_least(-jnp.abs(slopes))
    sign2 = jnp.where(sign * _chosen(axis2, slopes) > 0, -1, 1)
    # Coordinates in which this face is the plane z = 0, and its box below; the order of the axes is
    # a cyclic one, so that corners in turn stay in turn.
    basis = jnp.stack([jnp.roll(axis, 1), jnp.roll(axis, 2), axis]).astype(turn.dtype)
    flip = jnp.stack([jnp.ones_like(sign), jnp.ones_like(sign), sign])

    def half_edge(choice: jax.Array) -> jax.Array:
        return flip * (basis @ (_chosen(choice, sizes[1]) * _chosen(choice, turn.T)))

    half = (basis @ sizes[0])[:2]
    height = _chosen(axis, sizes[0])
    center = flip * (basis @ offset) + sign2 * half_edge(axis2) - jnp.array([0, 0, 1]) * height
    spans = jnp.stack([half_edge(jnp.roll(axis2, 1)), half_edge(jnp.roll(axis2, 2))])
    determinant = spans[0, 0] * spans[1, 1] - spans[0, 1] * spans[1, 0]

    # Where C clips a polygon by one side after the other (``clipHalfPlane``), the corners of the
    # overlap are computed at once: where the other face's sides enter this one ...
    corners = center + _CORNERS @ spans
    sides = jnp.roll(corners, -1, axis=0) - corners
    entries, is_entry1 = _entry(corners[:, :2], sides[:, :2], half)
    incident_points = corners + entries[:, None] * sides

    # ... and where this face's sides enter the other, in whose half edges they are given.
    inverse = jnp.array([[spans[1, 1], -spans[1, 0]], [-spans[0, 1], spans[0, 0]]]) / determinant
    winding = jnp.where(determinant < 0, np.array([-1, 1]), 1)
    corners = (jnp.asarray(_CORNERS) * winding * half - center[:2]) @ inverse.T
    sides = jnp.roll(corners, -1, axis=0) - corners
    entries, is_entry2 = _entry(corners, sides, jnp.ones(2))
    reference_points = center + (corners + entries[:, None] * sides) @ spans

    points = jnp.concatenate([incident_points, reference_points])
    is_corner = _different(points, jnp.concatenate([is_entry1, is_entry2]), jnp.dot(half, half))
    # The third coordinate is the distance; the contact is midway between the surfaces.
    dist = jnp.where(is_corner, points[:, 2], FAR_DIST)
    places = points.at[:, 2].set(sign * (height + points[:, 2] / 2))
    return dist, places @ basis, sign * axis.astype(turn.dtype)


def _entry(starts: jax.Array, steps: jax.Array, half: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Returns where lines of one step enter a rectangle, from 0 to 1, and whether they do.

    Args:
      starts: [N, 2].
      steps: [N, 2].
      half: half the sides of the rectangle, which is about the origin, [2].
    """
    # Corners on a side are in it, whatever the rounding: else a box on its equal loses contacts.
    half = half * (1 + _ZERO[starts.dtype.name]["depth"])
    is_parallel = steps == 0
    crossings = (jnp.stack([-half, half])[:, None] - starts) / jnp.where(is_parallel, 1, steps)
    # The segment is in the rectangle from where it has entered both strips to where it leaves one.
    entry_place = jnp.max(jnp.where(is_parallel, 0, jnp.min(crossings, axis=0)), axis=1)
    exit_place = jnp.min(jnp.where(is_parallel, 1, jnp.max(crossings, axis=0)), axis=1)
    is_inside = jnp.all(~is_parallel | (jnp.abs(starts) <= half), axis=1)
    entry_place = jnp.maximum(entry_place, 0)
    exit_place = jnp.minimum(exit_place, 1)
    return entry_place, is_inside & (entry_place <= exit_place)


def _different(points: jax.Array, is_entry: jax.Array, square: jax.Array) -> jax.Array:
    """Returns which points [8, 3] are corners, and not at the place of another corner."""
    bound = _ZERO[points.dtype.name]["twin"] * square
    is_corner: list[jax.Array] = []
    for n in range(8):
        # Only corners that stay count: of three at one place the first remains.
        gaps = points[:n, :2] - points[n, :2]
        twins = [x & (jnp.dot(gap, gap) < bound) for x, gap in zip(is_corner, gaps, strict=True)]
        has_twin = jnp.any(jnp.stack(twins)) if twins else False
        is_corner.append(is_entry[n] & ~has_twin)
    return jnp.stack(is_corner)


def _meet_at_edges(
    edge: jax.Array, axis: jax.Array, turn: jax.Array, offset: jax.Array, sizes: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Returns distance [], place [3] and normal [3] of a contact of two edges that cross.

    Args:
      edge: which edges, by the axis of each box that they are parallel to, [3, 3].
      axis: the direction across both, [3].
      turn: the axes of the second box in the first's frame, [3, 3].
      offset: its center, [3].
      sizes: of both, [2, 3].
    """
    edge_axis1 = jnp.any(edge, axis=1)
    edge_axis2 = jnp.any(edge, axis=0)
    # From the first box to the second, as MuJoCo's normals; ``axis2`` is in the second's frame.
    axis = jnp.where(jnp.dot(axis, offset) < 0, -axis, axis)
    axis2 = axis @ turn
    zero = _ZERO[axis.dtype.name]["part"]
    # A corner of each box's edge that supports the axis, toward the other box.
    corner1 = jnp.where(edge_axis1, 0, jnp.where(axis >= 0, sizes[0], -sizes[0]))
    corner2 = jnp.where(edge_axis2, 0, jnp.where(axis2 >= 0, -sizes[1], sizes[1]))
    direction2 = _chosen(edge_axis2, turn.T)
    cosine = _chosen(edge_axis1, direction2)
    half1 = _chosen(edge_axis1, sizes[0])
    half2 = _chosen(edge_axis2, sizes[1])

    def closest(is_flipped: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Returns the closest points [3] of two edges, and the square of their distance."""
        middle1 = jnp.where((jnp.abs(axis) < zero) & is_flipped[0], -corner1, corner1)
        corner = jnp.where((jnp.abs(axis2) < zero) & is_flipped[1], -corner2, corner2)
        middle2 = offset + turn @ corner
        gap = middle2 - middle1
        gap1 = _chosen(edge_axis1, gap)
        gap2 = jnp.dot(direction2, gap)
        scale = jnp.maximum(1 - cosine**2, _ZERO[axis.dtype.name]["sine"])
        # Clamped to the first edge, then solved again for the second, and back.
        place1 = jnp.clip((gap1 - cosine * gap2) / scale, -half1, half1)
        place2 = jnp.clip(cosine * place1 - gap2, -half2, half2)
        place1 = jnp.clip(gap1 + cosine * place2, -half1, half1)
        point1 = middle1 + jnp.where(edge_axis1, place1, 0)
        point2 = middle2 + place2 * direction2
        return point1, point2, jnp.sum((point2 - point1) ** 2)

    # Where the axis is almost along a face, either edge of the face may be the one: the closer is.
    is_flipped = jnp.array([[False, False], [False, True], [True, False], [True, True]])
    points1, points2, squares = jax.vmap(closest)(is_flipped)
    best_pair = _first_least(squares)
    point1 = _chosen(best_pair, points1)
    point2 = _chosen(best_pair, points2)
    return jnp.dot(point2 - point1, axis), (point1 + point2) / 2, axis
