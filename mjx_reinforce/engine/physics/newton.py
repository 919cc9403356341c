r"""The constraint solver of C MuJoCo, with a line search that ends when it is exact.

The acceleration a minimizes (MuJoCo's documentation, "Computation", "Constraint model")

    (a - a_s)' M (a - a_s) / 2 + \sum_i D_i min(0, J_i a - r_i)^2 / 2

with the unconstrained acceleration a_s, the inertia matrix M and, of the constraint rows, the
Jacobian J, reference r and constraint mass D (``efc_J``, ``efc_aref``, ``efc_D``); rows of equality
constraints count on both sides of zero. So do those of friction loss, whose force is at most the
loss: a row that would need more *slides*, and its cost is linear. The cost is convex, and quadratic
for a given set of active and sliding rows, so that Newton's method, with an exact line search, ends
after finitely many steps: when a full step leaves the set as it is, that step led to the minimum.

MJX's own solver does the same steps, but its line search evaluates three points in each of
``ls_iterations`` (50) rounds, which ``jax.vmap`` carries out for every episode until the slowest is
done; here a round evaluates one point, and the search ends when no row changes any more.

``solve_in_loops`` is the same method in little code, for what hardly ever happens: machine code
comes there only if more contacts touch than ``touching`` has room for, and then solves with all
that there may be. What is written out for each of hundreds of rows, and for a factor of the
Hessian, was a quarter of Humanoid's program. There all of that is loops, and the residuals are
computed again in each step, where ``solve_newton`` carries them on: less code, and more time.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from mujoco import mjx

from mjx_reinforce.engine.physics import contact_rows
from mjx_reinforce.engine.physics.inertia import solve
from mjx_reinforce.engine.physics.mjx_internals import jax_fields
from mjx_reinforce.engine.scalar import skippable

#: An interval is narrow if its lower end is at least this share of its upper end.
_NARROW_RATIO = 0.999
#: From the unconstrained acceleration the optimum may be more steps away than from a warm start.
_STEPS_FROM_COLD = 50
# mjMINVAL: what C takes for zero.
_MIN_TRACE = 1e-15


class Rows(NamedTuple):
    """Constraint rows.

    jacobian: J, ``efc_J``
    reference: [rows] r, ``efc_aref``
    constraint_mass: [rows] D, ``efc_D``
    is_two_sided: [rows] whether a row is active on both sides
    loss: [rows of equality and friction loss, which come first] the most that each pushes, inf for
      equality; None if no row has friction loss
    """

    jacobian: Any
    reference: jax.Array
    constraint_mass: jax.Array
    is_two_sided: jax.Array
    loss: jax.Array | None = None

    def active(self, residual: jax.Array) -> jax.Array:
        """Returns which rows push as springs at residuals [rows]; a NaN does, not to be lost."""
        is_pushing = self.is_two_sided | ~(residual >= 0)
        # A row that slides has a linear cost: it adds to the gradient alone, not to the Hessian.
        return is_pushing if self.loss is None else is_pushing & (self.sliding(residual) == 0)

    def force(self, residual: jax.Array) -> jax.Array:
        """Returns the rows' forces, [rows]."""
        force = self.spring(residual)
        return force if self.loss is None else force + self.sliding(residual)

    def spring(self, residual: jax.Array) -> jax.Array:
        """Returns the forces [rows] of the rows that push as springs, 0 for others."""
        return jnp.where(self.active(residual), -self.constraint_mass * residual, 0)

    def sliding(self, residual: jax.Array) -> jax.Array:
        """Returns the forces [rows] of the rows that slide, 0 for others."""
        assert self.loss is not None
        # Rows of equality are among these, with an infinite loss: they never slide.
        loss_rows = slice(self.loss.size)
        is_sliding = jnp.abs(self.constraint_mass[loss_rows] * residual[loss_rows]) >= self.loss
        force = jnp.where(is_sliding, -jnp.sign(residual[loss_rows]) * self.loss, 0)
        return jnp.pad(force, (0, residual.size - self.loss.size))

    def cost(self, residual: jax.Array) -> jax.Array:
        """Returns twice what each row adds to the cost, [rows]."""
        cost = -self.spring(residual) * residual
        if self.loss is None:
            return cost
        # The linear branch of Huber's function (``frictionCost`` of C's solver), doubled; the
        # quadratic one is zero there, since a row that slides is not active.
        loss_rows = slice(self.loss.size)
        excess = 2 * jnp.abs(residual[loss_rows]) - self.loss / self.constraint_mass[loss_rows]
        is_sliding = self.sliding(residual)[loss_rows] != 0
        return cost.at[loss_rows].add(jnp.where(is_sliding, self.loss * excess, 0))

    def alike(self, residual1: jax.Array, residual2: jax.Array) -> jax.Array:
        """Returns of each row whether its cost is the same quadratic function at two residuals."""
        is_alike = self.active(residual1) == self.active(residual2)
        if self.loss is not None:
            # A row may slide either way; both ways are inactive.
            is_alike &= self.sliding(residual1) == self.sliding(residual2)
        return is_alike


