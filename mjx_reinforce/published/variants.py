"""Estimators, updates and a distribution of published programs, with what they follow instead.

None follows the gradient of ``reinforce``. The estimators compare an episode with itself: the
weight of one that broke is the least of the others'. From its second optimizer step on, an update
follows samples of an older policy. It has no importance weights, as the programs have none.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike

from mjx_reinforce.engine.base import Box, Discrete
from mjx_reinforce.engine.checks import check_count
from mjx_reinforce.engine.episode import while_any
from mjx_reinforce.learning.distributions import Distribution, gaussian_outputs
from mjx_reinforce.learning.estimators import (
    Estimator,
    check_discount,
    discounted_returns,
    replace_broken,
    stateless,
)
from mjx_reinforce.learning.samples import draw_steps, while_needed
from mjx_reinforce.learning.updates import Update, descend


def mean_log_prob(discount: float | jax.Array = 0.99) -> Estimator:
    """Weights every action of an episode of L steps by sum_t G[t] / L.

    That is what the loss ``-sum(mean(log_probs) * returns)`` of Gymnasium's first
    REINFORCE tutorial comes to, though its comment promises the sum of the
    products log pi[t] G[t]: the mean over log-probabilities is taken before the
    product. Its gradient is unbiased, except for E[sum_t G[t] / L], which counts a
    reward the more often the later it comes. It is also noisy, because the weight of an action
    contains the rewards from before that action.

    Examples:
      >>> import mjx_reinforce as mr
      >>> mr.mean_log_prob(discount=1.0)
      Estimator(of 1 episodes or more)
    """
    check_discount(discount)

    def weigh(trajectory):
        returns = discounted_returns(trajectory.reward, discount)
        mean = _episode_mean(returns, trajectory.mask)
        return jnp.broadcast_to(replace_broken(mean, trajectory.nonfinite), returns.shape)

    return stateless(weigh)


def normalized_returns(discount: float | jax.Array = 0.99) -> Estimator:
    """Weights an action by G[t], normalized within its episode.

    The weight is ``(G[t] - mean) / (std + 1.19e-7)``, with the mean and the
    unbiased standard deviation over the steps of the episode, and 0 in an episode
    of one step. It is biased. The mean depends on the action. Every episode is scaled to the same
    spread, so that a long episode counts no more than a short one. Where each step earns the
    same, the weight depends on the remaining time alone: it is positive for early actions and
    negative for late ones.

    Examples:
      >>> import mjx_reinforce as mr
      >>> mr.normalized_returns(discount=1.0)
      Estimator(of 1 episodes or more)
    """
    check_discount(discount)

    def weigh(trajectory):
        """Returns G[t, n] in standard deviations from the mean of its episode, [T, N]."""
        mask = trajectory.mask
        returns = discounted_returns(trajectory.reward, discount)
        centered_returns = jnp.where(mask, returns - _episode_mean(returns, mask), 0.0)
        # Over L - 1, as torch.std divides; an episode of one step is centered to 0 already.
        variance = jnp.sum(centered_returns**2, axis=0) / jnp.maximum(jnp.sum(mask, axis=0) - 1, 1)
        normalized = centered_returns / (jnp.sqrt(variance) + float(jnp.finfo(jnp.float32).eps))
        return replace_broken(normalized, trajectory.nonfinite)

    return stateless(weigh)


def minibatches(num_updates: int, batch_size: int) -> Update:
    """Several optimizer steps, each on steps drawn with replacement from all episodes.

    The loss is the mean over the minibatch, whatever the problem's divisor. From the second step
    on the samples are those of an older policy.

    Args:
      num_updates: optimizer steps a rollout.
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
    for name, whole_number in (("num_updates", num_updates), ("batch_size", batch_size)):
        check_count(name, whole_number)

    def update(problem, key, params, opt_state):
        """Returns the parameters and the optimizer's state after all steps, and mean metrics."""
        mask = problem.samples[-1].reshape(-1)
        # Steps of all episodes in one row, [T * N, ...], of which each minibatch is a part.
        samples = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), problem.samples)
        indices = draw_steps(key, mask, (num_updates, batch_size))

        def optimizer_step(carry, index):
            """One step on the minibatch ``index`` [batch_size]."""
            params, opt_state = carry
            minibatch = jax.tree.map(lambda x: x[index], samples)
            grads, sums = jax.grad(problem.surrogate, has_aux=True)(params, minibatch)
            params, opt_state, metrics = descend(problem, grads, batch_size, params, opt_state)
            return (params, opt_state), metrics | {"entropy": sums["entropy"] / batch_size}

        (params, opt_state), metrics = lax.scan(optimizer_step, (params, opt_state), indices)
        return params, opt_state, {name: jnp.mean(x) for name, x in metrics.items()}

    return update


