r"""The constraint solver of C MuJoCo, with a line search that ends where it is exact.

The acceleration a minimises (MuJoCo's documentation, "Computation", "Constraint model")

    (a - a_s)' M (a - a_s) / 2 + \sum_i D_i min(0, J_i a - r_i)^2 / 2

with the unconstrained acceleration a_s, the constraints' Jacobian J, reference r and stiffness D;
rows of equality constraints count on both sides of zero. The cost is convex and quadratic for a
given set of active rows, so that Newton's method, with an exact line search, ends after finitely
many steps: once a full step leaves the set as it is, it led to the minimum.

MJX's own solver does the same steps, but its line search looks at three points in each of
`ls_iterations` (50) rounds, which `jax.vmap` carries out for every episode until the slowest is
done; here it looks at one point a round, and ends when no row changes any more.
"""

from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
from mujoco import mjx
from mujoco.mjx._src import support, types

# mjMINVAL: what C takes for zero.
_MIN_TRACE = 1e-15


class _Point(NamedTuple):
    """An acceleration and its cost.

    qacc: [nv]
    imbalance: [nv] M a minus the unconstrained forces
    residual: [rows] J a - r
    active: [rows] whether a row pushes
    cost: [] see above
    """

    qacc: jax.Array
    imbalance: jax.Array
    residual: jax.Array
    active: jax.Array
    cost: jax.Array


class _Search(NamedTuple):
    """Where Newton's method is.

    point: the acceleration it has
    count: [] steps it made
    settled: [] whether the last one led to the minimum
    """

    point: _Point
    count: jax.Array
    settled: jax.Array


class _Look(NamedTuple):
    """Where a line search is.

    low: [] a place with a negative derivative
    high: [] one with a positive derivative
    root: [] of the line found at the last place
    active: [rows] there
    count: [] places looked at
    settled: [] whether no row changed from the last place but one
    """

    low: jax.Array
    high: jax.Array
    root: jax.Array
    active: jax.Array
    count: jax.Array
    settled: jax.Array


class _Rows(NamedTuple):
    """The constraints.

    jacobian: [rows, nv] J
    reference: [rows] r
    stiffness: [rows] D
    equality: [rows] whether a row is active on both sides
    """

    jacobian: jax.Array
    reference: jax.Array
    stiffness: jax.Array
    equality: jax.Array


def supports(model: mjx.Model, data: mjx.Data) -> bool:
    """Tells whether `solve` is for this model: Newton, pyramidal cones, no friction loss."""
    return (
        model.opt.solver == mjx.SolverType.NEWTON
        and model.opt.cone == mjx.ConeType.PYRAMIDAL
        and not cast(types.DataJAX, data._impl).nf
    )


def solve(model: mjx.Model, data: mjx.Data) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Finds the acceleration under constraints, from the better of two starts.

    Args:
        model: a model that `supports` accepts; `iterations` and `ls_iterations` bound the loops.
        data: with its constraint rows made.

    Returns:
        The acceleration [nv], the constraints' joint forces [nv] and the rows' forces [rows].
    """
    impl = cast(types.DataJAX, data._impl)
    equality = jnp.arange(impl.efc_D.shape[0]) < impl.ne
    rows = _Rows(impl.efc_J, impl.efc_aref, impl.efc_D, equality)
    mass = support.full_m(model, data)
    smallest = model.opt.tolerance * jnp.maximum(jnp.trace(mass), _MIN_TRACE)

    def at(qacc: jax.Array) -> _Point:
        residual = rows.jacobian @ qacc - rows.reference
        active = rows.equality | (residual < 0)
        imbalance = mass @ qacc - data.qfrc_smooth
        strain = jnp.sum(jnp.where(active, rows.stiffness * residual**2, 0))
        cost = (jnp.dot(imbalance, qacc - data.qacc_smooth) + strain) / 2
        return _Point(qacc, imbalance, residual, active, cost)

    def improve(search: _Search) -> _Search:
        before = search.point
        qacc, decrement = _newton_step(mass, rows, before, model.opt.ls_iterations)
        after = at(qacc)
        settled = jnp.all(after.active == before.active) | (decrement < smallest)
        return _Search(after, search.count + 1, settled)

    start = at(data.qacc_smooth)
    if not model.opt.disableflags & types.DisableBit.WARMSTART:
        warm = at(data.qacc_warmstart)
        start = jax.tree.map(lambda w, s: jnp.where(warm.cost < start.cost, w, s), warm, start)
    end = jax.lax.while_loop(
        lambda search: ~search.settled & (search.count < model.opt.iterations),
        improve,
        _Search(start, jnp.int32(0), jnp.array(False)),
    ).point
    force = _force(rows, end)
    return end.qacc, rows.jacobian.T @ force, force


def _force(rows: _Rows, point: _Point) -> jax.Array:
    """Returns the rows' forces, [rows]."""
    return jnp.where(point.active, -rows.stiffness * point.residual, 0)


