"""Estimators of the policy gradient: the weight of every log-probability.

REINFORCE ascends ``(1/N) sum_n sum_t weight[t, n] * grad log pi(a[t, n] | o[t, n])``
(Williams 1992, equation 8). An estimator turns a trajectory into that weight
and never sees the policy. With the discounted return to go written

    G[t] = r[t] + discount * G[t + 1],

most estimators here are unbiased for the same gradient, that of a step's own action on what it is
worth from there, and differ in variance. ``total_return`` is for the gradient of the discounted
return from the start, in which step t counts discount^t: the same only without a discount.
``standardize`` divides the weights of an update by a number that it computes from them, so that
its gradient has another length, and is no longer exactly unbiased. ``published.variants`` has two
of published programs, which follow something else.

An episode in which the simulation left the finite numbers counts as the worst of the others: at
each step its G[t] is the least of theirs (``replace_broken``).
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mjx_reinforce.engine.base import Trajectory
from mjx_reinforce.engine.checks import check_kind, check_number, known_number


class Estimator(NamedTuple):
    """A pair of pure functions, as in optax, and what they require.

    Attributes:
      init: (key, observation_size) -> state; consumes the key
      update: (state, trajectory) -> (weight [T, N], next state, metrics); the weight
        is zero outside the mask, and the trajectory's observations are normalized; what an episode
        earned that broke (``trajectory.nonfinite``) is no return, see ``replace_broken``
      min_episodes: the least N that ``update`` accepts

    Examples:
      >>> import jax, jax.numpy as jnp
      >>> import mjx_reinforce as mr
      >>> ones = jnp.ones((3, 2))  # two episodes of three steps
      >>> played = mr.Trajectory(
      ...     observation=ones[..., None], action=ones[..., None], reward=ones, mask=ones > 0,
      ...     nonfinite=jnp.zeros(2, bool), simulated=jnp.asarray(6),
      ... )
      >>> estimator = mr.reward_to_go(discount=1.0)
      >>> weight, state, metrics = estimator.update(estimator.init(jax.random.key(0), 1), played)
      >>> weight[:, 0].tolist()
      [3.0, 2.0, 1.0]
    """

    init: Callable[[jax.Array, int], Any]
    update: Callable[[Any, Trajectory], tuple[jax.Array, Any, dict[str, jax.Array]]]
    min_episodes: int = 1

    def __repr__(self) -> str:
        return f"Estimator(of {self.min_episodes} episodes or more)"


def total_return(discount: float | jax.Array = 0.99) -> Estimator:
    """Weights every action of an episode by the return of the whole, G[0] (Williams 1992).

    Rewards from before an action add noise alone. Those after it are discounted from the start.

    Examples:
      >>> import mjx_reinforce as mr
      >>> mr.total_return(discount=1.0)
      Estimator(of 1 episodes or more)
    """
    check_discount(discount)

    def weigh(trajectory):
        returns = _returns(trajectory, discount)
        return jnp.broadcast_to(returns[0], returns.shape)

    return stateless(weigh)


def reward_to_go(discount: float | jax.Array = 0.99) -> Estimator:
    """Weights an action by what came after it, G[t] (Sutton et al. 1999, theorem 1).

    Examples:
      >>> import mjx_reinforce as mr
      >>> mr.reward_to_go(discount=1.0)
      Estimator(of 1 episodes or more)
    """
    check_discount(discount)
    return stateless(lambda trajectory: _returns(trajectory, discount))


def leave_one_out(discount: float | jax.Array = 0.99) -> Estimator:
    """Weights an action by G[t] less the mean G[t] of the other episodes.

    The others are independent of the action, so the baseline adds no bias
    (Kool et al. 2019, "Buy 4 REINFORCE samples"; the mean over all N episodes
    would shrink the gradient by (N - 1) / N). One that is over counts as the 0 it will still earn.

    Examples:
      >>> import mjx_reinforce as mr
      >>> mr.leave_one_out(discount=1.0)
      Estimator(of 2 episodes or more)
    """
    return _less_others(discount, step_filter=jnp.ones_like)


def leave_one_out_alive(discount: float | jax.Array = 0.99) -> Estimator:
    """``leave_one_out`` with the mean of those that still run at t alone, 0 where none does."""
    return _less_others(discount, step_filter=lambda mask: mask)


def _less_others(
    discount: float | jax.Array, step_filter: Callable[[jax.Array], jax.Array]
) -> Estimator:
    """An estimator of G[t] less the mean of the other episodes that count, from the mask."""
    check_discount(discount)

    def update(state, trajectory):
        """Returns G[t, n] - b[t, n] with the baseline b, the mean G[t] of the other episodes."""
        returns = _returns(trajectory, discount)
        # Sums over all episodes [T, 1] less the own term: N means in one pass, not N times N - 1.
        baseline_mask = step_filter(trajectory.mask)
        num_others = jnp.sum(baseline_mask, axis=1, keepdims=True) - baseline_mask
        sums = jnp.sum(jnp.where(baseline_mask, returns, 0.0), axis=1, keepdims=True)
        baseline = (sums - jnp.where(baseline_mask, returns, 0.0)) / jnp.maximum(num_others, 1)
        weight = returns - jnp.where(num_others > 0, baseline, 0.0)
        weight = jnp.where(trajectory.mask, weight, 0.0)
        explained_share = explained_variance(weight, returns, trajectory.mask)
        return weight, state, {"explained_variance": explained_share}

    return Estimator(lambda key, observation_size: (), update, min_episodes=2)


def standardize(
    estimator: Estimator, *, floor: float | jax.Array = 1e-8, center: bool = False
) -> Estimator:
    """Divides an estimator's weights by their standard deviation plus ``floor``.

    The weights of a solved policy are noise. A floor as large as the noise of the return keeps
    them small; without it they would be scaled up and would spoil the policy. Weights whose
    standard deviation, floor included, is below the rounding of the returns are that rounding
    alone, and become 0.

    Args:
      estimator: whose weights are divided.
      floor: added to the standard deviation, in the unit of the return.
      center: also subtract the mean over all steps; the root mean square is
        taken about zero otherwise.

    Raises:
      ValueError: what is given is no estimator, or the floor is negative.

    Examples:
      >>> import mjx_reinforce as mr
      >>> mr.standardize(mr.reward_to_go(1.0))
      Estimator(of 1 episodes or more)
    """
    check_kind("estimator", estimator, Estimator, "mjx_reinforce.reward_to_go(0.99)")
    check_number("floor", floor, finite=False)

    def update(state, trajectory):
        """Returns the weights [T, N] over their deviation, and the deviation among the metrics."""
        weight, state, metrics = estimator.update(state, trajectory)
        mask = trajectory.mask
        steps = jnp.maximum(jnp.sum(mask), 1)
        mean = 0.0
        if center:
            mean = jnp.sum(jnp.where(mask, weight, 0.0)) / steps
        # In a unit in which the squares do not overflow.
        weight_unit = _unit(jnp.where(mask, weight - mean, 0.0))
        variance = jnp.sum(jnp.where(mask, ((weight - mean) / weight_unit) ** 2, 0.0)) / steps
        std = weight_unit * jnp.sqrt(variance)
        # What summing the rewards of an episode may round, [N]; an episode that broke has no
        # rewards to speak of.
        rounding = jnp.sum(jnp.finfo(weight.dtype).eps * jnp.abs(trajectory.reward), axis=0)
        has_spread = std + floor > jnp.max(jnp.where(trajectory.nonfinite, 0.0, rounding))
        scaled_weight = jnp.where(mask & has_spread, (weight - mean) / (std + floor), 0.0)
        return scaled_weight, state, metrics | {"weight_std": std}

    return estimator._replace(update=update)


def discount_weights(estimator: Estimator, discount: float | jax.Array = 0.99) -> Estimator:
    """Multiplies the weight at step t by discount^t.

    Without that factor the gradient is not that of the discounted return from
    the start, nor of any other objective (Nota and Thomas 2020,
    arXiv:1906.07073); with it, late steps hardly count. Most programs leave it
    out, and so does everything here unless wrapped in this, but for ``total_return``, which
    has it already and would discount twice.

    Examples:
      >>> import mjx_reinforce as mr
      >>> mr.discount_weights(mr.total_return(1.0), 0.5)
      Estimator(of 1 episodes or more)
    """
    check_kind("estimator", estimator, Estimator, "mjx_reinforce.reward_to_go(0.99)")
    check_discount(discount)

    def update(state, trajectory):
        weight, state, metrics = estimator.update(state, trajectory)
        # [T]; with a discount of 0 the first step alone counts, since 0^0 is 1.
        powers = discount ** jnp.arange(weight.shape[0], dtype=weight.dtype)
        return weight * powers[:, None], state, metrics

    return estimator._replace(update=update)


def _returns(trajectory: Trajectory, discount: float | jax.Array) -> jax.Array:
    """Returns G [T, N]; of an episode that broke, the least of the others."""
    returns = discounted_returns(trajectory.reward, discount)
    return replace_broken(returns, trajectory.nonfinite)


def stateless(weigh: Callable[[Trajectory], jax.Array]) -> Estimator:
    """An estimator that learns nothing, from its weights [T, N]."""

    def update(state, trajectory):
        return jnp.where(trajectory.mask, weigh(trajectory), 0.0), state, {}

    return Estimator(lambda key, observation_size: (), update)


def explained_variance(residual: jax.Array, returns: jax.Array, mask: jax.Array) -> jax.Array:
    """Returns how much of the returns a baseline explains, 1 - Var(residual) / Var(returns), [].

    1 is a perfect baseline, 0 as good as a constant, and less is worse than none. It is NaN where
    the returns vary by rounding only: there is nothing to explain.

    Args:
      residual: [T, N] what the baseline leaves of the returns.
      returns: [T, N] G.
      mask: [T, N] which steps count.
    """
    steps = jnp.maximum(jnp.sum(mask), 1)

    # The ratio does not depend on the unit, but squares of large returns would overflow.
    return_unit = _unit(jnp.where(mask, returns, 0.0))
    residual = residual / return_unit
    returns = returns / return_unit

    def mean(x):
        return jnp.sum(jnp.where(mask, x, 0.0)) / steps

    def variance(x):
        return mean((x - mean(x)) ** 2)

    total_variance = variance(returns)
    # A deviation of 1e-6 of the mean is some ten roundings of float32.
    has_spread = total_variance > 1e-12 * mean(returns) ** 2
    return jnp.where(
        has_spread, 1.0 - variance(residual) / jnp.where(has_spread, total_variance, 1.0), jnp.nan
    )


def _unit(x: jax.Array) -> jax.Array:
    """Returns what numbers are divided by before they are squared: 1 if no square overflows."""
    largest = jnp.max(jnp.abs(x))
    return jnp.where(largest > 1e15, largest, 1.0)


def check_discount(discount: float | jax.Array) -> None:
    """Raises ValueError for a discount outside [0, 1]; a traced one is taken on trust."""
    known_discount = known_number(discount)
    if not (known_discount is None or 0.0 <= known_discount <= 1.0):
        raise ValueError(f"the discount must lie in [0, 1], got {discount!r}")


def discounted_returns(reward: jax.Array, discount: float | jax.Array) -> jax.Array:
    """Returns G [T, N] with ``G[t] = reward[t] + discount * G[t + 1]`` and ``G[T] = 0``.

    Args:
      reward: [T, N], zero where the episode is over.
      discount: in [0, 1].
    """
    # Products of matrices, in blocks of about sqrt(T) steps: within each block, then over the
    # blocks. A scan takes T steps one after the other, and an associative scan compiles for long.
    discount = jnp.asarray(discount, reward.dtype)
    horizon, num_episodes = reward.shape
    length = math.isqrt(horizon - 1) + 1
    num_blocks = -(-horizon // length)
    # Zeros after the end change no return before it: [B, L, N] with B L >= T.
    blocks = jnp.pad(reward, ((0, num_blocks * length - horizon), (0, 0)))
    blocks = blocks.reshape(num_blocks, length, num_episodes)
    # G within each block, as if nothing came after it.
    block_returns = _discounted_sums(blocks, discount)
    # G at the first step of each block [B, N], where a step from block to block is L steps.
    block_start_returns = _discounted_sums(block_returns[:, 0], jnp.power(discount, length))
    # What the next block adds, from L, L - 1, ..., 1 steps away.
    next_block_returns = jnp.pad(block_start_returns[1:], ((0, 1), (0, 0)))
    steps_left = jnp.arange(length, 0, -1, dtype=reward.dtype)
    returns = block_returns + jnp.power(discount, steps_left)[:, None] * next_block_returns[:, None]
    return returns.reshape(-1, num_episodes)[:horizon]


def replace_broken(returns: jax.Array, is_nonfinite: jax.Array) -> jax.Array:
    """Returns the returns, of an episode that broke the least of the others'.

    What it earned until the simulation left the finite numbers is no return: where rewards are
    negative, it would speak for breaking early. So would leaving it out: the gradient of what
    remains is that of an episode which earned 0.

    Args:
      returns: [..., N] such as G [T, N]; the others are those of the same step.
      is_nonfinite: [N] ``Trajectory.nonfinite``; where all are, all returns are infinite.
    """
    least_return = jnp.min(jnp.where(is_nonfinite, jnp.inf, returns), axis=-1, keepdims=True)
    return jnp.where(is_nonfinite, least_return, returns)


def _discounted_sums(x: jax.Array, discount: jax.Array) -> jax.Array:
    """Returns y [..., T, N] with ``y[t] = x[t] + discount * y[t + 1]`` and ``y[T] = 0``."""
    step_index = jnp.arange(x.shape[-2], dtype=x.dtype)
    # A matrix [T, T] of discount^(s - t) where s >= t, else 0. The exponent is clipped besides:
    # a negative power of 0 is infinite.
    steps_ahead = step_index - step_index[:, None]
    powers = jnp.where(steps_ahead < 0, 0, jnp.power(discount, jnp.maximum(steps_ahead, 0)))
    return jnp.matmul(powers, x, precision="highest")
