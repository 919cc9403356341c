"""Complete episodes under a policy, many at once."""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax

from mjx_reinforce.control import largest_divisor, while_any
from mjx_reinforce.distributions import Distribution
from mjx_reinforce.types import Environment, Trajectory

#: Steps between two looks whether every episode is over; noise is drawn by the chunk.
CHUNK_STEPS = 50


def rollout(
    env: Environment,
    act: Callable[[jax.Array], jax.Array],
    distribution: Distribution,
    key: jax.Array,
    *,
    num_episodes: int,
    horizon: int,
    num_deterministic: int = 0,
) -> Trajectory:
    """Plays N episodes from fresh resets, each to its end or to the horizon.

    An episode's reset and noise come from the key folded with its own index, so
    they do not depend on how many are played beside it. When all are over the
    simulation stops.

    Args:
      env: what is played; its reset and step are vmapped.
      act: (observation [N, O]) -> outputs [N, K] of the distribution.
      distribution: what the outputs index.
      key: consumed.
      num_episodes: N.
      horizon: T, the time limit in steps; reaching it ends an episode.
      num_deterministic: how many episodes, the first ones, take the mode.

    Returns:
      The episodes. A non-finite observation or reward ends its episode, with
      reward 0 for that step, and is told apart in ``nonfinite``.
    """
    keys = jax.vmap(lambda i: jax.random.fold_in(key, i))(jnp.arange(num_episodes))
    reset_keys, noise_keys = jnp.moveaxis(jax.vmap(jax.random.split)(keys), 1, 0)
    deterministic = jnp.arange(num_episodes) < num_deterministic
    length = largest_divisor(horizon, CHUNK_STEPS)

    def draw(chunk):
        def one(noise_key):
            return distribution.noise(jax.random.fold_in(noise_key, chunk), (length,))

        return jnp.moveaxis(jax.vmap(one)(noise_keys), 0, 1)

    def step(carry, noise):
        state, alive, bad = carry
        observation = _where(alive, state.obs, jnp.zeros_like(state.obs))
        outputs = act(observation)
        action = distribution.sample(outputs, noise)
        if num_deterministic:
            action = _where(deterministic, distribution.mode(outputs), action)
        # A finished episode repeats its last step: its state must not run off to
        # infinity, where the solver of plain MJX needs all its iterations.
        after = jax.tree.map(
            functools.partial(_where, alive), jax.vmap(env.step)(state, action), state
        )
        broken = alive & ~(jnp.all(jnp.isfinite(after.obs), axis=-1) & jnp.isfinite(after.reward))
        reward = jnp.where(alive & ~broken, after.reward, 0.0)
        record = (observation, _where(alive, action, jnp.zeros_like(action)), reward, alive)
        alive = alive & ~broken & (after.done == 0)
        return (after, alive, bad | broken), record

    def advance(carry):
        chunk, simulation, records = carry
        simulation, new = lax.scan(step, simulation, draw(chunk))
        start = chunk * length
        records = jax.tree.map(
            lambda old, x: lax.dynamic_update_slice_in_dim(old, x, start, 0), records, new
        )
        return chunk + 1, simulation, records

    def unfinished(carry):
        chunk, (_, alive, _), _ = carry
        return (chunk < horizon // length) & jnp.any(alive)

    state = jax.vmap(env.reset)(reset_keys)
    none = jnp.zeros(num_episodes, bool)
    simulation = (state, ~none, none)
    _, one_step = jax.eval_shape(lambda: step(simulation, draw(0)[0]))
    records = jax.tree.map(lambda x: jnp.zeros((horizon, *x.shape), x.dtype), one_step)
    _, (_, _, bad), records = while_any(
        unfinished, advance, (jnp.zeros((), jnp.int32), simulation, records)
    )
    observation, action, reward, mask = records
    return Trajectory(
        observation=observation, action=action, reward=reward, mask=mask, nonfinite=bad
    )


def _where(mask: jax.Array, x: jax.Array, y: jax.Array) -> jax.Array:
    """Chooses between [N, ...] arrays episode by episode."""
    return jnp.where(mask.reshape(mask.shape + (1,) * (x.ndim - 1)), x, y)


def episode_returns(trajectory: Trajectory) -> jax.Array:
    """Returns the undiscounted return [N] of every episode."""
    return jnp.sum(trajectory.reward, axis=0)


def episode_lengths(trajectory: Trajectory) -> jax.Array:
    """Returns how many steps [N] every episode took."""
    return jnp.sum(trajectory.mask, axis=0)
