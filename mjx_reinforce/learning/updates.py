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
from optax import Params

from mjx_reinforce.engine.checks import check_count, check_name, check_number
from mjx_reinforce.engine.play.episode import while_any
from mjx_reinforce.learning.diagnostics import signal_to_noise
from mjx_reinforce.learning.gradients import accumulate_gradient, draw_steps, while_needed
from mjx_reinforce.learning.schedules import Clock

#: Optimisers by name.
OPTIMIZERS = ("adam", "adamw", "sgd")


class Problem(NamedTuple):
    """What a rollout leaves to be done.

    surrogate: (params, samples) -> (loss [], summed over samples of any leading axes; the sums
      of metrics, ``entropy`` among them)
    optimizer: what turns gradients into changes
    samples: observation [T, N, O], action [T, N, ...], weight [T, N] and mask [T, N]
    divisor: [] by which the sum over all samples is divided
    clock: how far the run was before the rollout
    """

    surrogate: Callable[[Any, tuple[jax.Array, ...]], tuple[jax.Array, dict[str, jax.Array]]]
    optimizer: optax.GradientTransformation
    samples: tuple[jax.Array, ...]
    divisor: int | jax.Array
    clock: Clock


#: The gradient's noise is measured on one of so many episodes, and on so many at most.
_NOISE_SHARE, _NOISE_EPISODES = 32, 64

#: (problem, key, params, opt_state) -> (params, opt_state, metrics); may consume the key. The
#: metrics are ``entropy``, the mean over samples; ``gradient_norm`` and, where ``make_optimizer``
#: made the optimiser and it clips, ``clipped_gradients`` (1 or 0), means over optimiser steps; and
#: what an update adds.
Update = Callable[[Problem, jax.Array, Any, Any], tuple[Any, Any, dict[str, Any]]]
#: (problem, key, params, gradient) -> what the optimiser is given for it; may consume the key.
Turn = Callable[[Problem, jax.Array, Any, Any], Any]


def full_batch() -> Update:
    """One optimiser step on the gradient of the whole rollout.

    Of two episodes or more, its metrics have ``gradient_snr``, the signal-to-noise ratio over
    episodes of that gradient, see ``diagnostics.signal_to_noise``. The noise is estimated from one
    episode in 32, at least from one and at most from 64: from few it is right on average alone.

    Examples:
      >>> import jax
      >>> import mjx_reinforce as mr
      >>> env = mr.envs.make("CartPole-v1")
      >>> learner = mr.reinforce(env, update=mr.full_batch(), num_episodes=4, horizon=20)
      >>> state, metrics = mr.train_step(learner, learner.init(jax.random.key(0)))
      >>> metrics["gradient_norm"].shape
      ()
    """
    return whole_rollout(lambda problem, key, params, gradient: gradient)


def whole_rollout(turn: Turn) -> Update:
    """``full_batch``, in which ``turn`` makes another step of the gradient."""

    def update(problem, key, params, opt_state):
        mask = problem.samples[-1]
        _, grads, sums = accumulate_gradient(problem.surrogate, params, problem.samples)
        metrics = {}
        if mask.shape[1] > 1:
            metrics["gradient_snr"] = _signal_to_noise(problem, params, grads)
        metrics["entropy"] = sums["entropy"] / jnp.maximum(jnp.sum(mask), 1)
        params, opt_state, step = _descend(
            problem,
            grads,
            problem.divisor,
            params,
            opt_state,
            turn=lambda gradient: turn(problem, key, params, gradient),
        )
        return params, opt_state, metrics | step

    return update


def _signal_to_noise(problem: Problem, params: Params, grads: Params) -> jax.Array:
    """Returns the signal-to-noise ratio [] of the gradients summed over all episodes."""
    num_episodes = problem.samples[-1].shape[1]
    few = min(max(1, num_episodes // _NOISE_SHARE), _NOISE_EPISODES)

    def alone(episode):
        samples = jax.tree.map(lambda x: x[:, None], episode)
        return accumulate_gradient(problem.surrogate, params, samples)[1]

    each = jax.vmap(alone, in_axes=1)(jax.tree.map(lambda x: x[:, :few], problem.samples))
    mean = jax.tree.map(lambda g: g / num_episodes, grads)
    return signal_to_noise(mean, each, num_episodes)


def minibatches(num_updates: int, batch_size: int) -> Update:
    """Several optimiser steps, each on steps drawn with replacement from all episodes.

    The loss is the mean over the minibatch, whatever the problem's divisor. From the second step
    on the samples are those of an older policy.

    Args:
      num_updates: optimiser steps a rollout.
      batch_size: steps of the episodes a minibatch.

    Raises:
      ValueError: a number is less than one.

    Examples:
      >>> import jax
      >>> import mjx_reinforce as mr
      >>> env = mr.envs.make("CartPole-v1")
      >>> update = mr.minibatches(num_updates=2, batch_size=16)
      >>> learner = mr.reinforce(env, update=update, num_episodes=4, horizon=20)
      >>> state, metrics = mr.train_step(learner, learner.init(jax.random.key(0)))
      >>> metrics["gradient_norm"].shape
      ()
    """
    for name, value in (("num_updates", num_updates), ("batch_size", batch_size)):
        check_count(name, value)

    def update(problem, key, params, opt_state):
        mask = problem.samples[-1].reshape(-1)
        flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), problem.samples)
        indices = draw_steps(key, mask, (num_updates, batch_size))

        def one(carry, index):
            params, opt_state = carry
            batch = jax.tree.map(lambda x: x[index], flat)
            grads, sums = jax.grad(problem.surrogate, has_aux=True)(params, batch)
            params, opt_state, step = _descend(problem, grads, batch_size, params, opt_state)
            return (params, opt_state), step | {"entropy": sums["entropy"] / batch_size}

        (params, opt_state), steps = lax.scan(one, (params, opt_state), indices)
        return params, opt_state, {name: jnp.mean(x) for name, x in steps.items()}

    return update


