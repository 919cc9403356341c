"""A linear policy on a CartPole whose force is a number: by REINFORCE, and by random search.

docs/documents.md, 002, says what is wrong with them. REINFORCE plays 100 episodes, normalizes the
returns within each, and makes 50 steps of Adam, each on 128 steps of the episodes. Random search
plays two episodes in each of 10 directions.
"""

from typing import Any

import jax
import jax.numpy as jnp
import optax

import mjx_reinforce as mr
from mjx_reinforce.published.ars import over_std


def reinforce(
    env: mr.Environment, config: Any, estimator: mr.Estimator | None = None, **shared: Any
) -> mr.Learner:
    """Returns the learner of the document's REINFORCE.

    Args:
      env: what it learns on.
      config: the settings; it reads discount, learning_rate and num_episodes.
      estimator: in place of the document's.
      shared: the policy, the horizon and more, as ``mjx_reinforce.reinforce`` takes them.
    """
    adam = optax.adam(config.learning_rate)
    return mr.reinforce(
        env,
        estimator=estimator or mr.normalized_returns(config.discount),
        optimizer=optax.chain(optax.add_decayed_weights(1e-4), adam),  # an L2 penalty
        update=mr.minibatches(num_updates=50, batch_size=128),
        num_episodes=config.num_episodes,
        **shared,
    )


def random_search(env: mr.Environment, config: Any, **shared: Any) -> mr.Learner:
    """Returns the learner of the document's random search, mistakes included.

    Args:
      env: what it learns on.
      config: the settings; it reads none.
      shared: the policy, the horizon and more, as ``mjx_reinforce.ars`` takes them.

    Raises:
      ValueError: the policy is not linear.
    """
    if config.hidden_sizes:
        raise ValueError(
            f"the document's policy is linear, got --hidden-sizes {config.hidden_sizes}"
        )
    policy = shared.pop("policy")

    def apply(params: Any, observation: jax.Array) -> jax.Array:
        return policy.apply(_overwrite_bias(params), observation)

    tied_policy = policy._replace(apply=apply)
    search = corrected_search(env, config, policy=tied_policy, increment=increment, **shared)

    def learn(state: mr.TrainState, trial: Any, key: jax.Array) -> Any:
        # The bias that played is written into the params, so that ``policy``, which has its bias
        # for itself, plays as the search did.
        state, metrics = search.learn(state, trial, key)
        params = _overwrite_bias(state.actor.params)
        return state.replace(actor=state.actor.replace(params=params)), metrics

    return search._replace(learn=learn, policy=policy)


def corrected_search(env: mr.Environment, config: Any, **shared: Any) -> mr.Learner:
    """Returns the same without the mistakes: the paper's."""
    del config
    return mr.ars(env, num_directions=10, step_size=1.0, noise_std=0.1, **shared)


def increment(directions: Any, returns: jax.Array, noise_std: Any) -> Any:
    """Returns what all parameters move by: one number.

    ``np.sum`` without an axis adds up the entries of the direction too. The notebook does not
    divide by how many directions there are, and multiplies by ``noise_std``. Not reproduced: where
    all returns are equal it divides 0 by 0, and its parameters are NaN for good.
    """
    # [D]: what each direction adds up to over all entries of all parameters.
    sums = sum(jnp.sum(d.reshape(len(d), -1), axis=1) for d in jax.tree.leaves(directions))
    step = noise_std * jnp.sum(over_std(returns[0] - returns[1], returns) * sums)
    return jax.tree.map(lambda d: jnp.full(d.shape[1:], step, d.dtype), directions)


def _overwrite_bias(params: Any) -> Any:
    """Returns a linear policy's params with the first A weights in place of the bias [A].

    The notebook writes the same first entries of its flat vector into every parameter.
    """
    layer = params["network"]["params"]["Dense_0"]
    # PyTorch stores weights as [A, O], flax as [O, A].
    bias = layer["kernel"].T.reshape(-1)[: layer["bias"].size]
    return params | {"network": {"params": {"Dense_0": layer | {"bias": bias}}}}
