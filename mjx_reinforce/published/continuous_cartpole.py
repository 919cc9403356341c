"""A linear policy on a CartPole whose force is a number: by REINFORCE, and by random search.

docs/documents.md, 002, says what is wrong with them. REINFORCE plays 100 episodes, normalizes the
returns within each, and makes 50 steps of Adam, each on 128 steps of the episodes. Random search
plays two episodes in each of 10 directions.
"""

from typing import Any

import mjx_reinforce as mr


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
    optimizer = mr.make_optimizer(
        "adam", config.learning_rate, weight_decay=1e-4, max_grad_norm=None
    )
    return mr.reinforce(
        env,
        estimator=estimator or mr.normalized_returns(config.discount),
        optimizer=optimizer,
        update=mr.minibatches(num_updates=50, batch_size=128),
        num_episodes=config.num_episodes,
        **shared,
    )


def random_search(
    env: mr.Environment, config: Any, update: str = "document", **shared: Any
) -> mr.Learner:
    """Returns the learner of the document's random search; ``update="paper"`` is without mistakes.

    Args:
      env: what it learns on.
      config: the settings; it reads none.
      update: see ``mjx_reinforce.ars``.
      shared: the policy, the horizon and more, as ``mjx_reinforce.ars`` takes them.
    """
    del config
    return mr.ars(env, num_directions=10, step_size=1.0, noise_std=0.1, update=update, **shared)
