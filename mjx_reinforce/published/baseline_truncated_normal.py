"""REINFORCE with a baseline on MuJoCo's tasks, actions within their bounds.

docs/documents.md, 001, says what is wrong with it. A network's output is the mean of a truncated
Normal distribution, whose std is a parameter; another network is the baseline, and is fitted to the
whole episode once. The gradient is a mean over the steps of the episode, of gamma^t (G - v).
"""

from typing import Any

import optax

import mjx_reinforce as mr
from mjx_reinforce.learning.policy import MLP
from mjx_reinforce.published.variants import per_step


def make(env: mr.Environment, config: Any, **shared: Any) -> mr.Learner:
    """Returns the program's learner.

    Args:
      env: what it learns on.
      config: the settings; it reads discount, learning_rate, num_episodes, value_learning_rate and
        value_hidden_sizes.
      shared: the policy, the horizon and more, as ``mjx_reinforce.reinforce`` takes them.
    """
    baseline = mr.full_batch_value_baseline(
        config.discount,
        network=MLP(config.value_hidden_sizes, 1, initializer="torch"),
        optimizer=optax.adam(config.value_learning_rate),
        num_fits=1,
    )
    return mr.reinforce(
        env,
        estimator=mr.discount_weights(baseline, config.discount),
        optimizer=optax.adam(config.learning_rate),
        update=per_step(mr.full_batch()),
        num_episodes=config.num_episodes,
        **shared,
    )