class Point(NamedTuple):
    """An acceleration and what the next step needs of it.

    qacc: [nv]
    imbalance: [nv] M a minus the unconstrained forces
    residual: [rows] J a - r
    """

    qacc: jax.Array
    imbalance: jax.Array
    residual: jax.Array


class Problem(NamedTuple):
    """What is minimized.

    division: of the rows
    rows: the constraints
    inertia: [nv, nv]
    is_touching: [C] whether a contact's rows may be other than zero
    """

    division: contact_rows.Blocks
    rows: Rows
    inertia: jax.Array
    is_touching: jax.Array

    def along(self, direction: jax.Array) -> jax.Array:
        """Returns J direction, [rows]."""
        return contact_rows.along(self.division, self.rows.jacobian, direction, self.is_touching)

    def solution(self, end: Point) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Returns ``qacc`` [nv], ``qfrc_constraint`` [nv] and ``efc_force`` [rows] of a point."""
        efc_force = self.rows.force(end.residual)
        # Only J' force is read. The forces stand in for the mass, which says which contacts push.
        qfrc_constraint = contact_rows.weighted(
            self.division, self.inertia, self.rows.jacobian, efc_force, efc_force
        )[1]
        return end.qacc, qfrc_constraint, efc_force


class Search(NamedTuple):
    """The state of Newton's method.

    point: the acceleration reached, and what the next step needs of it
    steps: [] how many led there
    is_converged: [] whether the last step led to the minimum
    """

    point: Any
    steps: jax.Array
    is_converged: jax.Array


class Line(NamedTuple):
    """The cost's derivative along a step, for the rows that push at one length of it.

    intercept: [] where the line is at length zero
    rate: [] how fast it increases
    """

    intercept: jax.Array
    rate: jax.Array


class _LineSearch(NamedTuple):
    """The state of a line search along one step, by lengths of the step.

    low: [] the largest length known to have a negative derivative
    high: [] the smallest length known to have a positive derivative
    root: [] where the last line is zero
    line: of the last length
    evaluations: [] how many lengths were evaluated
    is_converged: [] whether the last two lengths have the same line
    """

    low: jax.Array
    high: jax.Array
    root: jax.Array
    line: Line
    evaluations: jax.Array
    is_converged: jax.Array


def supports(model: mjx.Model) -> bool:
    """Returns whether ``solve_newton`` fits: Newton, pyramidal cones."""
    return model.opt.solver == mjx.SolverType.NEWTON and model.opt.cone == mjx.ConeType.PYRAMIDAL


def solve_newton(model: mjx.Model, data: mjx.Data) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Finds the acceleration under constraints, from the start that costs less.

    The starts are the unconstrained acceleration and, unless the model disables it, the warm start.

    Args:
      model: a model that ``supports`` accepts; ``iterations`` and ``ls_iterations`` bound the
        loops.
      data: with its constraint rows made.

    Returns:
      The acceleration [nv], the constraints' joint forces [nv] and the rows' forces [rows].
    """
    problem = problem_of(model, data)
    rows = problem.rows
    inertia = problem.inertia
    min_decrement = smallest_decrement(model, inertia)

    def improve(search: Search) -> Search:
        """Makes one step of ``mj_solPrimal``: the direction, its length, and the new point."""
        old_point = search.point
        direction, gradient = newton_direction(problem, old_point)
        decrement = -jnp.dot(gradient, direction) / 2
        # A step changes imbalance and residual linearly: the line search and the new point need no
        # products with M and J but these (Mv and Jv of ``PrimalSearch``).
        change = problem.along(direction)
        change_of_imbalance = inertia @ direction
        smooth_line = Line(
            jnp.dot(direction, old_point.imbalance), jnp.dot(direction, change_of_imbalance)
        )
        length = _line_search(rows, old_point, change, smooth_line, model.opt.ls_iterations)
        new_point = Point(
            old_point.qacc + length * direction,
            old_point.imbalance + length * change_of_imbalance,
            old_point.residual + length * change,
        )
        # With the same rows in the same states the cost is one quadratic function at both ends, of
        # which this was the full Newton step: another would change nothing.
        has_same_rows = jnp.all(rows.alike(new_point.residual, old_point.residual))
        is_converged = has_same_rows | (decrement < min_decrement)
        return Search(new_point, search.steps + 1, is_converged)

    return problem.solution(descend(model.opt.iterations, improve, start(model, data, problem)))


