"""How the episodes of one environment follow each other, as Gymnasium 1.x defines it.

All here is for one environment of N, and is mapped over them. The reset of an episode draws from
the environment's own key alone, so what one plays does not depend on N.
"""

import functools
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from mjx_reinforce.engine.base import Arrays, Environment, PyTree
from mjx_reinforce.engine.play.counter import key_of

#: When an environment whose episode has ended begins the next (Gymnasium's ``AutoresetMode``).
AUTORESETS = ("next_step", "same_step", "disabled")


class VectorState(Arrays):
    """N environments.

    Attributes:
      simulation: the environments' own states, N first
      reward: [N] what the last action earned; 0 where it broke, and after a reset
      terminated: [N] bool, whether the task ended the episode by it
      truncated: [N] bool, whether the time limit did
      nonfinite: [N] bool, whether it left the finite numbers, which terminates the episode
      final_obs: [N, O] what it led to, before any reset
      metrics: [N] each, the terms of its reward and what else the task tells, by name
      episode_return: [N] the rewards of the episode so far; all of them where it has just ended
      episode_length: [N] int32, its steps so far; all of them where it has just ended
      keys: [N, 2] uint32, what the next resets draw from

    Examples:
      >>> import jax
      >>> import mjx_reinforce as mr
      >>> vec = mr.make_vec("CartPole-v1", num_envs=8)
      >>> state = vec.reset(jax.random.key(0))
      >>> state = vec.step(state, vec.sample_actions(jax.random.key(1)))
      >>> state.obs.shape, state.reward.tolist()[:2]
      ((8, 4), [1.0, 1.0])
    """

    simulation: Any
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    nonfinite: jax.Array
    final_obs: jax.Array
    metrics: dict[str, jax.Array]
    episode_return: jax.Array
    episode_length: jax.Array
    keys: jax.Array

    @property
    def obs(self) -> jax.Array:
        """What the next action is chosen by [N, O]; where ``same_step`` has reset, a new start."""
        return self.simulation.obs

    @property
    def done(self) -> jax.Array:
        """Whether the episode has ended [N], for one reason or the other."""
        return self.terminated | self.truncated


def blank(env: Environment) -> VectorState:
    """Returns the shapes of one environment's entry of a ``VectorState``."""
    return jax.eval_shape(functools.partial(_begin, env), jax.ShapeDtypeStruct((2,), jnp.uint32))


def advance_function(env: Environment, limit: int | None, autoreset: str) -> Callable[..., Any]:
    """Returns (state, action, begins []) -> state of one environment.

    Where ``begins`` is true it only resets.

    Args:
      env: what is played.
      limit: the steps after which an episode is truncated; None never does.
      autoreset: one of ``AUTORESETS``.
    """

    def advance(state: VectorState, action: PyTree, begins: jax.Array) -> VectorState:
        if autoreset == "same_step":
            after = _play(env, limit, state, action)
            start = lax.cond(begins | after.done, lambda: _begin(env, state.keys), lambda: after)
            kept = after.replace(simulation=start.simulation, keys=start.keys)
            return jax.tree.map(lambda x, y: jnp.where(begins, x, y), start, kept)
        over = begins | (state.done if autoreset == "next_step" else False)
        begin, play = (lambda: _begin(env, state.keys)), (lambda: _play(env, limit, state, action))
        return lax.cond(over, begin, play)

    return advance


def _begin(env: Environment, keys: jax.Array) -> VectorState:
    """Returns an environment at the start of its next episode, of keys as of ``VectorState``."""
    key, reset_key = jax.random.split(key_of(keys))
    start = env.reset(reset_key)
    none, zero = jnp.zeros((), bool), jnp.zeros_like(start.reward)
    return VectorState(
        simulation=start,
        reward=zero,
        terminated=none,
        truncated=none,
        nonfinite=none,
        final_obs=start.obs,
        metrics=dict(getattr(start, "metrics", {})),
        episode_return=zero,
        episode_length=jnp.zeros((), jnp.int32),
        keys=jax.random.key_data(key),
    )


def _play(env: Environment, limit: int | None, state: VectorState, action: PyTree) -> VectorState:
    """Returns an environment one step later; an episode that is over begins to count again."""
    over = state.done
    after = env.step(state.simulation, action)
    finite = jnp.all(jnp.isfinite(after.obs)) & jnp.isfinite(after.reward)
    finite &= jnp.isfinite(after.done)
    reward = jnp.where(finite, after.reward, 0)
    length = jnp.where(over, 0, state.episode_length) + 1
    truncated = cut = _time_is_up(after)
    if limit is not None:
        truncated |= length >= limit
    return VectorState(
        simulation=after,
        reward=reward,
        terminated=((after.done != 0) & ~cut) | ~finite,
        truncated=truncated,
        nonfinite=~finite,
        final_obs=after.obs,
        metrics=dict(getattr(after, "metrics", {})),
        episode_return=jnp.where(over, 0, state.episode_return) + reward,
        episode_length=length,
        keys=state.keys,
    )


def _time_is_up(state: Any) -> jax.Array:
    """Returns whether an environment ended its episode [] by a time limit of its own.

    brax's and Playground's ``EpisodeWrapper`` set ``done`` then, and tell why.
    """
    info = getattr(state, "info", None)
    told = info.get("truncation", 0) if isinstance(info, Mapping) else 0
    return jnp.asarray(told) != 0
