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
_MANY_STEPS = 20
_MANY_LENGTHS = 50
#: mjMINVAL: what C takes for zero.
_MIN_VALUE = 1e-15
#: The flag for one island, of which MJX has no name.
_NO_ISLANDS = int(mujoco.mjtDisableBit.mjDSBL_ISLAND)  # pyright: ignore[reportAttributeAccessIssue]


def stops_early(model: Any) -> bool:
    """Returns whether a model, C's or MJX's, allows its solver few steps, or lengths of one."""
    return model.opt.iterations < _MANY_STEPS or model.opt.ls_iterations < _MANY_LENGTHS


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
        # At most one island is not masked, so that the sum is a lookup; machine code has none.
        members = labels == jnp.arange(self.size)[:, None]
        return jnp.sum(jnp.where(members, values[:, None], 0), 0)


class _Mark(NamedTuple):
    """A length of the step of each island, [islands], and there the cost and its derivatives.

    The cost is that above the cost at length zero, as in ``mjPrimalPnt`` of C.
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
    roots: of each end a length where the slope may be zero
    evaluations: [islands] how many lengths were evaluated
    is_converged: [islands] whether the search is over
    best: where it ended, if it did
    """

    ends: tuple[_Mark, _Mark]
    roots: tuple[_Mark, _Mark]
    evaluations: jax.Array
    is_converged: jax.Array
    best: _Mark


class _Search(NamedTuple):
    """The state of the solver.

    point: the acceleration reached, and what the next step needs of it
    improvement: [islands] by how much the last step lowered the cost
    steps: [] how many led there
    is_active: [islands] whether an island's search goes on
    """

    point: newton.Point
    improvement: jax.Array
    steps: jax.Array
    is_active: jax.Array


def solve(model: mjx.Model, data: mjx.Data) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Finds the acceleration under constraints at which C MuJoCo stops.

    Args:
      model: a model that ``newton.supports`` accepts.
      data: with its constraint rows made.

    Returns:
      The acceleration [nv], the constraints' joint forces [nv] and the rows' forces [rows].
    """
    problem = newton.problem_of(model, data)
    rows = problem.rows
    inertia = problem.inertia
    tolerance = model.opt.tolerance
    islands = _islands(model, jax_fields(data).efc_J)
    scale = _scale(model, inertia, islands)

    def improve(search: _Search) -> _Search:
        """Makes one step of ``mj_solPrimal`` in every island whose search goes on."""
        old_point = search.point
        direction, gradient = newton.newton_direction(problem, old_point)
        if islands.size > 1:
            direction = jnp.where(islands.dofs < islands.size, direction, 0)
        # C's tests after a step, here before the next. Before the very first step it has no
        # improvement to look at, and ends only if gradient and decrement both are small.
        has_small_gradient = scale * jnp.sqrt(islands.total(gradient**2, islands.dofs)) < tolerance
        decrement = -islands.total(gradient * direction, islands.dofs) / 2
        has_small_decrement = jnp.maximum(scale * decrement, 0) < tolerance
        gain = scale * search.improvement
        is_converged = has_small_gradient | has_small_decrement | ((gain > 0) & (gain < tolerance))
        is_first_step = search.steps == 0
        is_optimum = has_small_gradient & has_small_decrement
        is_active = search.is_active & ~jnp.where(is_first_step, is_optimum, is_converged)

        # One line for each island: the Hessian couples no two, so that their lengths may differ.
        change = problem.along(direction)
        change_of_imbalance = inertia @ direction
        norm = jnp.sqrt(islands.total(direction**2, islands.dofs))
        slope = islands.total(direction * old_point.imbalance, islands.dofs)
        curvature = islands.total(direction * change_of_imbalance, islands.dofs)
        mark_at = _along(rows, islands, old_point.residual, change, slope, curvature)
        # ``gtol`` of ``PrimalSearch``.
        slope_tolerance = tolerance * model.opt.ls_tolerance * norm / scale
        best_mark = _line_search(mark_at, slope_tolerance, model.opt.ls_iterations)
        # A length of zero ends an island's search: it has converged, or there is no better point.
        length = jnp.where(is_active & (norm >= _MIN_VALUE), best_mark.length, 0)
        dof_length = islands.spread(length, islands.dofs)
        row_length = islands.spread(length, islands.rows)
        new_point = newton.Point(
            old_point.qacc + dof_length * direction,
            old_point.imbalance + dof_length * change_of_imbalance,
            old_point.residual + row_length * change,
        )
        return _Search(new_point, -best_mark.cost, search.steps + 1, is_active & (length != 0))

    start = newton.start(model, data, problem)
    if islands.size > 1:  # what no row holds is not the solver's
        start = _released(data, islands, start)
    zeros = jnp.zeros_like(scale)
    search = jax.lax.while_loop(
        lambda search: jnp.any(search.is_active) & (search.steps < model.opt.iterations),
        improve,
        _Search(start, zeros, jnp.int32(0), zeros == 0),
    )
    return problem.solution(search.point)


def _released(data: mjx.Data, islands: _Islands, point: newton.Point) -> newton.Point:
    """Returns a point with the unconstrained acceleration where there is no island."""
    # As the end of C's ``warmstart``; there the imbalance is that of ``qacc_smooth``, zero.
    is_free = islands.dofs == islands.size
    qacc = jnp.where(is_free, data.qacc_smooth, point.qacc)
    return point._replace(qacc=qacc, imbalance=jnp.where(is_free, 0, point.imbalance))


def _islands(model: mjx.Model, jacobian: jax.Array) -> _Islands:
    """Returns the islands; a row joins the trees in which it is not zero [rows, nv]."""
    trees = model.dof_treeid
    num_trees = int(trees.max()) + 1
    if num_trees == 1 or model.opt.disableflags & _NO_ISLANDS:
        return _Islands(1, np.zeros(len(trees), int), np.zeros(len(jacobian), int))

    def join(is_joined: jax.Array, rows: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Joins trees [trees, trees] that rows hold together; returns which rows hold which."""
        is_held = jnp.stack([jnp.any(rows[:, trees == tree] != 0, 1) for tree in range(num_trees)])
        return is_joined | jnp.any(is_held[:, None] & is_held[None], -1), is_held

    # LLVM takes minutes for thousands of bools that are joined in one block.
    blocks = jacobian[:, None] if is_written_out() else jacobian[None]
    is_joined, block_holds = short_scan(join, jnp.zeros((num_trees, num_trees), bool), blocks)
    is_held = jnp.moveaxis(block_holds, 0, 1).reshape(num_trees, -1)
    # The transitive closure, for which ``mj_island`` walks a graph: each squaring joins trees
    # through one more tree, three more, ...
    for _ in range(math.ceil(math.log2(num_trees))):
        is_joined = jnp.any(is_joined[:, :, None] & is_joined[None], 1)
    # An island's number is that of its first tree, so that many numbers name none.
    label = jnp.min(jnp.where(is_joined, jnp.arange(num_trees), num_trees), 1)
    row_label = jnp.min(jnp.where(is_held, label[:, None], num_trees), 0)
    return _Islands(num_trees, label[trees], row_label)


