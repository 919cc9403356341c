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
FAR = 1e3
# By precision, what C takes for zero: a length, the square of the sine between edges, a component
# of a normal, the square of the distance of two corners by that of their face, and a penetration
# by the sum of half lengths.
_ZERO = {
    "float64": {"length": 1e-15, "sine": 1e-16, "part": 1e-9, "twin": 1e-14, "depth": 1e-13},
    "float32": {"length": 2e-6, "sine": 1e-7, "part": 1e-5, "twin": 1e-10, "depth": 1e-6},
}
# The corners of a rectangle in turn, by the signs of the two coordinates.
_CORNERS = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])


def _chosen(which: jax.Array, values: jax.Array) -> jax.Array:
    """Returns the entry of the values [N, ...] at which [N] is True, 0 if none is."""
    return jnp.sum(jnp.where(which.reshape(-1, *[1] * (values.ndim - 1)), values, 0), axis=0)


def _first_least(values: jax.Array) -> jax.Array:
    """Returns which of the values [N] is the first of the least."""
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
    inside = square <= _ZERO[square.dtype.name]["length"] ** 2
    length = jnp.sqrt(jnp.where(inside, 1, square))
    depths = jnp.abs(jnp.stack([-box.size - center, box.size - center], axis=1)).ravel()
    nearest = _first_least(depths).reshape(3, 2)
    inward = nearest[:, 0].astype(square.dtype) - nearest[:, 1].astype(square.dtype)
    normal = jnp.where(inside, inward, offset / length)
    dist = jnp.where(inside, -jnp.min(depths), length) - radius
    pos = center + normal * (radius + dist / 2)
    return dist, box.pos + box.mat @ pos, make_frame(box.mat @ normal)


@collider(ncon=2)
def capsule_box(capsule: GeomInfo, box: GeomInfo) -> Collision:
    """Collides a capsule with a box where its axis is closest, and where C takes a second point."""
    center = (capsule.pos - box.pos) @ box.mat
    reach = capsule.mat[:, 2] @ box.mat * capsule.size[1]
    first, second = _along_capsule(center, reach, capsule, box.size)
    places = jnp.stack([first, first + second])
    none = ~jnp.isfinite(places)
    # Also where no contact is, all is finite: the solver multiplies it by zero.
    centers = center + jnp.where(none, 0, places)[:, None] * reach
    dist, pos, frame = jax.vmap(lambda x: _ball_on_box(x, capsule.size[0], box))(centers)
    return jnp.where(none, FAR, dist), pos, frame


# The edges of a box in C's order: the axis along which each runs, and the signs of the other two
# coordinates.
_RUNS = np.repeat(np.eye(3, dtype=bool), 4, axis=0)
_CORNER_OF = np.array([0, 2, 4, 6, 0, 1, 4, 5, 0, 1, 2, 3])[:, None] >> np.arange(3) & 1
_SIGNS = np.where(_RUNS, 0, 2 * _CORNER_OF - 1)


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
    ends = center + jnp.stack([-reach, reach])
    beyond = ends - jnp.clip(ends, -size, size)
    far = 2 * (capsule.size[0] + capsule.size[1] + jnp.sum(size))  # as in C, a length
    over = jnp.sum(beyond != 0, axis=1) <= 1
    squares = jnp.where(over, jnp.sum(beyond**2, axis=1), far)
    end, least = _first_least(squares), jnp.min(squares)
    first = jnp.where(least < far, jnp.where(end[0], -1.0, 1.0), jnp.inf)
    second = _from_face(_chosen(end, ends), -first * reach, size, _chosen(end, beyond) != 0)
    second = -first * second

    # An edge that is closer.
    on_edge, on_axis, sides, squares = _closest_on_edges(center, reach, size)
    number = -1
    for n in range(len(_RUNS)):
        closer = squares[n] < least - 1e-15
        least = jnp.where(closer, squares[n], least)
        number = jnp.where(closer, n, number)
    edge = jnp.arange(len(_RUNS)) == number
    runs = jnp.any(edge[:, None] & _RUNS, axis=0)
    side, place, along = (_chosen(edge, x) for x in (sides, on_edge, on_axis))
    differs = (reach > 0) ^ jnp.where(runs, side > 0, _chosen(edge, jnp.asarray(_SIGNS)) > 0)
    at_corner = _from_corner(along, reach, size, differs)
    on = jnp.where(side == 0, _from_edge(along, place, reach, size, differs, runs), at_corner)
    is_face = number < 0
    return jnp.where(is_face, first, along), jnp.where(is_face, second, on)