def problem_of(model: mjx.Model, data: mjx.Data) -> Problem:
    """Returns the problem of data with its constraint rows made."""
    impl = jax_fields(data)
    # MuJoCo's order of rows: ne of equalities, nf of friction loss, nl of limits, then contacts.
    num_contact_free = impl.ne + impl.nf + impl.nl
    couplings = contact_rows.couplings(model)
    division = contact_rows.blocks(num_contact_free, impl.contact.dim, couplings)
    # A NaN counts as touching, so that it gets to the acceleration.
    is_touching = ~(impl.contact.dist - impl.contact.includemargin >= 0)
    jacobian = contact_rows.with_bases(division, impl.efc_J, is_touching)
    is_two_sided, loss = _kinds(data)
    rows = Rows(jacobian, impl.efc_aref, impl.efc_D, is_two_sided, loss)
    return Problem(division, rows, mjx.full_m(model, data), is_touching)


def start(model: mjx.Model, data: mjx.Data, problem: Problem) -> Point:
    """Returns the unconstrained acceleration, or the warm start if that is on and costs less."""

    def point_at(qacc: jax.Array) -> Point:
        imbalance = problem.inertia @ qacc - data.qfrc_smooth
        return Point(qacc, imbalance, problem.along(qacc) - problem.rows.reference)

    cold_start = point_at(data.qacc_smooth)
    if model.opt.disableflags & mjx.DisableBit.WARMSTART:
        return cold_start
    # As ``warmstart`` of C's ``mj_fwdConstraint``; at a tie, or a NaN, the cold start.
    warm_start = point_at(data.qacc_warmstart)
    is_warm = _cost(problem.rows, data, warm_start) < _cost(problem.rows, data, cold_start)
    return jax.tree.map(lambda w, c: jnp.where(is_warm, w, c), warm_start, cold_start)


def _kinds(data: mjx.Data) -> tuple[jax.Array, jax.Array | None]:
    """Returns which rows [rows] are active on both sides, and ``Rows.loss``."""
    impl = jax_fields(data)
    num_two_sided = impl.ne + impl.nf
    loss = None
    if impl.nf:
        loss = impl.efc_frictionloss[:num_two_sided].at[: impl.ne].set(jnp.inf)
    return jnp.arange(impl.efc_D.size) < num_two_sided, loss


def descend(max_steps: int, improve: Callable[[Search], Search], start: Any) -> Any:
    """Returns the point that Newton's method reaches from a start in so many steps."""
    return jax.lax.while_loop(
        lambda search: ~search.is_converged & (search.steps < max_steps),
        improve,
        Search(start, jnp.int32(0), jnp.array(False)),
    ).point


def smallest_decrement(model: mjx.Model, inertia: jax.Array) -> jax.Array:
    """Returns by how much a step must lower the cost for another one to be made, []."""
    return model.opt.tolerance * jnp.maximum(jnp.trace(inertia), _MIN_TRACE)


