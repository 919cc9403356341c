"""Updates: how the weights of one rollout become changes of the parameters.

``full_batch`` makes one optimizer step on the gradient that ``reinforce`` states. The step of the
natural gradient is in ``natural_gradient``; ``published.variants`` has updates of several steps.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from optax import Params

from mjx_reinforce.engine.checks import check_name, check_number
from mjx_reinforce.learning.samples import accumulate_gradient


class Clock(NamedTuple):
    """How far a run was before a rollout.

    progress: [] the share of its budget that was used
    env_steps: [] float, how many the seed had played
    """

    progress: jax.Array
    env_steps: jax.Array


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


#: The gradient's noise is measured on one of so many episodes ...
_NOISE_SHARE = 32
#: ... and on so many at most.
_NOISE_EPISODES = 64

#: (problem, key, params, opt_state) -> (params, opt_state, metrics); may consume the key. The
#: metrics are ``entropy``, the mean over samples; ``gradient_norm``, the mean over optimizer steps;
#: and what an update adds.
Update = Callable[[Problem, jax.Array, Any, Any], tuple[Any, Any, dict[str, Any]]]
#: (problem, key, params, gradient) -> what the optimizer is given for it; may consume the key.
GradientMap = Callable[[Problem, jax.Array, Any, Any], Any]


def full_batch() -> Update:
    """One optimizer step on the gradient of the whole rollout.

    Of two episodes or more, its metrics have ``gradient_snr``, the signal-to-noise ratio over
    episodes of that gradient, see ``signal_to_noise``. The noise is estimated from one
    episode in 32, at least from one and at most from 64. From few, it is right only on average.

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


def whole_rollout(gradient_map: GradientMap) -> Update:
    """``full_batch``, in which ``gradient_map`` makes another step of the gradient."""

    def update(problem, key, params, opt_state):
        """Returns the parameters and the optimizer's state after one step, and its metrics."""
        mask = problem.samples[-1]
        # Of the sum over all samples; ``descend`` divides it, by N or by the steps.
        _, grads, sums = accumulate_gradient(problem.surrogate, params, problem.samples)
        metrics = {}
        # One episode has no variance to be measured.
        if mask.shape[1] > 1:
            metrics["gradient_snr"] = _signal_to_noise(problem, params, grads)
        metrics["entropy"] = sums["entropy"] / jnp.maximum(jnp.sum(mask), 1)
        turn_gradient = functools.partial(gradient_map, problem, key, params)
        params, opt_state, step_metrics = descend(
            problem, grads, problem.divisor, params, opt_state, turn_gradient
        )
        return params, opt_state, metrics | step_metrics

    return update


def _signal_to_noise(problem: Problem, params: Params, grads: Params) -> jax.Array:
    """Returns the signal-to-noise ratio [] of the gradients summed over all episodes."""
    num_episodes = problem.samples[-1].shape[1]
    num_measured = num_noise_episodes(num_episodes)

    def episode_gradient(episode):
        # As a rollout of one episode: the axis [N] is back, with N = 1.
        samples = jax.tree.map(lambda x: x[:, None], episode)
        return accumulate_gradient(problem.surrogate, params, samples)[1]

    measured_samples = jax.tree.map(lambda x: x[:, :num_measured], problem.samples)
    episode_gradients = jax.vmap(episode_gradient, in_axes=1)(measured_samples)
    mean = jax.tree.map(lambda g: g / num_episodes, grads)
    return signal_to_noise(mean, episode_gradients, num_episodes)


def num_noise_episodes(num_episodes: int) -> int:
    """Returns from how many of these episodes the gradient's noise is estimated."""
    return min(max(1, num_episodes // _NOISE_SHARE), _NOISE_EPISODES)


def descend(
    problem: Problem,
    grads: Params,
    divisor: int | jax.Array,
    params: Params,
    opt_state: optax.OptState,
    gradient_map: Callable[[Any], Any] = lambda gradient: gradient,
) -> tuple[Any, Any, dict[str, jax.Array]]:
    """Makes one optimizer step on summed gradients; also returns the metrics of that step.

    The optimizer is given what ``gradient_map`` makes of the mean gradient.
    """
    grads = jax.tree.map(lambda g: g / divisor, grads)
    # Of the gradient itself, before ``gradient_map`` and the optimizer's clipping.
    norm = optax.tree.norm(grads)
    # Schedules read the clock; other optimizers of optax would not take it.
    optimizer = optax.with_extra_args_support(problem.optimizer)
    change, opt_state = optimizer.update(
        gradient_map(grads), opt_state, params, clock=problem.clock
    )
    metrics = {"gradient_norm": norm}
    return optax.apply_updates(params, change), opt_state, metrics


def make_optimizer(
    name: str = "adam",
    learning_rate: optax.ScalarOrSchedule = 1e-2,
    *,
    max_grad_norm: float | jax.Array | None = 1.0,
    momentum: float | jax.Array = 0.9,
) -> optax.GradientTransformation:
    """Builds an optimizer with the constants that PyTorch and optax share.

    Args:
      name: "adam" or "sgd".
      learning_rate: a number or an optax schedule over optimizer steps.
      max_grad_norm: the gradient is scaled down to at most this Euclidean norm; None leaves it as
        it is.
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
    if not callable(learning_rate):
        check_number("learning_rate", learning_rate)
    check_number("momentum", momentum)
    # Adam's other constants, b2 = 0.999 and eps = 1e-8, are the same in PyTorch.
    optimizers = {"adam": optax.adam(learning_rate, momentum), "sgd": optax.sgd(learning_rate)}
    check_name("optimizer", name, optimizers)
    if max_grad_norm is None:
        return optimizers[name]
    check_number("max_grad_norm", max_grad_norm, positive=True, finite=False)
    # Before the optimizer, as in PyTorch, so that one large gradient does not fill Adam's moments.
    return optax.chain(optax.clip_by_global_norm(max_grad_norm), optimizers[name])


def signal_to_noise(mean: Params, episode_gradients: Params, num_episodes: int) -> jax.Array:
    """Returns an estimate [] of |E g|^2 / tr Cov(g), where g is the mean of N episodes' gradients.

    It is |g|^2 / noise - 1, and the noise is (1 / M) sum_m |g_m - g|^2 / (N - 1): unbiased for
    tr Cov(g), and |g|^2 - noise for |E g|^2, where episodes are independent and alike (McCandlish
    et al. 2018, arXiv:1812.06162, appendix A.1, has the same two). N over the ratio is their simple
    noise scale, in episodes.

    The ratio of two unbiased estimates is not unbiased, and is below 0 where the noise happens to
    exceed |g|^2. To average over updates, average |g|^2 (``gradient_norm`` squared) and the noise,
    which is |g|^2 / (1 + ratio), and then divide. With leave-one-out, episodes share their
    baselines, so that |E g|^2 is estimated 1 + 1 / (N - 1)^2 times as large.

    Args:
      mean: g, a pytree.
      episode_gradients: g_m of M of the N episodes, the same with a leading axis [M].
      num_episodes: N, at least 2.
    """
    deviations = jax.tree.map(lambda g_m, g: g_m - g, episode_gradients, mean)
    squared_norms = jax.vmap(lambda deviation: optax.tree.norm(deviation, squared=True))(deviations)
    # The variance of the mean of N: that of one episode is N / (N - 1) times its mean square
    # deviation from the mean of N, and the mean's is 1 / N of it.
    noise = jnp.mean(squared_norms) / (num_episodes - 1)
    return optax.tree.norm(mean, squared=True) / noise - 1
