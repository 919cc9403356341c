"""Mistakes of document 001's program that no setting of ours has."""

import contextlib
import dataclasses
import functools
from typing import Any
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.stats import norm

from mjx_reinforce.export import policy_files as checkpoint

STALE = "stale first observation"
_CLAMP = 1e-6


def clamped_log_prob(outputs: Any, action: Any, low: Any, high: Any) -> jax.Array:
    """Returns the log-density [...] of truncated Normals as torchrl computes it.

    Its distribution functions are clamped at 1e-6: with the mean far beyond a bound, what is left
    is a Normal's density without its constant, which pushes the mean on where the return is poor.

    Args:
      outputs: [..., 2 A] the means and the logarithms of the standard deviations.
      action: [..., A].
      low: [A] lower bounds.
      high: [A] upper bounds.
    """
    mean, log_std = jnp.split(outputs, 2, axis=-1)

    def probability(x):
        return jnp.clip(norm.cdf((x - mean) * jnp.exp(-log_std)), _CLAMP, 1 - _CLAMP)

    mass = jnp.maximum(probability(high) - probability(low), _CLAMP)
    return jnp.sum(norm.logpdf(action, mean, jnp.exp(log_std)) - jnp.log(mass), axis=-1)


def clamped() -> contextlib.AbstractContextManager[Any]:
    """Returns a context in which truncated Normals are built with ``clamped_log_prob``."""
    return mock.patch.object(checkpoint, "build_policy", _clamped_policy)


def _clamped_policy(settings: dict[str, Any], build_policy: Any = checkpoint.build_policy) -> Any:
    policy = build_policy(settings)
    if settings["policy"] != "truncated-normal":
        return policy
    low, high = np.array(settings["action_low"]), np.array(settings["action_high"])
    log_prob = functools.partial(clamped_log_prob, low=low, high=high)
    return policy._replace(distribution=policy.distribution._replace(log_prob=log_prob))


class _StaleStart:
    """An environment that first shows an observation of something else, unless that is NaN."""

    def __init__(self, env: Any, shown: jax.Array):
        self._env, self._shown = env, shown

    def reset(self, rng: jax.Array) -> Any:
        state = self._env.reset(rng)
        return state.replace(obs=jnp.where(jnp.isnan(self._shown), state.obs, self._shown))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._env, name)


def stale_starts(learner: Any) -> Any:
    """Returns a learner of one episode an update with a mistake of document 001's program.

    Its loop over an episode's steps re-uses the variable that holds the next episode's first
    observation. So the first action of every episode but the first answers, and is trained on,
    the observation before the last action of the episode before. That travels in the state.
    """

    def init(key):
        state = learner.init(key)
        trajectory = jax.eval_shape(lambda: _play(learner, state, None)[1])
        nothing = jnp.full(trajectory.observation.shape[-1], jnp.nan)
        return dataclasses.replace(state, estimator_state=(state.estimator_state, nothing))

    def step(state, active=True):
        inner, shown = state.estimator_state
        played = dataclasses.replace(state, estimator_state=inner)
        (after, metrics), trajectory = _play(learner, played, shown, active)
        last = jnp.maximum(jnp.sum(trajectory.mask[:, 0]) - 1, 0)
        shown = jnp.where(active, trajectory.observation[last, 0], shown)
        return dataclasses.replace(after, estimator_state=(after.estimator_state, shown)), metrics

    return learner._replace(init=init, step=step)


def _play(learner: Any, state: Any, shown: jax.Array | None, active: Any = True) -> Any:
    """Returns what a step of the learner does, and the episodes that it played."""
    episodes = []

    def rollout(env, *args, **kwargs):
        env = env if shown is None else _StaleStart(env, shown)
        episodes.append(learner.engine.rollout(env, *args, **kwargs))
        return episodes[0]

    # The step is a partial of a function whose first argument plays the episodes.
    return learner.step.func(rollout, state, active), episodes[0]