def _newton_step(
    mass: jax.Array, rows: _Rows, point: _Point, max_rounds: int
) -> tuple[jax.Array, jax.Array]:
    """Returns the least costly acceleration [nv] in the direction of Newton's step.

    And by how much the cost would fall [] if no row changed: half the product of gradient and
    step, which rounding spares; the difference of two costs it does not.
    """
    gradient = point.imbalance - rows.jacobian.T @ _force(rows, point)
    stiffness = jnp.where(point.active, rows.stiffness, 0)
    hessian = mass + (rows.jacobian.T * stiffness) @ rows.jacobian
    factor = jax.scipy.linalg.cho_factor(hessian)
    direction = -jax.scipy.linalg.cho_solve(factor, gradient)
    change = rows.jacobian @ direction
    slope = jnp.dot(direction, point.imbalance)
    curvature = jnp.dot(direction, mass @ direction)
    length = _line_search(rows, point, change, slope, curvature, max_rounds)
    return point.qacc + length * direction, -jnp.dot(gradient, direction) / 2


def _line_search(
    rows: _Rows,
    point: _Point,
    change: jax.Array,
    slope: jax.Array,
    curvature: jax.Array,
    max_rounds: int,
) -> jax.Array:
    """Returns the length of the step at which the cost's derivative along it is zero, [].

    The derivative increases and is linear as long as no row changes. Each round goes to the root
    of the line found at the last place; where rounding puts that outside of what is known to hold
    the root, to the middle of it. At the minimum there is no direction, and the length is 1.

    Args:
        rows: the constraints.
        point: where the step starts.
        change: [rows] how the residual changes along it.
        slope: [] the derivative there, without rows.
        curvature: [] its derivative.
        max_rounds: places to look at.
    """
    pull, stretch = rows.stiffness * change * point.residual, rows.stiffness * change**2

    def look(last: _Look) -> _Look:
        inside = (last.low < last.root) & (last.root < last.high)
        place = jnp.where(inside, last.root, (last.low + last.high) / 2)
        active = rows.equality | (point.residual + place * change < 0)
        at_zero = slope + jnp.sum(jnp.where(active, pull, 0))
        rate = curvature + jnp.sum(jnp.where(active, stretch, 0))
        root = jnp.where(rate > 0, -at_zero / rate, place)
        return _Look(
            low=jnp.where(root > place, place, last.low),
            high=jnp.where(root > place, last.high, place),
            root=root,
            active=active,
            count=last.count + 1,
            settled=jnp.all(active == last.active),
        )

    start = _Look(
        low=jnp.zeros_like(slope),
        high=jnp.full_like(slope, jnp.inf),
        root=jnp.ones_like(slope),  # of Newton's own line
        active=point.active,
        count=jnp.int32(0),
        settled=jnp.array(False),
    )
    return jax.lax.while_loop(
        lambda last: ~last.settled & (last.count < max_rounds), look, start
    ).root
