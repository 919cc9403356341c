"""Contacts as C MuJoCo makes them, where MJX makes others.

Gymnasium runs C MuJoCo, and MJX 3.17 departs from it in three collision functions, by enough to
change an episode; these agree with MuJoCo 4.0 (``engine_collision_primitive.c``) to rounding.

- ``plane_capsule``: MJX's contact frame no longer follows a capsule that is more than 60 degrees
  from the plane, and the friction pyramid turns with the frame.
- ``sphere_capsule`` and ``capsule_capsule``: MJX adds 1e-6 to its denominators.

One difference remains. Capsules within 1e-4 rad of parallel meet in two contacts in C, at the
ends of their overlap, and here in one, at its middle: the number of rows is static in JAX, so that
every pair of capsules would pay for a second row (a fifth of Humanoid's time on a CPU). None of
60,000 states of Humanoid, HumanoidStandup and Hopper under random actions had such a pair.

``fwd_position`` is MJX's with these three in the table of collision functions.
"""

import jax
import jax.numpy as jnp
from mujoco import mjx

from mjx_reinforce.physics import inertia
from mjx_reinforce.physics.mjx_internals import (
    Collision,
    GeomInfo,
    collider,
    collision_with,
    make_frame,
)
from mjx_reinforce.physics.pairs import one_by_one
from mjx_reinforce.physics.rows import make_constraint

# What C takes for zero (mjMINVAL); in single precision, what rounding may leave of a zero distance
# between points a few metres from the origin. Axes that cross, as in a planar Hopper, have that.
_MIN_LENGTH = {"float64": 1e-15, "float32": 2e-6}
# Capsules are parallel in C (``mjc_segWeights``) below this square of their angle's sine.
_PARALLEL = 1e-8


@collider(ncon=2)
def plane_capsule(plane: GeomInfo, capsule: GeomInfo) -> Collision:
    """Collides both ends of a capsule with a plane; the first tangents follow its axis."""
    normal, axis = plane.mat[:, 2], capsule.mat[:, 2]
    tangent, _ = _direction(axis - normal * jnp.dot(normal, axis))
    frame = jnp.stack([normal, tangent, jnp.cross(normal, tangent)])
    segment = axis * capsule.size[1]
    ends = capsule.pos + jnp.stack([segment, -segment])
    dist = (ends - plane.pos) @ normal - capsule.size[0]
    pos = ends - normal * (capsule.size[0] + dist[:, None] / 2)
    return dist, pos, jnp.stack([frame, frame])


@collider(ncon=1)
def sphere_capsule(sphere: GeomInfo, capsule: GeomInfo) -> Collision:
    """Collides a sphere with the point of a capsule's axis that is closest to it."""
    axis, half = capsule.mat[:, 2], capsule.size[1]
    along = jnp.clip(jnp.dot(axis, sphere.pos - capsule.pos), -half, half)
    return _collide_spheres(sphere, sphere.pos, capsule, capsule.pos + along * axis)


@collider(ncon=1)
def capsule_capsule(first: GeomInfo, second: GeomInfo) -> Collision:
    """Collides two capsules where their axes are closest."""
    point1, point2 = _closest_points(first, second)
    return _collide_spheres(first, point1, second, point2)


def _closest_points(first: GeomInfo, second: GeomInfo) -> tuple[jax.Array, jax.Array]:
    """Returns the point of each capsule's axis that is closest to the other's axis, [3] each."""
    axis1, axis2 = first.mat[:, 2] * first.size[1], second.mat[:, 2] * second.size[1]
    offset = first.pos - second.pos

    def meet(along1: float | jax.Array) -> jax.Array:
        """Returns a place on the first axis and the closest on the second, in half lengths."""
        free = jnp.dot(offset + along1 * axis1, axis2) / jnp.dot(axis2, axis2)
        along2 = jnp.clip(free, -1, 1)
        back = jnp.dot(along2 * axis2 - offset, axis1) / jnp.dot(axis1, axis1)
        return jnp.stack([jnp.where(free == along2, along1, jnp.clip(back, -1, 1)), along2])

    normal = jnp.cross(axis1, axis2)
    square, scale = jnp.dot(normal, normal), jnp.dot(axis1, axis1) * jnp.dot(axis2, axis2)
    parallel = square <= _PARALLEL * scale
    crossing = jnp.dot(normal, jnp.cross(axis2, offset)) / jnp.where(parallel, scale, square)
    middle = (meet(-1.0) + meet(1.0)) / 2
    along1, along2 = jnp.where(parallel, middle, meet(jnp.clip(crossing, -1, 1)))
    return first.pos + along1 * axis1, second.pos + along2 * axis2


def _collide_spheres(
    first: GeomInfo, point1: jax.Array, second: GeomInfo, point2: jax.Array
) -> Collision:
    """Collides spheres of two geoms' radii about given points."""
    normal, length = _direction(point2 - point1)
    across, _ = _direction(jnp.cross(first.mat[:, 2], second.mat[:, 2]))
    normal = jnp.where(length == 0, across, normal)
    dist = length - (first.size[0] + second.size[0])
    return dist, point1 + normal * (first.size[0] + dist / 2), make_frame(normal)


def _direction(vector: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Returns a unit vector and the length; the x axis and 0 for what counts as no length."""
    square = jnp.dot(vector, vector)
    short = square < _MIN_LENGTH[square.dtype.name] ** 2
    length = jnp.sqrt(jnp.where(short, 1, square))
    unit = jnp.where(short, jnp.eye(3, dtype=vector.dtype)[0], vector / length)
    return unit, jnp.where(short, 0, length)


_OURS = {
    (mjx.GeomType.PLANE, mjx.GeomType.CAPSULE): plane_capsule,
    (mjx.GeomType.SPHERE, mjx.GeomType.CAPSULE): sphere_capsule,
    (mjx.GeomType.CAPSULE, mjx.GeomType.CAPSULE): capsule_capsule,
}
_ROUND_GEOMS = (
    mjx.GeomType.SPHERE,
    mjx.GeomType.CAPSULE,
    mjx.GeomType.ELLIPSOID,
    mjx.GeomType.CYLINDER,
)
_collision = collision_with(
    lambda table: {
        pair: one_by_one(function) if set(pair) <= set(_ROUND_GEOMS) else function
        for pair, function in (table | _OURS).items()
    }
)


def fwd_position(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Computes what depends on position: ``mjx.fwd_position`` with this module's contacts."""
    data = mjx.kinematics(model, data)
    data = mjx.com_pos(model, data)
    data = mjx.camlight(model, data)
    data = mjx.tendon(model, data)
    data = mjx.crb(model, data)
    data = inertia.tendon_armature(model, data)
    data = mjx.factor_m(model, data)
    data = _collision(model, data)
    data = make_constraint(model, data)
    return mjx.transmission(model, data)
