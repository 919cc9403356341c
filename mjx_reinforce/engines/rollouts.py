"""Complete episodes under a policy, many at once."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from mjx_reinforce.engines.loops import largest_divisor, while_any
from mjx_reinforce.policies.distribution import Distribution
from mjx_reinforce.types import Environment, Trajectory

#: Steps between two looks whether every episode is over; noise is drawn by the chunk.
CHUNK_STEPS = 50


def rollout(
    env: Environment,
    act: Callable[[Any, jax.Array], jax.Array],
    actor: Any,
    distribution: Distribution,
    key: jax.Array,
    *,
    num_episodes: int,
    horizon: int,
    num_deterministic: int = 0,
    active: bool | jax.Array = True,
    env_step: Callable[[Any, jax.Array], Any] | None = None,
) -> Trajectory:
    """Plays N episodes from fresh resets, each to its end or to the horizon.

    An episode's reset and noise come from the key folded with its own index, so
    they do not depend on how many are played beside it. When all are over the
    simulation stops.

    Args:
      env: what is played.
      act: (actor, observation [N, O]) -> outputs [N, K] of the distribution.
      actor: what ``act`` reads.
      distribution: what the outputs index.
      key: consumed.
      num_episodes: N.
      horizon: T, the time limit in steps; reaching it ends an episode.
      num_deterministic: how many episodes, the first ones, take the mode.
      active: [] False plays nothing, for a seed that stands still among others.
      env_step: the environment's step over a batch on the last axis of every leaf;
        by default ``jax.vmap`` of it.

    Returns:
      The episodes. A non-finite observation or reward ends its episode, with
      reward 0 for that step, and is told apart in ``nonfinite``.
    """
    # Inside, episodes are the last axis: each scalar of the state is a contiguous row.
    start = jax.vmap(functools.partial(begin, env, key), out_axes=(-1, 0))
    state, noise_keys = start(jnp.arange(num_episodes))
    if env_step is None:
        env_step = jax.vmap(env.step, in_axes=-1, out_axes=-1)
    deterministic = jnp.arange(num_episodes) < num_deterministic
    length = largest_divisor(horizon, CHUNK_STEPS)

    def step(carry, noise):
        state, alive, bad = carry
        observation = jnp.where(alive, state.obs, 0.0)
        outputs = act(actor, observation.T)
        action = distribution.sample(outputs, noise)
        if num_deterministic:
            action = _where(deterministic, distribution.mode(outputs), action)
        # A finished episode repeats its last step: its state must not run off to
        # infinity, where the solver of plain MJX needs all its iterations.
        after = env_step(state, jnp.moveaxis(action, 0, -1))
        after = jax.tree.map(lambda new, old: jnp.where(alive, new, old), after, state)
        broken = alive & ~(jnp.all(jnp.isfinite(after.obs), axis=0) & jnp.isfinite(after.reward))
        reward = jnp.where(alive & ~broken, after.reward, 0.0)
        record = (observation, _where(alive, action, jnp.zeros_like(action)), reward, alive)
        alive = alive & ~broken & (after.done == 0)
        return (after, alive, bad | broken), record

    def advance(carry):
        chunk, keys, simulation, records = carry
        draw = functools.partial(draw_noise, distribution, length)
        keys, noise = jax.vmap(draw, out_axes=(0, 1))(keys)
        simulation, new = lax.scan(step, simulation, noise)
        records = jax.tree.map(
            lambda old, x: lax.dynamic_update_slice_in_dim(old, x, chunk * length, 0), records, new
        )
        return chunk + 1, keys, simulation, records

    def unfinished(carry):
        chunk, _, (_, alive, _), _ = carry
        return (chunk < horizon // length) & jnp.any(alive)

    none = jnp.zeros(num_episodes, bool)

    def first(noise_keys):
        noise = jax.vmap(lambda key: draw_noise(distribution, 1, key)[1], out_axes=1)(noise_keys)
        action = distribution.sample(act(actor, state.obs.T), noise[0])
        return state.obs, action, state.reward, none

    records = jax.tree.map(
        lambda x: jnp.zeros((horizon, *x.shape), x.dtype), jax.eval_shape(first, noise_keys)
    )
    init = (jnp.zeros((), jnp.int32), noise_keys, (state, none | active, none), records)
    _, _, (_, _, bad), (observation, action, reward, mask) = while_any(unfinished, advance, init)
    return Trajectory(
        observation=jnp.swapaxes(observation, 1, 2),
        action=action,
        reward=reward,
        mask=mask,
        nonfinite=bad,
    )


def begin(env: Environment, key: jax.Array, episode: jax.Array) -> tuple[Any, jax.Array]:
    """Returns an episode's start state and the key of its noise."""
    reset_key, noise_key = jax.random.split(jax.random.fold_in(key, episode))
    return env.reset(reset_key), noise_key


def draw_noise(
    distribution: Distribution, length: int, key: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Returns the next key of an episode's noise, and its noise [length, E] for a chunk."""
    key, noise_key = jax.random.split(key)
    return key, distribution.noise(noise_key, (length,))


def _where(mask: jax.Array, x: jax.Array, y: jax.Array) -> jax.Array:
    """Chooses between [N, ...] arrays episode by episode."""
    return jnp.where(mask.reshape(mask.shape + (1,) * (x.ndim - 1)), x, y)


def episode_returns(trajectory: Trajectory) -> jax.Array:
    """Returns the undiscounted return [N] of every episode."""
    return jnp.sum(trajectory.reward, axis=0)


def episode_lengths(trajectory: Trajectory) -> jax.Array:
    """Returns how many steps [N] every episode took."""
    return jnp.sum(trajectory.mask, axis=0)


def simulated_steps(trajectory: Trajectory) -> jax.Array:
    """Returns how many env steps [] were simulated: N times the longest episode, in whole chunks.

    Beside other seeds, it is the seed with the longest episode that decides.
    """
    horizon, num_episodes = trajectory.mask.shape
    length = largest_divisor(horizon, CHUNK_STEPS)
    longest = jnp.max(episode_lengths(trajectory))
    return num_episodes * length * ((longest + length - 1) // length)