def each_step() -> Update:
    """One optimiser step for every time step, in order, after all episodes are over.

    Step t follows its own share of the full gradient, the terms of all episodes at t, at the
    parameters that steps 0 to t - 1 have moved (Sutton and Barto 2018, section 13.3, has
    discount^t besides: see ``estimators.discount_weights``).

    Examples:
      >>> import jax
      >>> import mjx_reinforce as mr
      >>> env = mr.envs.make("CartPole-v1")
      >>> learner = mr.reinforce(env, update=mr.each_step(), num_episodes=4, horizon=20)
      >>> state, metrics = mr.train_step(learner, learner.init(jax.random.key(0)))
      >>> metrics["gradient_norm"].shape
      ()
    """

    def update(problem, key, params, opt_state):
        del key
        mask = problem.samples[-1]
        more = while_needed(jnp.any(mask, axis=1))

        def one(t, params, opt_state):
            now = jax.tree.map(
                lambda x: lax.dynamic_index_in_dim(x, t, keepdims=False), problem.samples
            )
            grads, sums = jax.grad(problem.surrogate, has_aux=True)(params, now)
            params, opt_state, step = _descend(problem, grads, problem.divisor, params, opt_state)
            return params, opt_state, step | sums

        def body(carry):
            t, params, opt_state, sums = carry
            moved, moved_state, measured = one(t, params, opt_state)
            after = t + 1, moved, moved_state, jax.tree.map(jnp.add, sums, measured)
            # Vmapped over seeds, the loop goes on until the seed with the longest episode is done.
            return jax.tree.map(lambda new, old: jnp.where(more(carry), new, old), after, carry)

        start = jnp.zeros((), jnp.int32)
        measured = jax.eval_shape(one, start, params, opt_state)[2]
        zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), measured)
        t, params, opt_state, sums = while_any(more, body, (start, params, opt_state, zeros))
        entropy = sums.pop("entropy") / jnp.maximum(jnp.sum(mask), 1)
        means = {name: x / jnp.maximum(t, 1) for name, x in sums.items()}
        return params, opt_state, means | {"entropy": entropy}

    return update


def _descend(
    problem: Problem,
    grads: Params,
    divisor: int | jax.Array,
    params: Params,
    opt_state: optax.OptState,
    turn: Callable[[Any], Any] = lambda gradient: gradient,
) -> tuple[Any, Any, dict[str, jax.Array]]:
    """Makes one optimiser step on summed gradients; also returns the metrics of that step.

    The optimiser is given what ``turn`` makes of the mean gradient.
    """
    grads = jax.tree.map(lambda g: g / divisor, grads)
    optimizer = optax.with_extra_args_support(problem.optimizer)
    changes, opt_state = optimizer.update(turn(grads), opt_state, params, clock=problem.clock)
    metrics = {"gradient_norm": optax.tree.norm(grads)}
    parts = jax.tree.leaves(opt_state, is_leaf=lambda x: isinstance(x, ClipState))
    for part in parts:
        if isinstance(part, ClipState):
            metrics["clipped_gradients"] = part.clipped.astype(float)
    return optax.apply_updates(params, changes), opt_state, metrics


class ClipState(NamedTuple):
    """State of ``clip_by_norm``: whether the last gradient was longer than its bound, bool []."""

    clipped: jax.Array


def clip_by_norm(max_norm: float | jax.Array) -> optax.GradientTransformation:
    """``optax.clip_by_global_norm``, which also remembers whether it clipped."""
    clip = optax.clip_by_global_norm(max_norm)

    def init(params):
        del params
        return ClipState(jnp.zeros((), bool))

    def update(updates, state, params=None):
        del state, params
        clipped = ClipState(optax.tree.norm(updates) > max_norm)
        return clip.update(updates, optax.EmptyState())[0], clipped

    return optax.GradientTransformation(init, update)


def make_optimizer(
    name: str = "adam",
    learning_rate: optax.ScalarOrSchedule = 1e-2,
    *,
    weight_decay: float = 0.0,
    max_grad_norm: float | jax.Array | None = 1.0,
    momentum: float | jax.Array = 0.9,
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
      momentum: b1 of Adam; sgd has none.

    Raises:
      ValueError: the name is unknown, or a number in its place.

    Examples:
      >>> import jax.numpy as jnp
      >>> import mjx_reinforce as mr
      >>> optimizer = mr.make_optimizer("sgd", 0.5, max_grad_norm=None)
      >>> step, _ = optimizer.update(jnp.ones(2), optimizer.init(jnp.zeros(2)), jnp.zeros(2))
      >>> step.tolist()
      [-0.5, -0.5]
    """
    if not isinstance(name, str):
        raise ValueError(f"the optimizer's name comes first, got {name!r}: write learning_rate=...")
    check_name("optimizer", name, dict.fromkeys(OPTIMIZERS))
    rate: Any = learning_rate
    if not callable(rate):
        check_number("learning_rate", rate)
    check_number("weight_decay", weight_decay)
    check_number("momentum", momentum)
    parts = []
    if max_grad_norm is not None:
        check_number("max_grad_norm", max_grad_norm, positive=True, finite=False)
        parts.append(clip_by_norm(max_grad_norm))
    if name == "adamw":
        return optax.chain(*parts, optax.adamw(learning_rate, momentum, weight_decay=weight_decay))
    if weight_decay:
        parts.append(optax.add_decayed_weights(weight_decay))
    last = optax.adam(learning_rate, momentum) if name == "adam" else optax.sgd(learning_rate)
    return optax.chain(*parts, last)
