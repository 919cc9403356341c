"""Complete episodes under a policy, many at once."""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from mjx_reinforce.engine import episode
from mjx_reinforce.engine.base import Act, Acts, Environment, PyTree, Trajectory, term_names


class _Progress(NamedTuple):
    """Where N episodes are.

    state: the environment's state, episodes on the last axis of every leaf
    alive: [N] whether the episode is still running
    nonfinite: [N] whether it left the finite numbers
    steps_left: [N] how many steps it may still take; None where the horizon alone bounds them
    """

    state: Any
    alive: jax.Array
    nonfinite: jax.Array
    steps_left: jax.Array | None


def vmap_rollout(
    env: Environment,
    act: Act,
    actor: PyTree,
    distribution: Acts,
    key: jax.Array,
    *,
    num_episodes: int,
    horizon: int,
    deterministic: bool | jax.Array = False,
    active: bool | jax.Array = True,
    limit: int | jax.Array | None = None,
    env_step: Callable[[Any, jax.Array], Any] | None = None,
) -> Trajectory:
    """Plays N episodes from fresh resets, each to its end or to the horizon.

    An episode's reset and noise come from its own key alone, whatever N is. When all are over the
    simulation stops.

    Args:
      env: what is played.
      act: (actor, observation [N, O]) -> outputs [N, K] of the distribution.
      actor: what ``act`` reads.
      distribution: the family whose parameters the outputs are.
      key: consumed; [N] the episodes' own, or [] and that of episode i is this one folded with i.
      num_episodes: N.
      horizon: T, the time limit in steps; reaching it ends an episode.
      deterministic: [] or [N] whether an episode takes the mode.
      active: [] or [N] whether an episode is played: else it has no step, and zeros stand for it.
      limit: [] or [N] steps after which an episode ends, if that is before the horizon; an episode
        with a limit of 0 is not played.
      env_step: ``env.step`` of N episodes, the last axis of every leaf; by default ``jax.vmap``.

    Returns:
      The episodes. A non-finite observation, reward or ``done`` ends its episode, with reward 0 for
      that step, and shows in ``nonfinite``.

    Raises:
      ValueError: an argument makes no sense.
    """
    steps = horizon if limit is None else limit
    episode.check_each(num_episodes, deterministic=deterministic, active=active, limit=steps)
    if env_step is None:
        env_step = jax.vmap(env.step, in_axes=-1, out_axes=-1)
    # Inside, episodes are the last axis: each scalar of the state is a contiguous row.
    start = jax.vmap(functools.partial(episode.begin, env), out_axes=(-1, 0))
    state, noise_keys = start(episode.episode_keys(key, num_episodes))
    # Where no episode takes the mode, none is computed: a training's updates.
    modes = None
    if deterministic is not False:
        modes = jnp.broadcast_to(deterministic, num_episodes)
    terms = term_names(env)
    step = functools.partial(_step, env_step, act, distribution, actor, modes, terms)
    no_episode = jnp.zeros(num_episodes, bool)
    if limit is None:
        steps_left = None
        is_alive = no_episode | active
    else:
        steps_left = jnp.broadcast_to(limit, num_episodes)
        is_alive = active & (steps_left > 0)
    progress = _Progress(state, is_alive, nonfinite=no_episode, steps_left=steps_left)
    records = _empty_records(step, progress, distribution, horizon)
    progress, (observation, action, reward, mask, term_rewards), simulated = episode.play_chunks(
        lambda noise, progress: lax.scan(step, progress, noise),
        distribution,
        noise_keys,
        progress,
        records,
    )
    return Trajectory(
        observation=jnp.swapaxes(observation, 1, 2),
        action=action,
        reward=reward,
        mask=mask,
        nonfinite=progress.nonfinite,
        simulated=simulated,
        terms=term_rewards,
    )


def _step(
    env_step: Callable[[Any, jax.Array], Any],
    act: Act,
    distribution: Acts,
    actor: PyTree,
    deterministic: jax.Array | None,
    terms: Sequence[str],
    progress: _Progress,
    noise: jax.Array,
) -> tuple[_Progress, tuple[Any, ...]]:
    """Plays one step of N episodes; for ``lax.scan`` over the noise [length, N, E].

    Returns:
      The progress, and the records of the step: observation [O, N], action [N, A], reward [N],
      whether the episode was running before it [N], and the reward's terms [N] by name.
    """
    state, is_alive, nonfinite, steps_left = progress
    step = episode.step(
        env_step, act, distribution, actor, state, noise, is_alive, deterministic, terms
    )
    state = episode.hold(is_alive, step.state, state)
    # The mask is of the episodes that ran before the step: their last step counts.
    record = (step.observation, step.action, step.reward, is_alive, step.terms)
    is_alive = step.alive
    if steps_left is not None:
        steps_left = steps_left - 1
        is_alive &= steps_left > 0
    return _Progress(state, is_alive, nonfinite | step.broken, steps_left), record


def _empty_records(
    step: Callable[..., Any], progress: _Progress, distribution: Acts, horizon: int
) -> Any:
    """Returns zeros [horizon, ...] of the shapes that ``step`` records."""
    shape = progress.alive.shape
    noise = jax.eval_shape(lambda: distribution.noise(jax.random.key(0), shape))
    record = jax.eval_shape(step, progress, noise)[1]
    return jax.tree.map(lambda x: jnp.zeros((horizon, *x.shape), x.dtype), record)


def episode_returns(trajectory: Trajectory) -> jax.Array:
    """Returns the undiscounted return [N] of every episode."""
    return jnp.sum(trajectory.reward, axis=0)


def episode_lengths(trajectory: Trajectory) -> jax.Array:
    """Returns how many steps [N] every episode took."""
    return jnp.sum(trajectory.mask, axis=0)