def each_step() -> Update:
    """One optimizer step for every time step, in order, after all episodes are over.

    Step t follows its own share of the full gradient, the terms of all episodes at t, at the
    parameters that steps 0 to t - 1 have moved (Sutton and Barto 2018, section 13.3, has
    discount^t besides: see ``mjx_reinforce.discount_weights``).

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
        """Returns the parameters and the optimizer's state after all steps, and mean metrics."""
        del key
        mask = problem.samples[-1]
        has_next = while_needed(jnp.any(mask, axis=1))

        def optimizer_step(t, params, opt_state):
            """One step on the terms of all episodes at t: samples [N, ...]."""
            samples = jax.tree.map(
                lambda x: lax.dynamic_index_in_dim(x, t, keepdims=False), problem.samples
            )
            grads, sums = jax.grad(problem.surrogate, has_aux=True)(params, samples)
            params, opt_state, metrics = descend(problem, grads, problem.divisor, params, opt_state)
            return params, opt_state, metrics | sums

        def body(carry):
            t, params, opt_state, sums = carry
            params, opt_state, metrics = optimizer_step(t, params, opt_state)
            step = t + 1, params, opt_state, jax.tree.map(jnp.add, sums, metrics)
            # Vmapped over seeds, the loop goes on until the seed with the longest episode is done.
            return jax.tree.map(lambda new, old: jnp.where(has_next(carry), new, old), step, carry)

        start = jnp.zeros((), jnp.int32)
        shapes = jax.eval_shape(optimizer_step, start, params, opt_state)[2]
        zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
        t, params, opt_state, sums = while_any(has_next, body, (start, params, opt_state, zeros))
        # The entropy is a sum over all steps of all episodes, the other metrics one number a step.
        entropy = sums.pop("entropy") / jnp.maximum(jnp.sum(mask), 1)
        means = {name: x / jnp.maximum(t, 1) for name, x in sums.items()}
        return params, opt_state, means | {"entropy": entropy}

    return update


def per_step(update: Update) -> Update:
    """An update whose sums are divided by the steps played in place of N.

    The gradient then does not grow with the episodes. (A minibatch always is a mean over steps.)
    """

    def mean_update(problem, key, params, opt_state):
        num_steps = jnp.maximum(jnp.sum(problem.samples[-1]), 1)
        return update(problem._replace(divisor=num_steps), key, params, opt_state)

    return mean_update


def deterministic(
    space: Box | Discrete, *, initial_std: ArrayLike | None = None, rescale: bool = True
) -> Distribution:
    """A single point: the action is the network's output, rescaled like the mean of ``normal``.

    It is for methods that need no likelihood, such as ``ars``: ``log_prob`` raises ValueError.

    Examples:
      >>> import jax.numpy as jnp, numpy as np
      >>> import mjx_reinforce as mr
      >>> family = mr.deterministic(mr.Box(-2 * np.ones(1), 2 * np.ones(1)))
      >>> family.mode(jnp.ones(1)).tolist()  # 1 is the end of the range
      [2.0]
    """
    del initial_std
    gaussian = gaussian_outputs("deterministic", space, "parameter", 1.0, rescale)

    # There is no density to speak of: the error comes when a learner that needs one is built.
    def log_prob(outputs, action):
        raise ValueError(
            "a deterministic policy has no log-probability; choose a stochastic one for REINFORCE"
        )

    return Distribution(
        num_outputs=gaussian.size,
        constants=(),
        noise=lambda key, shape: jnp.zeros((*shape, 1)),
        sample=lambda outputs, noise: gaussian.mean(outputs),
        mode=gaussian.mean,
        log_prob=log_prob,
        entropy=lambda outputs: jnp.zeros(outputs.shape[:-1], outputs.dtype),
    )


def _episode_mean(x: jax.Array, mask: jax.Array) -> jax.Array:
    """Returns the mean [N] of ``x`` [T, N] over the steps of every episode."""
    return jnp.sum(jnp.where(mask, x, 0.0), axis=0) / jnp.maximum(jnp.sum(mask, axis=0), 1)