def _cost(rows: Rows, data: mjx.Data, point: Point) -> jax.Array:
    """Returns what is minimized, []."""
    penalty = jnp.sum(rows.cost(point.residual))
    return (jnp.dot(point.imbalance, point.qacc - data.qacc_smooth) + penalty) / 2


def newton_direction(problem: Problem, point: Point) -> tuple[jax.Array, jax.Array]:
    """Returns Newton's step [nv] and the gradient [nv].

    Half their product is by how much the cost would fall along the whole step if no row changed, up
    to the sign; it keeps its digits near the minimum, where the difference of two costs would be
    rounding error.
    """
    rows = problem.rows
    # The Hessian is M + J' D J over the active rows, as C's ``MakeHessian``; the gradient is the
    # imbalance minus J' f, as ``PrimalUpdateGrad``.
    active_mass = jnp.where(rows.active(point.residual), rows.constraint_mass, 0)
    efc_force = rows.force(point.residual)
    hessian, qfrc_constraint = contact_rows.weighted(
        problem.division, problem.inertia, rows.jacobian, active_mass, efc_force
    )
    gradient = point.imbalance - qfrc_constraint
    return -solve(hessian, gradient), gradient


def _line_search(
    rows: Rows, point: Point, change: jax.Array, smooth_line: Line, max_rounds: int
) -> jax.Array:
    """Returns the length of the step that leads to the least cost, [].

    Args:
      rows: the constraints.
      point: where the step starts.
      change: [rows] how the residual changes along it.
      smooth_line: the derivative along it that has no rows.
      max_rounds: lengths to evaluate at most.
    """
    # Of each row once, for all lengths: what changes with the length is which rows count. C keeps
    # the same two, and the cost, in the quadratics of ``PrimalPrepare``.
    row_slope = rows.constraint_mass * change * point.residual
    row_curvature = rows.constraint_mass * change**2

    def line(active: jax.Array, residual: jax.Array) -> Line:
        """Returns the line of the rows in their states at a residual [rows]."""
        intercept = smooth_line.intercept + jnp.sum(jnp.where(active, row_slope, 0))
        if rows.loss is not None:  # a row that slides adds the same slope at every length
            intercept -= jnp.dot(rows.sliding(residual), change)
        return Line(intercept, smooth_line.rate + jnp.sum(jnp.where(active, row_curvature, 0)))

    def line_at(length: jax.Array) -> Line:
        """Returns the line at a length []."""
        residual = point.residual + length * change
        is_pushing = rows.is_two_sided | (residual < 0)
        return line(is_pushing if rows.loss is None else rows.active(residual), residual)

    return root(line(rows.active(point.residual), point.residual), line_at, max_rounds)


def root(start_line: Line, line_at: Callable[[jax.Array], Line], max_rounds: int) -> jax.Array:
    """Returns the length of a step at which the cost's derivative along it is zero, [].

    The derivative increases, and is linear as long as no row changes. Each round evaluates the root
    of the linear piece found last; where rounding puts that root outside of the interval known to
    hold the derivative's, the round evaluates the interval's middle. At the minimum the direction
    is zero, and the length is 1.

    Args:
      start_line: the line where the step starts.
      line_at: length [] -> the line there.
      max_rounds: lengths to evaluate at most.
    """

    def evaluate(search: _LineSearch) -> _LineSearch:
        """Evaluates one length, and takes the part of the interval that holds the root."""
        is_out = (search.root <= search.low) | (search.root >= search.high)
        length = jnp.where(is_out, (search.low + search.high) / 2, search.root)
        is_wide = search.low < _NARROW_RATIO * search.high
        line = line_at(length)
        # A line that does not increase has no root: the direction is zero, or there is a NaN.
        root = jnp.where(line.rate > 0, -line.intercept / line.rate, length)
        moves = [(x < y) | (x > y) for x, y in zip(line, search.line, strict=True)]
        return _LineSearch(
            # The derivative increases: where the line's root is ahead it is negative at the length.
            low=jnp.where(root > length, length, search.low),
            high=jnp.where(root > length, search.high, length),
            root=root,
            line=line,
            evaluations=search.evaluations + 1,
            # In the middle of a wide interval, the last line's root may not be the derivative's.
            is_converged=~((is_out & is_wide) | jnp.any(jnp.stack(moves))),  # a NaN does not move
        )

    start = _LineSearch(
        low=jnp.zeros_like(start_line.rate),
        high=jnp.full_like(start_line.rate, jnp.inf),
        root=jnp.ones_like(start_line.rate),  # a full Newton step
        line=start_line,
        evaluations=jnp.int32(0),
        is_converged=jnp.array(False),
    )
    return jax.lax.while_loop(
        lambda search: ~search.is_converged & (search.evaluations < max_rounds), evaluate, start
    ).root


