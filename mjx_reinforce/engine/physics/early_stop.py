r"""The constraint solver of C MuJoCo 4.0 for files that have it stop before the optimum.

A file that allows few ``iterations`` or ``ls_iterations`` asks for speed. What C then answers is
where its search happened to be, so that the search itself is the answer: Newton's method from the
better start, a line search that brackets the root of the slope and counts its evaluations, and the
tests by which C ends both (``mj_solNewton`` and MuJoCo's documentation, "Computation").

C divides the model into *islands*, the kinematic trees that constraint rows join, and solves each
alone: each has its own steps' lengths, scale and end. Here all islands make their steps together,
since the Hessian couples no two of them; what is one number in C is [islands] here. A tree without
rows has its unconstrained acceleration.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from mjx_reinforce.engine.physics import newton
from mjx_reinforce.engine.physics.mjx_internals import jax_fields
from mjx_reinforce.engine.scalar import is_written_out, short_scan

#: Fewer are few: in the mechanisms of ``experiments/checks/matrix.py`` C takes 6 steps at most, and
#: evaluates 22 lengths at most for one. Gymnasium's Pusher allows 20 steps; MuJoCo's default is 50
#: lengths.
_STEPS, _LENGTHS = 20, 50
#: mjMINVAL and the flag for one island: what C takes for zero, and what MJX has no name for.
_TINY = 1e-15
_NO_ISLANDS = int(mujoco.mjtDisableBit.mjDSBL_ISLAND)  # pyright: ignore[reportAttributeAccessIssue]


def stops_early(model: Any) -> bool:
    """Returns whether a model, C's or MJX's, allows its solver few steps, or lengths of one."""
    return model.opt.iterations < _STEPS or model.opt.ls_iterations < _LENGTHS


class _Islands(NamedTuple):
    """Which degrees of freedom and rows are solved together.

    size: how many islands there may be
    dofs: [nv] the number of each one's island, ``size`` if it has none
    rows: [rows] the same
    """

    size: int
    dofs: Any
    rows: Any

    def total(self, values: jax.Array, labels: Any) -> jax.Array:
        """Adds up what degrees of freedom or rows with these labels have, [islands]."""
        if self.size == 1:
            return jnp.sum(values)[None]
        members = labels == jnp.arange(self.size)[:, None]
        return jnp.sum(jnp.where(members, values, 0), 1)

    def spread(self, values: jax.Array, labels: Any) -> jax.Array:
        """Gives each degree of freedom or row what its island has; without one, zero."""
        if self.size == 1:
            return values[0]
        members = labels == jnp.arange(self.size)[:, None]
        return jnp.sum(jnp.where(members, values[:, None], 0), 0)  # machine code has no lookups


class _Mark(NamedTuple):
    """A length of the step of each island, [islands], and there the cost and its derivatives.

    The cost is that above the cost at length zero.
    """

    length: jax.Array
    cost: jax.Array
    slope: jax.Array
    curvature: jax.Array

    @property
    def next(self) -> jax.Array:
        """Where the slope would be zero if no row changed."""
        return self.length - self.slope / self.curvature


class _Bracket(NamedTuple):
    """The state of a line search that has bracketed the root of the slope.

    ends: the two ends
    nexts: of each end a length where the slope may be zero
    evaluated: [islands] how many lengths were
    settled: [islands] whether the search is over
    end: where it ended
    """

    ends: tuple[_Mark, _Mark]
    nexts: tuple[_Mark, _Mark]
    evaluated: jax.Array
    settled: jax.Array
    end: _Mark


class _Search(NamedTuple):
    """The state of the solver.

    point: the acceleration reached, and what the next step needs of it
    improvement: [islands] by how much the last step lowered the cost
    steps: [] how many were made
    going: [islands] whether an island's search goes on
    """

    point: newton.Point
    improvement: jax.Array
    steps: jax.Array
    going: jax.Array


def solve(model: mjx.Model, data: mjx.Data) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Finds the acceleration under constraints at which C MuJoCo stops.

    Args:
      model: a model that ``newton.supports`` accepts.
      data: with its constraint rows made.

    Returns:
      The acceleration [nv], the constraints' joint forces [nv] and the rows' forces [rows].
    """
    problem = newton.posed(model, data)
    rows, inertia, tolerance = problem.rows, problem.inertia, model.opt.tolerance
    islands = _islands(model, jax_fields(data).efc_J)
    scale = _scale(model, inertia, islands)

    def improve(search: _Search) -> _Search:
        before = search.point
        direction, gradient = newton.newton_direction(problem, before)
        if islands.size > 1:
            direction = jnp.where(islands.dofs < islands.size, direction, 0)
        flat = scale * jnp.sqrt(islands.total(gradient**2, islands.dofs)) < tolerance
        decrement = -islands.total(gradient * direction, islands.dofs) / 2
        near = jnp.maximum(scale * decrement, 0) < tolerance
        gain = scale * search.improvement
        settled = flat | near | ((gain > 0) & (gain < tolerance))
        going = search.going & ~jnp.where(search.steps == 0, flat & near, settled)

        change, change_of_imbalance = problem.along(direction), inertia @ direction
        norm = jnp.sqrt(islands.total(direction**2, islands.dofs))
        slope = islands.total(direction * before.imbalance, islands.dofs)
        curvature = islands.total(direction * change_of_imbalance, islands.dofs)
        at = _along(rows, islands, before.residual, change, slope, curvature)
        flat_slope = tolerance * model.opt.ls_tolerance * norm / scale
        end = _line_search(at, flat_slope, model.opt.ls_iterations)
        length = jnp.where(going & (norm >= _TINY), end.length, 0)
        of_dofs, of_rows = (islands.spread(length, labels) for labels in islands[1:])
        after = newton.Point(
            before.qacc + of_dofs * direction,
            before.imbalance + of_dofs * change_of_imbalance,
            before.residual + of_rows * change,
        )
        return _Search(after, -end.cost, search.steps + 1, going & (length != 0))

    first = newton.start(model, data, problem)
    if islands.size > 1:  # what no row holds is not the solver's
        first = _released(data, islands, first)
    zeros = jnp.zeros_like(scale)
    end = jax.lax.while_loop(
        lambda search: jnp.any(search.going) & (search.steps < model.opt.iterations),
        improve,
        _Search(first, zeros, jnp.int32(0), zeros == 0),
    )
    return problem.solution(end.point)