def _closest_on_edges(
    center: jax.Array, reach: jax.Array, size: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Returns where each edge of a box and a capsule's axis are closest, all [12].

    They are the place on the edge and on the axis, in half lengths; the end of the edge that C
    takes it for, -1 or 1, or 0; and the square of the distance, infinite if both are parallel.
    """
    half = jnp.sum(jnp.where(_RUNS, size, 0), axis=1)
    offset = _SIGNS * size - center
    edge, axis = half**2, jnp.dot(reach, reach)
    both = -half * jnp.sum(jnp.where(_RUNS, reach, 0), axis=1)
    by_edge = -half * jnp.sum(jnp.where(_RUNS, offset, 0), axis=1)
    by_axis = offset @ reach
    determinant = edge * axis - both**2
    zero = {"float64": 1e-15, "float32": 1e-12}[determinant.dtype.name]
    parallel = jnp.abs(determinant) < zero
    scale = jnp.where(parallel, 1, determinant)
    on_edge = (axis * by_edge - both * by_axis) / scale
    on_axis = (edge * by_axis - both * by_edge) / scale
    bound = jnp.clip(on_edge, -1, 1)
    side = jnp.sign(on_edge - bound)
    on_axis = jnp.where(side == 0, on_axis, (by_axis - both * bound) / axis)
    again = (by_edge - both * jnp.clip(on_axis, -1, 1)) / edge
    clamped = jnp.abs(on_axis) > 1
    on_axis = jnp.clip(on_axis, -1, 1)
    side = jnp.where(clamped & (jnp.abs(again) > 1), jnp.sign(again), side)
    on_edge = jnp.where(clamped, jnp.clip(again, -1, 1), bound)
    gap = offset - on_axis[:, None] * reach + jnp.where(_RUNS, (half * on_edge)[:, None], 0)
    return on_edge, on_axis, side, jnp.where(parallel, jnp.inf, jnp.sum(gap**2, axis=1))


def _from_face(start: jax.Array, reach: jax.Array, size: jax.Array, face: jax.Array) -> jax.Array:
    """Returns how far an axis goes from an end above a face until it leaves the face, at most 2."""
    meets = (jnp.stack([size, -size]) - start) / reach
    length = jnp.min(jnp.where(~face & (meets > 0), meets, 2))
    return jnp.where(jnp.any(face), jnp.minimum(length, 2), jnp.inf)


def _from_corner(
    first: jax.Array, reach: jax.Array, size: jax.Array, differs: jax.Array
) -> jax.Array:
    """Returns how far on the second point is: along an edge of the corner, or across a face."""
    several = jnp.sum(differs) == 2
    axis = jnp.where(several, ~differs, differs)
    sign = jnp.where(several, -1, 1)
    room = 2 * size / jnp.abs(reach)
    ahead = jnp.minimum(1 - sign * first, _chosen(axis, room))
    across = jnp.minimum(1 + sign * first, jnp.min(jnp.where(axis, jnp.inf, room)))
    along = _chosen(axis, reach) ** 2 > 0.5 * jnp.dot(reach, reach)
    none = jnp.all(differs) | ~jnp.any(differs)
    return jnp.where(none, jnp.inf, sign * jnp.where(along, ahead, -across))


def _from_edge(
    first: jax.Array,
    on_edge: jax.Array,
    reach: jax.Array,
    size: jax.Array,
    differs: jax.Array,
    runs: jax.Array,
) -> jax.Array:
    """Returns how far on the second point is, across the face that the axis is less inclined to."""
    after, before = jnp.roll(runs, 1), jnp.roll(runs, 2)
    steep = jnp.abs(reach)
    wide = jnp.where(_chosen(after, steep) > _chosen(before, steep), after, before)
    differs = differs & ~runs
    ahead = jnp.any(differs & wide)
    sign = jnp.where(ahead, 1, -1)
    rest = 1 - jnp.where(jnp.any((reach > 0) & runs) == ahead, on_edge, -on_edge)
    length = jnp.minimum(1 - sign * first, _chosen(wide, 2 * size / steep))
    length = jnp.minimum(length, _chosen(runs, size / steep) * rest)
    return jnp.where(jnp.sum(differs) == 1, sign * length, jnp.inf)


@collider(ncon=8)
def box_box(first: GeomInfo, second: GeomInfo) -> Collision:
    """Collides boxes: at the corners of where two faces overlap, or where two edges cross."""
    turn = first.mat.T @ second.mat
    offset = (second.pos - first.pos) @ first.mat
    back = (first.pos - second.pos) @ second.mat
    sizes = jnp.stack([first.size, second.size])
    of_first = jnp.abs(offset) - first.size - jnp.abs(turn) @ second.size
    of_second = jnp.abs(back) - second.size - first.size @ jnp.abs(turn)
    faces = jnp.concatenate([of_first, of_second])
    axes, edges = _edge_axes(turn, offset, sizes)
    face, edge = _touching(faces, edges, jnp.concatenate([jnp.eye(3), turn.T]), axes)

    owned = jnp.any(face[:3])
    faces_meet = jax.tree.map(
        lambda x, y: jnp.where(owned, x, y),
        _meet_at_face(face[:3], turn, offset, sizes),
        _meet_at_face(face[3:], turn.T, back, sizes[::-1]),
    )
    dist, pos, normal = faces_meet
    place, mat = jnp.where(owned, first.pos, second.pos), jnp.where(owned, first.mat, second.mat)
    pos, normal = place + pos @ mat.T, mat @ jnp.where(owned, normal, -normal)

    crosses = jnp.any(edge)
    depth, middle, axis = _meet_at_edges(
        edge.reshape(3, 3), _chosen(edge, axes), turn, offset, sizes
    )
    dist = jnp.where(crosses, jnp.where(np.arange(8) == 0, depth, FAR), dist)
    pos = jnp.where(crosses, first.pos + first.mat @ middle, pos)
    frame = make_frame(jnp.where(crosses, first.mat @ axis, normal))
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
    parallel = squares < _ZERO[turn.dtype.name]["sine"]
    axes = axes / jnp.sqrt(jnp.where(parallel, 1, squares))[:, None]
    gaps = jnp.abs(axes @ offset) - jnp.abs(axes) @ sizes[0] - jnp.abs(axes @ turn) @ sizes[1]
    return axes, jnp.where(parallel, -jnp.inf, gaps)


def _touching(
    faces: jax.Array, edges: jax.Array, normals: jax.Array, axes: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Returns which face [6] boxes touch with, or which two edges [9]: where the gap is largest.

    Edges must be better than faces, by more where both have almost one direction.

    Args:
      faces: the gap along the normal of each face, [6].
      edges: the gap across each two edges, [9].
      normals: the faces' directions, [6, 3].
      axes: the edges' directions, [9, 3].
    """
    face, of_face = _first_least(-faces), jnp.max(faces)
    best, number = of_face, -1
    for n in range(9):
        better = (edges[n] - 1e-6 * jnp.abs(edges[n]) > best) & (edges[n] > of_face)
        best, number = jnp.where(better, edges[n], best), jnp.where(better, n, number)
    edge = jnp.arange(9) == number
    alike = jnp.abs(jnp.dot(_chosen(edge, axes), _chosen(face, normals))) > 0.99
    like_face = alike & (best < of_face + 0.05 * jnp.abs(of_face) + 1e-15)
    return face & ((number < 0) | like_face), edge & ~like_face


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
    slopes = _chosen(axis, turn)
    other = _first_least(-jnp.abs(slopes))
    toward = jnp.where(sign * _chosen(other, slopes) > 0, -1, 1)
    local = jnp.stack([jnp.roll(axis, 1), jnp.roll(axis, 2), axis]).astype(turn.dtype)
    up = jnp.stack([jnp.ones_like(sign), jnp.ones_like(sign), sign])

    def column(which: jax.Array) -> jax.Array:
        return up * (local @ (_chosen(which, sizes[1]) * _chosen(which, turn.T)))

    half, height = (local @ sizes[0])[:2], _chosen(axis, sizes[0])
    center = up * (local @ offset) + toward * column(other) - jnp.array([0, 0, 1]) * height
    across = jnp.stack([column(jnp.roll(other, 1)), column(jnp.roll(other, 2))])
    determinant = across[0, 0] * across[1, 1] - across[0, 1] * across[1, 0]

    corners = center + _CORNERS @ across
    sides = jnp.roll(corners, -1, axis=0) - corners
    enters, meets = _entry(corners[:, :2], sides[:, :2], half)
    of_other = corners + enters[:, None] * sides

    back = jnp.array([[across[1, 1], -across[1, 0]], [-across[0, 1], across[0, 0]]]) / determinant
    around = jnp.where(determinant < 0, np.array([-1, 1]), 1)
    corners = (jnp.asarray(_CORNERS) * around * half - center[:2]) @ back.T
    sides = jnp.roll(corners, -1, axis=0) - corners
    enters, meets_back = _entry(corners, sides, jnp.ones(2))
    of_own = center + (corners + enters[:, None] * sides) @ across

    points = jnp.concatenate([of_other, of_own])
    different = _different(points, jnp.concatenate([meets, meets_back]), jnp.dot(half, half))
    dist = jnp.where(different, points[:, 2], FAR)
    places = points.at[:, 2].set(sign * (height + points[:, 2] / 2))
    return dist, places @ local, sign * axis.astype(turn.dtype)


def _entry(starts: jax.Array, steps: jax.Array, half: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Returns where lines of one step enter a rectangle, from 0 to 1, and whether they do.

    Args:
      starts: [N, 2].
      steps: [N, 2].
      half: half the sides of the rectangle, which is about the origin, [2].
    """
    half = half * (1 + _ZERO[starts.dtype.name]["depth"])
    flat = steps == 0
    meets = (jnp.stack([-half, half])[:, None] - starts) / jnp.where(flat, 1, steps)
    first = jnp.max(jnp.where(flat, 0, jnp.min(meets, axis=0)), axis=1)
    last = jnp.min(jnp.where(flat, 1, jnp.max(meets, axis=0)), axis=1)
    inside = jnp.all(~flat | (jnp.abs(starts) <= half), axis=1)
    first, last = jnp.maximum(first, 0), jnp.minimum(last, 1)
    return first, inside & (first <= last)


def _different(points: jax.Array, meets: jax.Array, square: jax.Array) -> jax.Array:
    """Returns which points [8, 3] are corners, and not at the place of another corner."""
    near = _ZERO[points.dtype.name]["twin"] * square
    chosen: list[jax.Array] = []
    for n in range(8):
        gaps = points[:n, :2] - points[n, :2]
        same = [x & (jnp.dot(gap, gap) < near) for x, gap in zip(chosen, gaps, strict=True)]
        twin = jnp.any(jnp.stack(same)) if same else False
        chosen.append(meets[n] & ~twin)
    return jnp.stack(chosen)


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
    runs = jnp.any(edge, axis=1), jnp.any(edge, axis=0)
    axis = jnp.where(jnp.dot(axis, offset) < 0, -axis, axis)
    own = axis @ turn
    part = _ZERO[axis.dtype.name]["part"]
    corner = jnp.where(runs[0], 0, jnp.where(axis >= 0, sizes[0], -sizes[0]))
    other = jnp.where(runs[1], 0, jnp.where(own >= 0, -sizes[1], sizes[1]))
    along = _chosen(runs[1], turn.T)
    cosine = _chosen(runs[0], along)
    half, other_half = _chosen(runs[0], sizes[0]), _chosen(runs[1], sizes[1])

    def closest(flips: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Returns the closest points [3] of two edges, and the square of their distance."""
        start = jnp.where((jnp.abs(axis) < part) & flips[0], -corner, corner)
        end = offset + turn @ jnp.where((jnp.abs(own) < part) & flips[1], -other, other)
        gap = end - start
        first, second = _chosen(runs[0], gap), jnp.dot(along, gap)
        scale = jnp.maximum(1 - cosine**2, _ZERO[axis.dtype.name]["sine"])
        place = jnp.clip((first - cosine * second) / scale, -half, half)
        there = jnp.clip(cosine * place - second, -other_half, other_half)
        place = jnp.clip(first + cosine * there, -half, half)
        ends = start + jnp.where(runs[0], place, 0), end + there * along
        return *ends, jnp.sum((ends[1] - ends[0]) ** 2)

    # Where the axis is almost along a face, either edge of the face may be the one: the closer is.
    ways = jnp.array([[False, False], [False, True], [True, False], [True, True]])
    starts, ends, squares = jax.vmap(closest)(ways)
    best = _first_least(squares)
    start, end = _chosen(best, starts), _chosen(best, ends)
    return jnp.dot(end - start, axis), (start + end) / 2, axis
