"""Estimators with a learned baseline: a value network that is fitted to the returns to go.

The network is fitted after its values were used, so that no weight depends on its own episode
through it, and the gradient stays unbiased (Sutton and Barto 2018, section 13.4).
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import linen as nn
from jax import lax

from mjx_reinforce.engine.checks import check_count
from mjx_reinforce.engine.episode import while_any
from mjx_reinforce.learning.estimators import Estimator, explained_variance, reward_to_go
from mjx_reinforce.learning.policy import MLP
from mjx_reinforce.learning.samples import (
    accumulate_gradient,
    chunk_at,
    draw_steps,
    in_chunks,
    in_groups,
    while_needed,
)

#: The share that an update has in the running mean and variance of the returns.
_UPDATE_SHARE = 0.1


def value_network(hidden_sizes: Sequence[int] = (64, 64)) -> nn.Module:
    """Returns a network of tanh units for ``value_baseline``, whose products a GPU may round.

    NVIDIA's GPUs round factors to TF32, of 11 bits, and are about twice as fast. Any function of
    the observation and the time leaves the gradient unbiased, a rounded one, too.
    """
    return MLP(tuple(hidden_sizes), 1, precision=lax.Precision.DEFAULT)


class Critic(NamedTuple):
    """State of ``value_baseline``.

    params, opt_state: of the network
    seed: [] uint32, from which, with the number of updates, the minibatches are drawn
    updates: [] int32, those in which anything was played
    mean, variance: [] running moments of the returns to go; the network's values are in their
      standard deviations from their mean, 0 before the first update
    """

    params: Any
    opt_state: Any
    seed: jax.Array
    updates: jax.Array
    mean: jax.Array
    variance: jax.Array


def value_baseline(
    discount: float | jax.Array = 0.99,
    *,
    horizon: int = 1000,
    network: nn.Module | None = None,
    optimizer: optax.GradientTransformation | None = None,
    num_fits: int = 32,
    batch_size: int = 256,
) -> Estimator:
    """Weights an action by G[t] - V(o[t], t), V learned (Sutton and Barto 2018, section 13.4).

    V reads the time besides the observation, for what is still earned depends on the steps that
    are left (Pardo et al. 2018, arXiv:1712.00378). Each update continues with the network and the
    optimizer's state of the last one. V is fitted to G less its running mean, over its running
    standard deviation, so that a learning rate means the same in every task. (Before the first
    update V is 0.)

    Args:
      discount: in [0, 1].
      horizon: steps after which the time counts as 1.
      network: a flax module from [..., O + 1], the normalized observation and the time, to
        [..., 1]; by default ``value_network()``, an MLP of 64 and 64 tanh units.
      optimizer: what fits it; by default Adam at 3e-3.
      num_fits: gradient steps on the mean squared error, each update.
      batch_size: steps of the episodes, drawn with replacement, for each of them.

    Raises:
      ValueError: ``horizon``, ``num_fits`` or ``batch_size`` is less than one or the discount is
        not in [0, 1].

    Examples:
      >>> import mjx_reinforce as mr
      >>> mr.value_baseline(discount=1.0)
      Estimator(of 1 episodes or more)
    """
    for name, count in (("horizon", horizon), ("num_fits", num_fits), ("batch_size", batch_size)):
        check_count(name, count)
    network = value_network() if network is None else network
    returns_to_go = reward_to_go(discount)
    fitter = optax.adam(3e-3) if optimizer is None else optimizer

    def value(params, inputs):
        return jnp.asarray(network.apply(params, inputs))[..., 0]

    def init(key, observation_size):
        network_key, seed_key = jax.random.split(key)
        # ``update`` gets no key, so what its minibatches are drawn from is in the state.
        seed = jax.random.bits(seed_key, (), jnp.uint32)
        params = _first_params(network, network_key, observation_size + 1)
        zero = jnp.zeros(())
        return Critic(params, fitter.init(params), seed, jnp.zeros((), jnp.int32), zero, zero)

    def update(critic, trajectory):
        """Returns G - V [T, N] with V as it was, the critic fitted to G, and how good V was."""
        mask = trajectory.mask
        num_episodes = mask.shape[1]
        returns = returns_to_go.update((), trajectory)[0]
        # V of every step, before the fit: the weight must not depend on its own episode through V.
        step_index = jnp.broadcast_to(jnp.arange(len(mask))[:, None], mask.shape)
        step_arrays = (trajectory.observation, step_index, mask)
        scaled_values = _map_steps(
            lambda chunk: value(critic.params, _with_time(chunk[0], chunk[1], horizon)),
            step_arrays,
        )
        values = critic.mean + jnp.sqrt(critic.variance) * scaled_values
        weight, metrics = _residual(returns, values, mask)

        # The targets of the fit: G in standard deviations from its mean, this rollout's included.
        # Flat, [T * N, ...]: step t of episode n has the index t * N + n.
        updates, mean, variance = _moments(critic, returns, mask)
        return_unit = jnp.where(variance > 0, jnp.sqrt(variance), 1.0)
        draw_key = jax.random.fold_in(jax.random.key(critic.seed), critic.updates)
        observations = trajectory.observation.reshape(mask.size, -1)
        targets = (returns.reshape(-1) - mean) / return_unit

        def squared_error(params, index):
            inputs = _with_time(observations[index], index // num_episodes, horizon)
            return jnp.mean((in_groups(value)(params, inputs) - targets[index]) ** 2)

        indices = draw_steps(draw_key, mask, (num_fits, batch_size))
        params, opt_state = _fit(
            squared_error, fitter, critic.params, critic.opt_state, minibatches=indices
        )
        return weight, Critic(params, opt_state, critic.seed, updates, mean, variance), metrics

    return Estimator(init, update)


class FullBatchCritic(NamedTuple):
    """State of ``full_batch_value_baseline``: the network's parameters, its optimizer's state."""

    params: Any
    opt_state: Any


def full_batch_value_baseline(
    discount: float | jax.Array = 0.99,
    *,
    network: nn.Module | None = None,
    optimizer: optax.GradientTransformation | None = None,
    num_fits: int = 10,
) -> Estimator:
    """Weights an action by G[t] - V(o[t]), V learned, as published programs fit it.

    V reads the observation alone, is in the unit of the return, and every gradient step takes the
    whole rollout: slow for what it learns.

    Args:
      discount: in [0, 1].
      network: a flax module from [..., O] to [..., 1]; by default an MLP of 64
        and 64 tanh units.
      optimizer: what fits it; by default Adam at 3e-3.
      num_fits: gradient steps on the mean squared error, each update.

    Raises:
      ValueError: ``num_fits`` is less than one or the discount is not in [0, 1].

    Examples:
      >>> import mjx_reinforce as mr
      >>> mr.full_batch_value_baseline(discount=1.0)
      Estimator(of 1 episodes or more)
    """
    check_count("num_fits", num_fits)
    network = MLP((64, 64), 1) if network is None else network
    returns_to_go = reward_to_go(discount)
    fitter = optax.adam(3e-3) if optimizer is None else optimizer

    def value(params, observation):
        return jnp.asarray(network.apply(params, observation))[..., 0]

    def squared_error(params, chunk):
        observation, returns, mask = chunk
        errors = in_groups(value)(params, observation) - returns
        return jnp.sum(jnp.where(mask, errors**2, 0.0)), {}

    def init(key, observation_size):
        params = _first_params(network, key, observation_size)
        return FullBatchCritic(params, fitter.init(params))

    def update(critic, trajectory):
        """Returns G - V [T, N] with V as it was, the critic fitted to G, and how good V was."""
        returns = returns_to_go.update((), trajectory)[0]
        mask = trajectory.mask
        # V before the fit: the weight must not depend on its own episode through V.
        values = value(critic.params, trajectory.observation)
        weight, metrics = _residual(returns, values, mask)
        steps = jnp.maximum(jnp.sum(mask), 1)
        step_arrays = (trajectory.observation, returns, mask)

        def fit(critic, _):
            _, grads, _ = accumulate_gradient(squared_error, critic.params, step_arrays)
            grads = jax.tree.map(lambda g: g / steps, grads)
            change, opt_state = fitter.update(grads, critic.opt_state, critic.params)
            return FullBatchCritic(optax.apply_updates(critic.params, change), opt_state), None

        critic, _ = lax.scan(fit, critic, length=num_fits)
        return weight, critic, metrics

    return Estimator(init, update)


def _with_time(observation: jax.Array, step_index: jax.Array, horizon: int) -> jax.Array:
    """Returns observations [..., O + 1], the share of the time [...] behind their entries."""
    time_share = jnp.asarray(step_index, observation.dtype) / horizon
    return jnp.concatenate([observation, time_share[..., None]], axis=-1)


def _first_params(network: nn.Module, key: jax.Array, inputs: int) -> Any:
    """Returns the network's first parameters; raises ValueError if it returns no values."""
    params = network.init(key, jnp.zeros(inputs))
    shape = jax.eval_shape(network.apply, params, jnp.zeros(inputs)).shape
    if shape != (1,):
        raise ValueError(f"the network must return values [..., 1], got {list(shape)}")
    return params


