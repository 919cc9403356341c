"""Updates: how the weights of one rollout become changes of the parameters.

``full_batch`` makes one optimizer step on the gradient that ``reinforce`` states. The step of the
natural gradient is in ``natural_gradient``; ``published.variants`` has updates of several steps.
"""

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import lax
from optax import Params

from mjx_reinforce.engine.checks import check_name, check_number
from mjx_reinforce.engine.episode import largest_divisor, while_any

#: Samples whose activations are held at once; 2**18 of them take 64 MB a 64-unit layer.
MAX_SAMPLES = 2**18
#: A GPU holds so many times as many: it made an H200's gradients 1.2 times as fast.
GPU_FACTOR = 4
#: Steps a chunk covers at most, so that short episodes cost little.
MAX_STEPS = 128
#: On a GPU, a network's gradient is summed over so many groups of samples at most ...
_MAX_GROUPS = 32
#: ... with so many samples each, or more.
_MIN_GROUP = 256


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


def accumulate_gradient(
    loss: Callable[[Any, Any], tuple[jax.Array, Any]],
    params: Params,
    sample_arrays: tuple[Any, ...],
) -> tuple[jax.Array, Any, Any]:
    """Sums a loss, its gradient and its metrics over chunks of time.

    Args:
      loss: (params, chunk of data) -> (sum over the chunk, sums of metrics).
      params: what is differentiated.
      sample_arrays: arrays [T, N, ...]; the last is the mask [T, N], and time steps after
        the last one with any True are not visited.

    Returns:
      The loss [] (without it XLA rounds the rest otherwise), its gradient, the metrics: all summed.
    """
    # Chunk by chunk, as the activations of all T * N samples need not fit into memory at once.
    differentiate = jax.value_and_grad(loss, has_aux=True)

    def visit(chunk):
        (chunk_loss, metrics), grads = differentiate(params, chunk)
        return chunk_loss, grads, metrics

    return accumulate(visit, sample_arrays)


def accumulate(chunk_function: Callable[[Any], Any], sample_arrays: tuple[Any, ...]) -> Any:
    """Sums a function over chunks of time.

    Args:
      chunk_function: chunk of data -> a pytree of sums over the chunk, of zeros where its mask
        is empty.
      sample_arrays: as for ``accumulate_gradient``.
    """
    chunks, has_steps = in_chunks(sample_arrays)
    shapes = jax.eval_shape(chunk_function, chunk_at(chunks, jnp.zeros((), jnp.int32)))

    def body(carry):
        # A seed that is done adds zeros: its mask is empty in the chunks that others still visit.
        index, sums = carry
        return index + 1, jax.tree.map(jnp.add, sums, chunk_function(chunk_at(chunks, index)))

    zero_sums = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    return while_any(while_needed(has_steps), body, (jnp.zeros((), jnp.int32), zero_sums))[1]


def in_groups(apply: Callable[[Any, jax.Array], jax.Array]) -> Callable[..., jax.Array]:
    """Returns ``apply`` with a gradient that a GPU sums in groups of samples, and then over them.

    The gradient of a layer's weights is a product of matrices with few entries, each of them a sum
    over all samples. cuBLAS gives an entry's sum to one multiprocessor, so that most of them wait.

    Args:
      apply: (params, inputs [B, ..., O]) -> outputs [B, ..., K] or [B, ...], of each sample by
        itself.
    """

    def apply_in_groups(params: Any, inputs: jax.Array) -> jax.Array:
        """Returns the outputs of copies of the parameters, one for each group."""
        num_groups = _num_groups(inputs.shape)
        if num_groups == 1:
            return apply(params, inputs)
        # The gradient in a copy is the group's sum. Behind the barrier, XLA does not know that they
        # are copies, and joins no sums.
        copies = jax.tree.map(lambda x: jnp.broadcast_to(x, (num_groups, *x.shape)), params)
        # Along the first axis alone: the second may be divided among devices.
        groups = inputs.reshape(num_groups, -1, *inputs.shape[1:])
        outputs = jax.vmap(apply)(lax.optimization_barrier(copies), groups)
        return outputs.reshape(-1, *outputs.shape[2:])

    return apply_in_groups


def _num_groups(shape: tuple[int, ...]) -> int:
    """Returns in how many groups of B the gradient of samples [B, ..., O] is summed."""
    if jax.default_backend() == "cpu":
        return 1
    num_samples = math.prod(shape[:-1])
    return largest_divisor(shape[0], max(1, min(_MAX_GROUPS, num_samples // _MIN_GROUP)))


def draw_steps(key: jax.Array, mask: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """Draws steps with replacement, every one inside the mask alike.

    Args:
      key: consumed.
      mask: [T, N] or [T * N] True where there is a step.
      shape: of what is returned.

    Returns:
      Indices int32 [*shape] into arrays [T * N, ...]; where there is no step, that of any.
    """
    ranks = jnp.cumsum(mask.reshape(-1))
    sampled_ranks = jax.random.randint(key, shape, 1, 1 + jnp.maximum(ranks[-1], 1))
    # Where the first, second, ... step inside the mask is; ``sampled_ranks`` count from 1.
    return jnp.searchsorted(ranks, sampled_ranks)


def in_chunks(sample_arrays: tuple[Any, ...]) -> tuple[tuple[Any, ...], jax.Array]:
    """Returns the data [C, length, N, ...], and which of the C chunks have a step to visit."""
    horizon, num_episodes = sample_arrays[-1].shape
    # It divides T, so that all chunks have one shape, as a loop needs it.
    length = chunk_length(horizon, num_episodes)
    chunks = jax.tree.map(
        lambda x: x.reshape(horizon // length, length, *x.shape[1:]), sample_arrays
    )
    return chunks, jnp.any(chunks[-1], axis=(1, 2))


def chunk_length(horizon: int, num_episodes: int) -> int:
    """Returns how many steps of all episodes are visited at once."""
    samples = MAX_SAMPLES * (1 if jax.default_backend() == "cpu" else GPU_FACTOR)
    return largest_divisor(horizon, min(MAX_STEPS, max(1, samples // num_episodes)))


def chunk_at(chunks: tuple[Any, ...], index: jax.Array) -> tuple[Any, ...]:
    """Returns one of these chunks [length, N, ...]."""
    return jax.tree.map(lambda x: lax.dynamic_index_in_dim(x, index, keepdims=False), chunks)


def while_needed(has_steps: jax.Array) -> Callable[[Any], jax.Array]:
    """Returns the condition of a loop over chunks [C]; its carry begins with an index.

    Args:
      has_steps: [C] whether any step of a chunk was played.
    """

    def has_next(carry):
        # Where one chunk is empty, so are all after it: no step follows an episode's end.
        index = carry[0]
        return (index < has_steps.size) & has_steps[jnp.minimum(index, has_steps.size - 1)]

    return has_next
