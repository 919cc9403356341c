"""Complete episodes under anybody's policy, on the engine that is fastest for it."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_reinforce.engine.base import Act, Acts, Environment, PyTree, Trajectory, null_action
from mjx_reinforce.engine.checks import check_count, check_key, check_parts
from mjx_reinforce.engine.contract import check_policy
from mjx_reinforce.engine.play import available, choice, rollouts

#: A policy of more parameters than about 64-64 is computed for all episodes together, by XLA: each
#: lane of machine code would read all parameters in each step.
_MOST_PARAMETERS = 8_000


def rollout(
    env: Environment,
    act: Act,
    actor: PyTree,
    distribution: Acts,
    key: jax.Array,
    *,
    num_episodes: int,
    horizon: int,
    engine: str = "auto",
    deterministic: bool | jax.Array = False,
    active: bool | jax.Array = True,
) -> Trajectory:
    """Plays N episodes from fresh resets, each to its end or to the horizon.

    An episode's reset and noise come from its own key alone, whatever N is and whichever engine
    plays. Call this under ``jax.jit``: outside of it, what is played is traced again each time.

    Args:
      env: what is played.
      act: (actor, observation [O]) -> outputs [K] of the distribution: any function that JAX can
        trace, of one observation. Of a flax.linen module it is ``module.apply``; of others see
        docs/vector.md.
      actor: what ``act`` reads, a pytree of arrays, such as the parameters of a network.
      distribution: the family whose parameters the outputs are, ours or your own.
      key: consumed; [N] the episodes' own, or [] and that of episode i is this one folded with i.
      num_episodes: N.
      horizon: T, the time limit in steps; reaching it ends an episode.
      engine: "auto"; "native" or "vmap". With "auto" a small policy is played in
        machine code, policy and all; a larger one by XLA, with the env step in machine code.
      deterministic: [] or [N] whether an episode takes the mode.
      active: [] or [N] whether an episode is played: else it has no step, and zeros stand for it.

    Returns:
      The episodes. A non-finite observation, reward or ``done`` ends its episode, with reward 0 for
      that step, and shows in ``nonfinite``.

    Raises:
      ValueError: an argument makes no sense, or the engine cannot play this.

    Examples:
      >>> import jax
      >>> import mjx_reinforce as mr
      >>> env = mr.envs.make("CartPole-v1")
      >>> family = mr.categorical(env.action_space)
      >>> policy = mr.mlp_policy(env.observation_size, family)
      >>> episodes = mr.rollout(
      ...     env, policy.apply, policy.init(jax.random.key(0)), family, jax.random.key(1),
      ...     num_episodes=8, horizon=20,
      ... )
      >>> episodes.reward.shape
      (20, 8)
    """
    if hasattr(env, "num_envs"):
        raise ValueError("rollout takes one environment, and this is many: pass its env, vec.env")
    check_parts(env)
    check_key(key)
    check_count("num_episodes", num_episodes)
    check_count("horizon", horizon)
    check_policy(act, actor, distribution, jax.eval_shape(env.reset, jax.random.key(0)).obs)
    play = _player(engine, env, act, actor, distribution, horizon)
    return play(
        env,
        _of_any_batch(act),
        actor,
        distribution,
        key,
        num_episodes=num_episodes,
        horizon=horizon,
        deterministic=deterministic,
        active=active,
    )


def _player(
    engine: str,
    env: Environment,
    act: Act,
    params: PyTree,
    distribution: Acts,
    horizon: int,
) -> Callable[..., Trajectory]:
    """Returns what plays."""
    large = sum(np.size(x) for x in jax.tree.leaves(params)) > _MOST_PARAMETERS
    if engine == "auto" and large and available.platform() == "cpu":
        examples = jax.eval_shape(env.reset, jax.random.key(0)), null_action(env)
        step = choice.machine_code(env, env.step, *examples)
        if not isinstance(step, str):
            return functools.partial(rollouts.rollout, env_step=_episodes_last(step))
    shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(jnp.shape(x), jnp.result_type(x)), params)
    player = choice.ActingPolicy(act, shapes, distribution)
    return choice.choose(engine, env, player, horizon).rollout


def _of_any_batch(act: Act) -> Act:
    """Returns a policy of one observation [O] as one of [O] or [N, O]."""

    def batched(params: PyTree, observation: jax.Array) -> jax.Array:
        mapped = act if observation.ndim == 1 else jax.vmap(act, (None, 0))
        return mapped(params, observation)

    return batched


def _episodes_last(step: Callable[[Any, jax.Array], Any]) -> Callable[[Any, jax.Array], Any]:
    """Returns a step of N environments, the first axis of every array, with N as the last axis."""

    def turned(state: PyTree, action: jax.Array) -> Any:
        first = jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0), (state, action))
        return jax.tree.map(lambda x: jnp.moveaxis(x, 0, -1), step(*first))

    return turned