def _fit(
    loss: Callable[[Any, jax.Array], jax.Array],
    optimizer: optax.GradientTransformation,
    params: Any,
    opt_state: Any,
    minibatches: jax.Array,
) -> tuple[Any, Any]:
    """Returns the parameters and the optimizer's state after a step on each of F minibatches.

    Args:
      loss: (params, indices [B] of steps) -> the mean [] over them.
      optimizer: what makes a step of a gradient.
      params: of the network.
      opt_state: of the optimizer.
      minibatches: [F, B] indices of steps.
    """

    def fit(carry, index):
        params, opt_state = carry
        grads = jax.grad(loss)(params, index)
        params_change, opt_state = optimizer.update(grads, opt_state, params)
        return (optax.apply_updates(params, params_change), opt_state), None

    (params, opt_state), _ = lax.scan(fit, (params, opt_state), minibatches)
    return params, opt_state


def _residual(
    returns: jax.Array, values: jax.Array, mask: jax.Array
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Returns the weights [T, N], and how good the values [T, N] were."""
    weight = jnp.where(mask, returns - values, 0.0)
    mean_squared_error = jnp.sum(weight**2) / jnp.maximum(jnp.sum(mask), 1)
    return weight, {
        "explained_variance": explained_variance(weight, returns, mask),
        "value_loss": mean_squared_error,
    }


def _map_steps(
    chunk_function: Callable[[Any], jax.Array], step_arrays: tuple[Any, ...]
) -> jax.Array:
    """Applies a function of single steps to all of them; returns [T, N], 0 outside the mask.

    Args:
      chunk_function: data [..., *] of any steps -> a number for each, [...].
      step_arrays: as for ``accumulate_gradient``.
    """
    chunks, has_steps = in_chunks(step_arrays)

    def body(carry):
        index, values = carry
        chunk = chunk_at(chunks, index)
        chunk_values = jnp.where(chunk[-1], chunk_function(chunk), 0.0)
        return index + 1, lax.dynamic_update_index_in_dim(values, chunk_values, index, 0)

    # Chunks without a step are not visited; their values stay 0.
    shapes = jax.eval_shape(chunk_function, chunk_at(chunks, jnp.zeros((), jnp.int32)))
    zero_values = jnp.zeros((has_steps.size, *shapes.shape), shapes.dtype)
    values = while_any(while_needed(has_steps), body, (jnp.zeros((), jnp.int32), zero_values))[1]
    return values.reshape(step_arrays[-1].shape)


def _moments(
    critic: Critic, returns: jax.Array, mask: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Returns the updates counted, the mean and the variance, those of this rollout included.

    The first updates count alike, so that no start has to be forgotten.
    """
    steps = jnp.sum(mask)
    updates = critic.updates + (steps > 0)
    divisor = jnp.maximum(updates.astype(jnp.uint32), 1)  # beyond 2^31 an int32 is negative
    # 1/k in update k is the plain mean of k updates; from the tenth on, a running mean.
    update_weight = jnp.where(steps > 0, jnp.maximum(1 / divisor, _UPDATE_SHARE), 0.0)

    def mean(x):
        return jnp.sum(jnp.where(mask, x, 0.0)) / jnp.maximum(steps, 1)

    center = critic.mean + update_weight * (mean(returns) - critic.mean)
    # About the running mean, not this rollout's, from which the values are measured.
    update_variance = mean((returns - center) ** 2)
    return updates, center, critic.variance + update_weight * (update_variance - critic.variance)