def solve_in_loops(model: mjx.Model, data: mjx.Data) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Finds what ``solve_newton`` does, from the unconstrained acceleration."""
    groups = _rows_by_contact(model, data)
    inertia = mjx.full_m(model, data)
    min_decrement = smallest_decrement(model, inertia)

    def improve(search: Search) -> Search:
        """Makes the step of ``solve_newton``, of which every sum over rows is a loop here."""
        qacc, imbalance = search.point
        direction, decrement, residuals = _direction_in_loops(groups, inertia, *search.point)
        change_of_imbalance = inertia @ direction
        smooth_line = Line(jnp.dot(direction, imbalance), jnp.dot(direction, change_of_imbalance))
        _, residual_changes = _fold(lambda _, rows: (None, rows.jacobian @ direction), None, groups)

        def line_at(length: jax.Array) -> Line:
            """Returns the line at a length []."""

            def add_contact(line: Line, contact: tuple) -> tuple[Line, None]:
                """Adds to the line what the rows of one contact have."""
                rows, residual, change = contact
                active = rows.active(residual + length * change)
                weighted_change = jnp.where(active, rows.constraint_mass * change, 0)
                intercept = line.intercept + jnp.dot(weighted_change, residual)
                if rows.loss is not None:
                    intercept -= jnp.dot(rows.sliding(residual + length * change), change)
                return Line(intercept, line.rate + jnp.dot(weighted_change, change)), None

            return _fold(add_contact, smooth_line, groups, residuals, residual_changes)[0]

        length = root(line_at(jnp.zeros_like(decrement)), line_at, model.opt.ls_iterations)

        def compare(has_same_rows: jax.Array, contact: tuple) -> tuple[jax.Array, None]:
            rows, residual, change = contact
            return has_same_rows & jnp.all(rows.alike(residual + length * change, residual)), None

        has_same_rows, _ = _fold(compare, jnp.array(True), groups, residuals, residual_changes)
        new_point = qacc + length * direction, imbalance + length * change_of_imbalance
        return Search(new_point, search.steps + 1, has_same_rows | (decrement < min_decrement))

    # At the unconstrained acceleration the imbalance M a - qfrc_smooth is zero.
    start = data.qacc_smooth, jnp.zeros_like(data.qacc_smooth)
    qacc, _ = descend(max(model.opt.iterations, _STEPS_FROM_COLD), improve, start)

    def push(qfrc_constraint: jax.Array, rows: Rows) -> tuple[jax.Array, jax.Array]:
        residual = rows.jacobian @ qacc - rows.reference
        force = rows.force(residual)
        return qfrc_constraint + rows.jacobian.T @ force, force

    # The groups are in the order of the rows, and so is what they give.
    qfrc_constraint, forces = _fold(push, jnp.zeros_like(qacc), groups)
    return qacc, qfrc_constraint, jnp.concatenate([force.reshape(-1) for force in forces])


def _rows_by_contact(model: mjx.Model, data: mjx.Data) -> list[Rows]:
    """Divides the rows into those of no contact and those of the contacts of each dimension.

    The arrays are [contacts, rows of a contact, ...]; the rows of no contact are as if of one.
    """
    impl = jax_fields(data)
    num_contact_free = impl.ne + impl.nf + impl.nl
    couplings = contact_rows.couplings(model)
    division = contact_rows.blocks(num_contact_free, impl.contact.dim, couplings)
    is_two_sided, loss = _kinds(data)
    rows = impl.efc_J, impl.efc_aref, impl.efc_D, is_two_sided
    groups = zip(*(contact_rows.by_group(division, x) for x in rows), strict=True)
    if loss is not None:  # of equalities and friction loss, never of a contact's rows
        loss = loss[None]
    contact_free = Rows(*(x[None, :num_contact_free] for x in rows), loss=loss)
    return [contact_free, *(Rows(*group) for group in groups)]


def _fold(step: Callable, start: Any, *groups: Sequence) -> tuple[Any, list]:
    """Goes from contact to contact, as ``lax.scan``, through all groups.

    Args:
      step: (state, what a contact has) -> (state, result).
      start: the first state.
      *groups: what the contacts of each group have, [contacts, ...].

    Returns:
      The last state, and the results of each group.
    """
    state = start
    group_outputs = []
    for contacts in zip(*groups, strict=True):
        # With one list of groups, ``step`` takes what a contact has, not a tuple of one.
        state, outputs = lax.scan(step, state, contacts if len(groups) > 1 else contacts[0])
        group_outputs.append(outputs)
    return state, group_outputs


def _direction_in_loops(
    groups: list[Rows], inertia: jax.Array, qacc: jax.Array, imbalance: jax.Array
) -> tuple[jax.Array, jax.Array, list[jax.Array]]:
    """Returns the step [nv], by how much the cost would fall [], and residuals.

    See ``newton_direction``.
    """

    def add_contact(sums: tuple, rows: Rows) -> tuple[tuple, jax.Array]:
        """Adds one contact's rows to the Hessian and the gradient; returns their residuals too."""
        residual = rows.jacobian @ qacc - rows.reference
        active_mass = jnp.where(rows.active(residual), rows.constraint_mass, 0)

        def add_rows() -> tuple:
            """Returns the Hessian + J' D J, and the gradient - J' f."""
            hessian, gradient = sums
            weighted_jacobian = rows.jacobian.T * active_mass
            slope = gradient + weighted_jacobian @ residual
            if rows.loss is not None:
                slope -= rows.jacobian.T @ rows.sliding(residual)
            return hessian + weighted_jacobian @ rows.jacobian, slope

        if rows.loss is not None:  # all rows may slide
            return add_rows(), residual
        return skippable(jnp.any(active_mass != 0), add_rows, sums), residual

    (hessian, gradient), residuals = _fold(add_contact, (inertia, imbalance), groups)
    direction = -_inverse_times(hessian, gradient)
    return direction, -jnp.dot(gradient, direction) / 2, residuals