def _released(data: mjx.Data, islands: _Islands, point: newton.Point) -> newton.Point:
    """Returns a point with the unconstrained acceleration where there is no island."""
    free = islands.dofs == islands.size
    qacc = jnp.where(free, data.qacc_smooth, point.qacc)
    return point._replace(qacc=qacc, imbalance=jnp.where(free, 0, point.imbalance))


def _islands(model: mjx.Model, jacobian: jax.Array) -> _Islands:
    """Returns the islands; a row joins the trees in which it is not zero [rows, nv]."""
    trees = model.dof_treeid
    count = int(trees.max()) + 1
    if count == 1 or model.opt.disableflags & _NO_ISLANDS:
        return _Islands(1, np.zeros(len(trees), int), np.zeros(len(jacobian), int))

    def join(joined: jax.Array, rows: jax.Array) -> tuple[jax.Array, jax.Array]:
        meets = jnp.stack([jnp.any(rows[:, trees == t] != 0, 1) for t in range(count)])
        return joined | jnp.any(meets[:, None] & meets[None], -1), meets

    # LLVM takes minutes for thousands of bools that are joined in one block.
    parts = jacobian[:, None] if is_written_out() else jacobian[None]
    joined, met = short_scan(join, jnp.zeros((count, count), bool), parts)
    meets = jnp.moveaxis(met, 0, 1).reshape(count, -1)
    for _ in range(math.ceil(math.log2(count))):  # through one more tree, three more, ...
        joined = jnp.any(joined[:, :, None] & joined[None], 1)
    label = jnp.min(jnp.where(joined, jnp.arange(count), count), 1)
    of_rows = jnp.min(jnp.where(meets, label[:, None], count), 0)
    return _Islands(count, label[trees], of_rows)


def _scale(model: mjx.Model, inertia: jax.Array, islands: _Islands) -> jax.Array:
    """Returns what C multiplies costs and gradients by before it looks at them, [islands]."""
    if model.opt.disableflags & _NO_ISLANDS:
        return 1 / jnp.full(1, model.stat.meaninertia * max(1, model.nv), inertia.dtype)
    return 1 / jnp.maximum(islands.total(jnp.diagonal(inertia), islands.dofs), _TINY)


def _along(
    rows: newton.Rows,
    islands: _Islands,
    residual: jax.Array,
    change: jax.Array,
    slope: jax.Array,
    curvature: jax.Array,
) -> Callable[[jax.Array], _Mark]:
    """Returns the function that evaluates a length of each island's step, [islands].

    Args:
      rows: the constraints.
      islands: which of them belong together.
      residual: [rows] where the step starts.
      change: [rows] how the residual changes along it.
      slope: [islands] the derivative of the cost without rows, at the start.
      curvature: [islands] its second derivative.
    """
    if rows.loss is not None:  # of every row, as a loop takes one after the other
        others = (0, residual.size - rows.loss.size)
        rows = rows._replace(loss=jnp.pad(rows.loss, others, constant_values=jnp.inf))
    rows = rows._replace(jacobian=None, reference=None)
    whole = rows, jnp.asarray(islands.rows), residual, change

    def at(length: jax.Array) -> _Mark:
        if is_written_out():  # hundreds of rows, at seven places
            none = jnp.zeros((3, *length.shape), residual.dtype)
            one_by_one = jax.tree.map(lambda x: x[:, None], whole)
            add = lambda sums, row: (sums + _of_rows(islands, length, *row), None)  # noqa: E731
            worked, pushed, stiff = short_scan(add, none, one_by_one)[0]
        else:
            worked, pushed, stiff = _of_rows(islands, length, *whole)
        total = curvature + stiff
        return _Mark(
            length,
            length * (slope + length * curvature / 2) + worked,
            slope + length * curvature - pushed,
            jnp.where(total > 0, total, _TINY),
        )

    return at