def _scale(model: mjx.Model, inertia: jax.Array, islands: _Islands) -> jax.Array:
    """Returns what C multiplies costs and gradients by before it looks at them, [islands]."""
    if model.opt.disableflags & _NO_ISLANDS:
        return 1 / jnp.full(1, model.stat.meaninertia * max(1, model.nv), inertia.dtype)
    # Numbers that name no island have a trace of zero.
    return 1 / jnp.maximum(islands.total(jnp.diagonal(inertia), islands.dofs), _MIN_VALUE)


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
        num_lossless = residual.size - rows.loss.size
        row_loss = jnp.pad(rows.loss, (0, num_lossless), constant_values=jnp.inf)
        rows = rows._replace(loss=row_loss)
    # A loop over rows would carry these along, and nothing here reads them.
    rows = rows._replace(jacobian=None, reference=None)
    all_rows = rows, jnp.asarray(islands.rows), residual, change

    def mark_at(length: jax.Array) -> _Mark:
        """Returns the mark at a length of each island's step, as C's ``PrimalEval``."""
        if is_written_out():  # hundreds of rows, at seven places
            zeros = jnp.zeros((3, *length.shape), residual.dtype)
            single_rows = jax.tree.map(lambda x: x[:, None], all_rows)
            add_row = lambda sums, row: (sums + _of_rows(islands, length, *row), None)  # noqa: E731
            doubled_work, push, stiffness = short_scan(add_row, zeros, single_rows)[0]
        else:
            doubled_work, push, stiffness = _of_rows(islands, length, *all_rows)
        total_curvature = curvature + stiffness
        return _Mark(
            length=length,
            cost=length * (slope + length * curvature / 2) + doubled_work / 2,
            slope=slope + length * curvature - push,
            curvature=jnp.where(total_curvature > 0, total_curvature, _MIN_VALUE),
        )

    return mark_at


def _of_rows(
    islands: _Islands,
    length: jax.Array,
    rows: newton.Rows,
    labels: jax.Array,
    residual: jax.Array,
    change: jax.Array,
) -> jax.Array:
    """Returns what rows add to twice the cost along a step, to minus its slope and its curvature.

    Arguments are those of ``_along``, and the rows' islands; the result is [3, islands].
    """
    step = islands.spread(length, labels) * change
    end_residual = residual + step
    force = rows.force(end_residual)
    # The difference of two costs has no digits where a row stays what it is. There the force is
    # linear in the step, and its mean gives the work, as in C's ``frictionCostDif``.
    doubled_work = jnp.where(
        rows.alike(end_residual, residual),
        -(rows.force(residual) + force) * step,
        rows.cost(end_residual) - rows.cost(residual),
    )
    stiffness = jnp.where(rows.active(end_residual), rows.constraint_mass * change**2, 0)
    sums = [islands.total(x, labels) for x in (doubled_work, force * change, stiffness)]
    return jnp.stack(sums)


