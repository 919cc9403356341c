"""Gymnasium's tutorial: REINFORCE from scratch on InvertedPendulum-v4, and its first version.

https://gymnasium.farama.org/tutorials/training_agents/reinforce_invpend_gym_v26; docs/documents.md
says what is wrong with them. A network's first output is the mean of a Normal distribution, the
softplus of its second the std; every episode makes one step of AdamW. Every episode of a seed is
reset with the same seed.
"""

from typing import Any

import jax
import optax

import mjx_reinforce as mr
from mjx_reinforce.learning.learner import RolloutPlay


def reward_to_go(env: mr.Environment, config: Any, **shared: Any) -> mr.Learner:
    """Returns the learner of version 1.2, whose loss is the sum of -log pi times G.

    Args:
      env: what it learns on.
      config: the settings; it reads discount, learning_rate and num_episodes.
      shared: the policy, the horizon and more, as ``mjx_reinforce.reinforce`` takes them.
    """
    return with_one_start(learner(env, config, mr.reward_to_go(config.discount), **shared))


def mean_log_prob(env: mr.Environment, config: Any, **shared: Any) -> mr.Learner:
    """Returns the learner of version 0.26: the mean log-probability times the sum of all G.

    Args: as for ``reward_to_go``.
    """
    return with_one_start(learner(env, config, mr.mean_log_prob(config.discount), **shared))


def learner(env: mr.Environment, config: Any, estimator: mr.Estimator, **shared: Any) -> mr.Learner:
    """Returns the learner of an estimator, with a fresh start for every episode."""
    return mr.reinforce(
        env,
        estimator=estimator,
        optimizer=optax.adamw(config.learning_rate, weight_decay=0.01),
        num_episodes=config.num_episodes,
        **shared,
    )


def with_one_start(learner: mr.Learner) -> mr.Learner:
    """Returns a learner that resets all episodes of a seed with one key, drawn at ``init``."""

    def init(key: jax.Array) -> mr.TrainState:
        state = learner.init(key)
        # Split from the seed's own key, so that seeds start apart.
        key, start_key = jax.random.split(state.key)
        return state.replace(key=key, start_key=start_key)

    def play(state: mr.TrainState, key: jax.Array, active: Any = True, rollout: Any = None) -> Any:
        def from_one_start(env: Any, *policy: Any, **options: Any) -> mr.Trajectory:
            # The start key is in the state, not in ``env``: each seed of a vmap has its own.
            free_rollout = learner.engine.rollout if rollout is None else rollout
            return free_rollout(_OneStart(env, state.start_key), *policy, **options)

        return learner.play(state, key, active, from_one_start)

    return learner._replace(init=init, play=RolloutPlay(play))


class _OneStart:
    """An environment whose every episode starts with the same key."""

    def __init__(self, env: Any, key: Any):
        self._env = env
        self._key = key

    def reset(self, rng: jax.Array) -> Any:
        del rng
        return self._env.reset(self._key)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._env, name)