def _inverse_times(matrix: jax.Array, rhs: jax.Array) -> jax.Array:
    """Returns inv(matrix) rhs, [nv], for a positive definite matrix [nv, nv].

    Each round eliminates the first of the unknowns that are left, and moves the others up by one
    place, so that all rounds are the same code.
    """

    def eliminate(system: tuple, _: None) -> tuple[tuple, tuple]:
        """Eliminates the first unknown; returns the smaller system, padded, and its equation."""
        matrix, rhs = system
        column = matrix[:, 0]
        inverse = 1 / matrix[0, 0]
        factors = column * inverse
        matrix = matrix - factors[:, None] * column
        remainder = rhs - factors * rhs[0]
        # The zeros that move in at the end are of unknowns that are already eliminated.
        smaller_system = jnp.pad(matrix[1:, 1:], (0, 1)), jnp.pad(remainder[1:], (0, 1))
        return smaller_system, (factors[1:], rhs[0] * inverse)

    def substitute(solution: jax.Array, equation: tuple) -> tuple[jax.Array, None]:
        factors, value = equation
        return jnp.append(value - jnp.dot(factors, solution[:-1]), solution[:-1]), None

    # The last unknown first; each one moves those after it down by a place.
    _, equations = lax.scan(eliminate, (matrix, rhs), None, len(rhs))
    return lax.scan(substitute, jnp.zeros_like(rhs), equations, reverse=True)[0]