def _chosen(condition: jax.Array, state_if_true: Any, state_if_false: Any) -> Any:
    """Returns one of two states for each island."""
    return jax.tree.map(lambda y, n: jnp.where(condition, y, n), state_if_true, state_if_false)


def _line_search(
    mark_at: Callable[[jax.Array], _Mark], slope_tolerance: jax.Array, max_lengths: int
) -> _Mark:
    """Returns where C's line search (``PrimalSearch``) ends, of each island.

    It makes Newton steps along the line until the slope changes its sign. Then both ends of that
    interval move inwards, to the best of their next Newton steps and the middle.

    Args:
      mark_at: evaluates a length.
      slope_tolerance: [islands] a slope that is smaller counts as zero.
      max_lengths: how many lengths it may evaluate, more or less: it looks after each round.
    """
    start_mark = mark_at(jnp.zeros_like(slope_tolerance))
    newton_step = mark_at(start_mark.next)
    root_sign = jnp.where(newton_step.slope < 0, 1, -1)
    is_converged = jnp.abs(newton_step.slope) < slope_tolerance
    is_converged = is_converged & ((newton_step.length == 0) | (newton_step.cost < 0))

    def goes_on(state: tuple) -> jax.Array:
        mark, _, evaluations, is_converged = state
        is_before_root = ~is_converged & (mark.slope * root_sign <= -slope_tolerance)
        return is_before_root & (evaluations < max_lengths)

    def follow(state: tuple) -> tuple:
        """Makes the next Newton step along the line, where an island's search goes on."""
        mark, _, evaluations, is_converged = state
        trial = mark_at(mark.next)
        is_converged = is_converged | ((jnp.abs(trial.slope) < slope_tolerance) & (trial.cost < 0))
        return _chosen(goes_on(state), (trial, mark, evaluations + 1, is_converged), state)

    # C counts lengths one by one; two are evaluated above.
    state = newton_step, start_mark, jnp.full(slope_tolerance.shape, 2, jnp.int32), is_converged
    state = jax.lax.while_loop(lambda state: jnp.any(goes_on(state)), follow, state)
    last_mark, previous_mark, evaluations, is_converged = state
    # The last two marks, between which the slope changes its sign: p1 and p2 in C.
    bracket = _Bracket(
        ends=(last_mark, previous_mark),
        roots=(mark_at(last_mark.next), last_mark),
        evaluations=evaluations + 1,
        is_converged=is_converged | (evaluations >= max_lengths),
        best=last_mark,
    )
    return _bracketed(mark_at, slope_tolerance, max_lengths, bracket)


def _bracketed(
    mark_at: Callable[[jax.Array], _Mark],
    slope_tolerance: jax.Array,
    max_lengths: int,
    bracket: _Bracket,
) -> _Mark:
    """Returns where the line search ends, from a bracket; otherwise as ``_line_search``."""

    def goes_on(state: _Bracket) -> jax.Array:
        return ~state.is_converged & (state.evaluations < max_lengths)

    def narrow(state: _Bracket) -> _Bracket:
        """Makes one round of C's bracketed search, where an island's goes on."""
        low, high = state.ends
        middle_mark = mark_at((low.length + high.length) / 2)
        candidates = *state.roots, middle_mark

        # Of the candidates with a slope of zero the one of least cost ends the search.
        is_flat = jnp.zeros(slope_tolerance.shape, bool)
        best_mark = middle_mark
        for mark in candidates:
            is_root = jnp.abs(mark.slope) < slope_tolerance
            is_better = is_root & (~is_flat | (mark.cost < best_mark.cost))
            is_flat = is_flat | is_better
            best_mark = _chosen(is_better, mark, best_mark)

        # ``updateBracket``: each end goes to the candidate on its side of the root that is nearest.
        # Where neither moves, rounding has the rest, and C takes the middle.
        marks = []
        roots = []
        evaluations = state.evaluations + 1
        is_stuck = True
        for end, next_mark in zip(state.ends, state.roots, strict=True):
            new_end = end
            for mark in candidates:
                is_same_side = mark.slope * new_end.slope > 0
                is_closer = is_same_side & (jnp.abs(mark.slope) < jnp.abs(new_end.slope))
                new_end = _chosen(is_closer, mark, new_end)
            has_moved = new_end.slope != end.slope
            marks.append(new_end)
            roots.append(_chosen(has_moved, mark_at(new_end.next), next_mark))
            evaluations = evaluations + has_moved
            is_stuck = is_stuck & ~has_moved
        inner = _Bracket(tuple(marks), tuple(roots), evaluations, is_flat | is_stuck, best_mark)
        return _chosen(goes_on(state), inner, state)

    bracket = jax.lax.while_loop(lambda state: jnp.any(goes_on(state)), narrow, bracket)
    # Out of lengths, C takes the end of least cost, or no step if neither lowers the cost.
    low, high = bracket.ends
    best_end = _chosen(low.cost <= high.cost, low, high)
    best_end = _chosen(best_end.cost < 0, best_end, jax.tree.map(jnp.zeros_like, best_end))
    return _chosen(bracket.is_converged, bracket.best, best_end)
