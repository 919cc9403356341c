"""Updates: how the weights of one rollout become changes of the parameters.

All of them follow the gradient that ``reinforce`` states. They differ in the number of optimiser
steps for one rollout. From the second step on, the parameters are no longer those that played the
episodes. No update corrects for that (there are no importance weights), and neither do the
published programs that these updates follow.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import lax

from mjx_reinforce.engines.chunks import while_any
from mjx_reinforce.learners.gradients import accumulate_gradient
from mjx_reinforce.registry import check_name

#: Optimisers by name.
OPTIMIZERS = ("adam", "adamw", "sgd")


class Problem(NamedTuple):
    """What a rollout leaves to be done.

    surrogate: (params, samples) -> (loss [], summed over samples of any leading axes; the sums
      of metrics, ``entropy`` among them)
    optimizer: what turns gradients into changes
    samples: observation [T, N, O], action [T, N, ...], weight [T, N] and mask [T, N]
    divisor: [] by which the sum over all samples is divided
    """

    surrogate: Callable[[Any, tuple[jax.Array, ...]], tuple[jax.Array, dict[str, jax.Array]]]
    optimizer: optax.GradientTransformation
    samples: tuple[jax.Array, ...]
    divisor: int | jax.Array


#: (problem, key, params, opt_state) -> (params, opt_state, metrics ``entropy`` and
#: ``gradient_norm``, means over samples and optimiser steps); may consume the key.
Update = Callable[[Problem, jax.Array, Any, Any], tuple[Any, Any, dict[str, jax.Array]]]


def full_batch() -> Update:
    """One optimiser step on the gradient of the whole rollout."""

    def update(problem, key, params, opt_state):
        del key
        mask = problem.samples[-1]
        _, grads, sums = accumulate_gradient(problem.surrogate, params, problem.samples)
        params, opt_state, norm = _descend(problem, grads, problem.divisor, params, opt_state)
        steps = jnp.maximum(jnp.sum(mask), 1)
        return params, opt_state, {"entropy": sums["entropy"] / steps, "gradient_norm": norm}

    return update


def minibatches(num_updates: int, batch_size: int) -> Update:
    """Several optimiser steps, each on steps drawn with replacement from all episodes.

    The loss is the mean over the minibatch, whatever the problem's divisor. From the second step
    on the samples are those of an older policy.

    Args:
      num_updates: optimiser steps a rollout.
      batch_size: steps of the episodes a minibatch.

    Raises:
      ValueError: a number is less than one.
    """
    for name, value in (("num_updates", num_updates), ("batch_size", batch_size)):
        if value < 1:
            raise ValueError(f"{name} must be at least 1, got {value}")

    def update(problem, key, params, opt_state):
        mask = problem.samples[-1].reshape(-1)
        flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), problem.samples)
        ranks = jnp.cumsum(mask)
        drawn = jax.random.randint(key, (num_updates, batch_size), 1, 1 + jnp.maximum(ranks[-1], 1))
        # Where the first, second, ... step inside the mask is; ``drawn`` counts from 1.
        indices = jnp.searchsorted(ranks, drawn)

        def one(carry, index):
            params, opt_state = carry
            batch = jax.tree.map(lambda x: x[index], flat)
            grads, sums = jax.grad(problem.surrogate, has_aux=True)(params, batch)
            params, opt_state, norm = _descend(problem, grads, batch_size, params, opt_state)
            return (params, opt_state), (sums["entropy"] / batch_size, norm)

        (params, opt_state), (entropy, norm) = lax.scan(one, (params, opt_state), indices)
        return params, opt_state, {"entropy": jnp.mean(entropy), "gradient_norm": jnp.mean(norm)}

    return update


def each_step() -> Update:
    """One optimiser step for every time step, in order, after all episodes are over.

    Step t follows its own share of the full gradient, the terms of all episodes at t, at the
    parameters that steps 0 to t - 1 have moved (Sutton and Barto 2018, section 13.3, has
    discount^t besides: see ``estimators.discount_weights``).
    """

    def update(problem, key, params, opt_state):
        del key
        mask = problem.samples[-1]
        alive = jnp.any(mask, axis=1)
        horizon = alive.size

        def more(carry):
            t = carry[0]
            return (t < horizon) & alive[jnp.minimum(t, horizon - 1)]

        def body(carry):
            t, params, opt_state, entropy, norms = carry
            now = jax.tree.map(
                lambda x: lax.dynamic_index_in_dim(x, t, keepdims=False), problem.samples
            )
            grads, sums = jax.grad(problem.surrogate, has_aux=True)(params, now)
            moved, moved_state, norm = _descend(problem, grads, problem.divisor, params, opt_state)
            after = t + 1, moved, moved_state, entropy + sums["entropy"], norms + norm
            # Vmapped over seeds, the loop goes on until the seed with the longest episode is done.
            return jax.tree.map(lambda new, old: jnp.where(more(carry), new, old), after, carry)

        zero = jnp.zeros(())
        init = (jnp.zeros((), jnp.int32), params, opt_state, zero, zero)
        t, params, opt_state, entropy, norms = while_any(more, body, init)
        steps = jnp.maximum(jnp.sum(mask), 1)
        metrics = {"entropy": entropy / steps, "gradient_norm": norms / jnp.maximum(t, 1)}
        return params, opt_state, metrics

    return update


def _descend(
    problem: Problem, grads: Any, divisor: int | jax.Array, params: Any, opt_state: Any
) -> tuple[Any, Any, jax.Array]:
    """Makes one optimiser step on summed gradients; also returns the norm of their mean."""
    grads = jax.tree.map(lambda g: g / divisor, grads)
    changes, opt_state = problem.optimizer.update(grads, opt_state, params)
    return optax.apply_updates(params, changes), opt_state, optax.tree.norm(grads)


def make_optimizer(
    name: str = "adam",
    learning_rate: Any = 1e-2,
    *,
    weight_decay: float = 0.0,
    max_grad_norm: float | jax.Array | None = 1.0,
) -> optax.GradientTransformation:
    """Builds an optimiser with the constants that PyTorch and optax share.

    Args:
      name: "adam"; "sgd"; or "adamw", whose weight decay is apart from the gradient (Loshchilov
        and Hutter 2019, arXiv:1711.05101): the parameters shrink by learning rate times decay.
      learning_rate: a number or an optax schedule over optimiser steps.
      weight_decay: for the others, times the parameters added to the gradient: an L2 penalty,
        which Adam then rescales with the rest, as ``torch.optim.Adam(weight_decay=...)`` does.
      max_grad_norm: the gradient, before the weight decay, is scaled down to at most this
        Euclidean norm; None leaves it as it is.

    Raises:
      ValueError: the name is unknown.
    """
    check_name("optimizer", name, dict.fromkeys(OPTIMIZERS))
    parts = []
    if max_grad_norm is not None:
        parts.append(optax.clip_by_global_norm(max_grad_norm))
    if name == "adamw":
        return optax.chain(*parts, optax.adamw(learning_rate, weight_decay=weight_decay))
    if weight_decay:
        parts.append(optax.add_decayed_weights(weight_decay))
    return optax.chain(*parts, (optax.adam if name == "adam" else optax.sgd)(learning_rate))
