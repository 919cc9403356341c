"""A mistake of document 001's program that no setting of ours has."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from mjx_reinforce.learning.learner import Learner

STALE = "stale first observation"


class _StaleStart:
    """An environment that first shows an observation of something else, unless that is NaN."""

    def __init__(self, env: Any, shown: jax.Array):
        self._env, self._shown = env, shown

    def reset(self, rng: jax.Array) -> Any:
        state = self._env.reset(rng)
        return state.replace(obs=jnp.where(jnp.isnan(self._shown), state.obs, self._shown))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._env, name)


def stale_starts(build: Callable[[Any], Learner], env: Any) -> Learner:
    """Returns a learner of one episode an update with a mistake of document 001's program.

    Its loop over an episode's steps re-uses the variable that holds the next episode's first
    observation. So the first action of every episode but the first answers, and is trained on,
    the observation before the last action of the episode before. That travels in the state.

    Args:
      build: returns the learner of the program without the mistake, for an environment.
      env: what is played.
    """
    learner = build(env)

    def init(key):
        state = learner.init(key)
        trajectory = jax.eval_shape(lambda: learner.play(state, key, True))
        nothing = jnp.full(trajectory.observation.shape[-1], jnp.nan)
        return dataclasses.replace(state, estimator_state=(state.estimator_state, nothing))

    def play(state, key, active):
        inner, shown = state.estimator_state
        stale = build(_StaleStart(env, shown))
        return stale.play(dataclasses.replace(state, estimator_state=inner), key, active)

    def learn(state, trajectory, key):
        inner, _ = state.estimator_state
        known = dataclasses.replace(state, estimator_state=inner)
        state, metrics = learner.learn(known, trajectory, key)
        last = jnp.maximum(jnp.sum(trajectory.mask[:, 0]) - 1, 0)
        shown = trajectory.observation[last, 0]
        return dataclasses.replace(state, estimator_state=(state.estimator_state, shown)), metrics

    return learner._replace(init=init, play=play, learn=learn)
