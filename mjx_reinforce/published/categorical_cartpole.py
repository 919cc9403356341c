"""The policy gradient theorem, and a linear softmax policy on CartPole-v0.

docs/documents.md, 004, says what is wrong with it. After an episode Adam makes a step for every
time step, in order, on -log pi times the reward to go, each with the weights that the one before it
has moved.
"""

from typing import Any

import optax

import mjx_reinforce as mr
from mjx_reinforce.learning.updates import Update


def make(
    env: mr.Environment, config: Any, update: Update | None = None, **shared: Any
) -> mr.Learner:
    """Returns the program's learner.

    Args:
      env: what it learns on.
      config: the settings; it reads discount, learning_rate and num_episodes.
      update: in place of the program's.
      shared: the policy, the horizon and more, as ``mjx_reinforce.reinforce`` takes them.
    """
    return mr.reinforce(
        env,
        estimator=mr.reward_to_go(config.discount),
        optimizer=optax.adam(config.learning_rate),
        update=update or mr.each_step(),
        num_episodes=config.num_episodes,
        **shared,
    )