def _of_rows(
    islands: _Islands,
    length: jax.Array,
    rows: newton.Rows,
    labels: jax.Array,
    residual: jax.Array,
    change: jax.Array,
) -> jax.Array:
    """Returns what rows add to the cost along a step, to minus its slope and its curvature.

    Arguments are those of ``_along``, and the rows' islands; the result is [3, islands].
    """
    step = islands.spread(length, labels) * change
    after = residual + step
    force = rows.force(after)
    # The difference of two costs has no digits where a row stays what it is.
    work = jnp.where(
        rows.alike(after, residual),
        -(rows.force(residual) + force) * step / 2,
        (rows.cost(after) - rows.cost(residual)) / 2,
    )
    stiffness = jnp.where(rows.active(after), rows.constraint_mass * change**2, 0)
    sums = [islands.total(x, labels) for x in (work, force * change, stiffness)]
    return jnp.stack(sums)


def _chosen(condition: jax.Array, yes: Any, no: Any) -> Any:
    """Returns one of two states for each island."""
    return jax.tree.map(lambda y, n: jnp.where(condition, y, n), yes, no)


def _line_search(at: Callable[[jax.Array], _Mark], flat: jax.Array, most: int) -> _Mark:
    """Returns where C's line search ends, of each island.

    It makes Newton steps along the line until the slope changes its sign. Then both ends of that
    interval move inwards, to the best of their next Newton steps and the middle.

    Args:
      at: evaluates a length.
      flat: [islands] a slope that is smaller counts as zero.
      most: how many lengths it may evaluate, more or less: it looks after each round.
    """
    zero = at(jnp.zeros_like(flat))
    first = at(zero.next)
    towards = jnp.where(first.slope < 0, 1, -1)
    settled = (jnp.abs(first.slope) < flat) & ((first.length == 0) | (first.cost < 0))

    def goes_on(state: tuple) -> jax.Array:
        mark, _, evaluated, settled = state
        return ~settled & (mark.slope * towards <= -flat) & (evaluated < most)

    def follow(state: tuple) -> tuple:
        mark, _, evaluated, settled = state
        new = at(mark.next)
        done = settled | ((jnp.abs(new.slope) < flat) & (new.cost < 0))
        return _chosen(goes_on(state), (new, mark, evaluated + 1, done), state)

    state = first, zero, jnp.full(flat.shape, 2, jnp.int32), settled
    state = jax.lax.while_loop(lambda state: jnp.any(goes_on(state)), follow, state)
    last, before, evaluated, settled = state
    bracket = _Bracket(
        ends=(last, before),
        nexts=(at(last.next), last),
        evaluated=evaluated + 1,
        settled=settled | (evaluated >= most),
        end=last,
    )
    return _bracketed(at, flat, most, bracket)


def _bracketed(
    at: Callable[[jax.Array], _Mark], flat: jax.Array, most: int, bracket: _Bracket
) -> _Mark:
    """Returns where the line search ends, from a bracket; otherwise as ``_line_search``."""

    def goes_on(state: _Bracket) -> jax.Array:
        return ~state.settled & (state.evaluated < most)

    def narrow(state: _Bracket) -> _Bracket:
        low, high = state.ends
        middle = at((low.length + high.length) / 2)
        candidates = *state.nexts, middle
        is_flat, best = jnp.zeros(flat.shape, bool), middle
        for mark in candidates:
            better = (jnp.abs(mark.slope) < flat) & (~is_flat | (mark.cost < best.cost))
            is_flat, best = is_flat | better, _chosen(better, mark, best)
        ends, nexts, evaluated, stays = [], [], state.evaluated + 1, True
        for end, following in zip(state.ends, state.nexts, strict=True):
            new = end
            for mark in candidates:
                same_side = mark.slope * new.slope > 0
                closer = same_side & (jnp.abs(mark.slope) < jnp.abs(new.slope))
                new = _chosen(closer, mark, new)
            moved = new.slope != end.slope
            ends.append(new)
            nexts.append(_chosen(moved, at(new.next), following))
            evaluated, stays = evaluated + moved, stays & ~moved
        made = _Bracket(tuple(ends), tuple(nexts), evaluated, is_flat | stays, best)
        return _chosen(goes_on(state), made, state)

    done = jax.lax.while_loop(lambda state: jnp.any(goes_on(state)), narrow, bracket)
    low, high = done.ends
    best = _chosen(low.cost <= high.cost, low, high)
    best = _chosen(best.cost < 0, best, jax.tree.map(jnp.zeros_like, best))
    return _chosen(done.settled, done.end, best)
