"""The natural gradient: the steepest ascent where distance is how far the policy moves.

Of all small changes of the parameters that move the policy equally far in KL divergence, the best
is along ``F^-1 g`` (Kakade 2001, "A natural policy gradient"), with the Fisher matrix

    F = E[J^T H J]

averaged over the visited steps; J is the derivative of the distribution's parameters in those of
the policy, and H the second derivative of KL(old || new) in the former, at new = old.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from mjx_reinforce.engine.checks import check_count, check_kind, check_number
from mjx_reinforce.learning.policy import Policy
from mjx_reinforce.learning.samples import draw_steps, in_groups
from mjx_reinforce.learning.updates import Problem, Update, whole_rollout

#: Conjugate gradients know F from so many of the visited steps at most.
MAX_FISHER_STEPS = 4096
#: They end where the residual is this share of the gradient.
_TOLERANCE = 1e-8

#: (problem, key, params, gradient) -> (F + damping I)^-1 gradient; may consume the key.
LinearSolver = Callable[[Problem, jax.Array, Any, Any], Any]


def natural_gradient(
    policy: Policy,
    max_kl: float | jax.Array,
    *,
    damping: float | jax.Array = 0.1,
    iterations: int = 10,
) -> Update:
    """One step along x = (F + damping I)^-1 g, with the gradient g of the whole rollout.

    The step's length is that at which the quadratic model of the KL divergence, half the square of
    the step in F + damping I, is ``max_kl``: sqrt(2 max_kl / g'x) x (Schulman et al. 2015,
    arXiv:1502.05477, appendix C; Rajeswaran et al. 2017, arXiv:1703.02660, equation 5, who leave
    out the 2). The scale of the weights has no effect on it. The optimizer is given that step in
    the place of a gradient: ``optax.sgd(1.0)`` makes the step as it is, and a schedule shortens it.
    ``reinforce(max_kl=...)`` shortens a step for which the model was too good.

    Conjugate gradients solve for x, with products of F and a vector that are two passes through the
    network (Schulman et al. 2015, appendix C), over all visited steps or ``MAX_FISHER_STEPS`` that
    are drawn.

    The metrics are those of ``full_batch``; ``gradient_norm`` and ``gradient_snr`` are of g.

    Args:
      policy: the one that is trained.
      max_kl: in nats, the mean over the visited steps.
      damping: added to the diagonal of F, in its unit, nats per square of a parameter. It keeps
        directions in which the policy hardly changes, where the gradient is mostly noise, from
        being followed far. What it adds to the model of the KL divergence, the policy moves less.
      iterations: of the conjugate gradients.

    Raises:
      ValueError: the policy's distribution does not know its KL divergence, ``max_kl`` or
        ``damping`` is not positive, or ``iterations`` is less than one.

    Examples:
      >>> import jax, optax
      >>> import mjx_reinforce as mr
      >>> env = mr.envs.make("CartPole-v1")
      >>> policy = mr.mlp_policy(env.observation_size, mr.categorical(env.action_space), ())
      >>> update = mr.natural_gradient(policy, max_kl=0.01)
      >>> learner = mr.reinforce(
      ...     env, policy=policy, update=update, optimizer=optax.sgd(1.0), num_episodes=4
      ... )
      >>> state, metrics = mr.train_step(learner, learner.init(jax.random.key(0)))
      >>> metrics["kl"].shape
      ()
    """
    check_kind("policy", policy, Policy, "mjx_reinforce.mlp_policy(...)")
    check_number("max_kl", max_kl, positive=True)
    check_number("damping", damping, positive=True)
    check_count("iterations", iterations)
    if policy.distribution.kl is None:
        raise ValueError(
            "the natural gradient needs a distribution whose KL divergence is known, as that of "
            "all families of the package is: give yours a kl, or choose another update"
        )
    solve = _by_conjugate_gradients(policy, damping, iterations)

    def turn(problem, key, params, gradient):
        """Returns the step, sqrt(2 max_kl / g'x) x with x = (F + damping I)^-1 g, a pytree."""
        flat_gradient, unravel = ravel_pytree(gradient)
        # The step does not depend on the length of g; of a unit vector nothing over- or underflows.
        norm = jnp.linalg.norm(flat_gradient)
        unit_gradient = flat_gradient / jnp.where(norm > 0, norm, 1.0)
        direction = ravel_pytree(solve(problem, key, params, unravel(unit_gradient)))[0]
        # g'x is positive, as the matrix is positive definite; without a gradient it is 0, and the
        # policy stays.
        slope = jnp.vdot(unit_gradient, direction, precision="highest")
        length = jnp.where(slope > 0, jnp.sqrt(2 * max_kl / jnp.where(slope > 0, slope, 1.0)), 0.0)
        return unravel((length * direction).astype(flat_gradient.dtype))

    return whole_rollout(turn)


def _by_conjugate_gradients(
    policy: Policy, damping: float | jax.Array, iterations: int
) -> LinearSolver:
    """Returns what solves with products of F alone."""

    def solve(problem, key, params, gradient):
        """Returns (F + damping I)^-1 gradient, a pytree, from S of the visited steps."""
        observation, *_, mask = problem.samples
        observation = observation.reshape(mask.size, -1)
        # The share [S] of each step in the mean over the visited ones. Steps that are drawn are all
        # inside the mask; otherwise those outside have no share.
        if mask.size > MAX_FISHER_STEPS:
            observation = observation[draw_steps(key, mask, (MAX_FISHER_STEPS,))]
            step_weight = jnp.full(MAX_FISHER_STEPS, 1 / MAX_FISHER_STEPS)
        else:
            step_weight = mask.reshape(-1) / jnp.maximum(jnp.sum(mask), 1)

        def outputs(params):
            return in_groups(policy.apply)(params, observation)

        # J v and J^T u at the old parameters: the network is linearized once, not in each product.
        old_outputs, jacobian_product = jax.linearize(outputs, params)
        transpose_product = jax.linear_transpose(jacobian_product, params)

        def mean_kl(new_outputs):
            kl = policy.distribution.kl
            return jnp.sum(step_weight * kl(old_outputs, new_outputs))  # type: ignore[misc]

        # H u: the derivative of KL's gradient in the outputs [S, K], at new = old.
        hessian_product = jax.linearize(jax.grad(mean_kl), old_outputs)[1]

        flat, unravel = ravel_pytree(gradient)

        def damped_fisher(vector):
            # F v = J^T H J v, from right to left: F itself, [P, P] for P parameters, is not made.
            outputs_change = jacobian_product(unravel(vector))
            (product,) = transpose_product(hessian_product(outputs_change))
            return ravel_pytree(product)[0] + jnp.asarray(damping, flat.dtype) * vector

        cg = jax.scipy.sparse.linalg.cg
        return unravel(cg(damped_fisher, flat, tol=_TOLERANCE, maxiter=iterations)[0])

    return solve
