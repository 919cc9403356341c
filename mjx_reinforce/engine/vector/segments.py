"""Segments of fixed length, which go on where the last one ended: what PPO and A2C learn from."""

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jax import lax

from mjx_reinforce.engine.base import Act, Acts, Arrays, PyTree
from mjx_reinforce.engine.checks import check_count, check_key, check_kind
from mjx_reinforce.engine.contract import check_policy
from mjx_reinforce.engine.vector.environment import VectorEnv, VectorState


@runtime_checkable
class ActsWithLogProb(Acts, Protocol):
    """A family of distributions that ``unroll`` plays: ``Acts``, and how likely an action was."""

    @property
    def log_prob(self) -> Callable[..., jax.Array]:
        """(outputs [..., K], actions) -> [...] the logarithm of their probability density."""
        ...


class Segment(Arrays):
    """T steps of N environments, time first.

    Attributes:
      observation: [T, N, O] what the policy saw
      action: [T, N, A], or [T, N] if discrete: what it drew
      log_prob: [T, N] the logarithm of the action's probability density
      reward: [T, N] what that earned
      terminated: [T, N] bool, whether the task ended the episode by it
      truncated: [T, N] bool, whether the time limit did
      nonfinite: [T, N] bool, whether it left the finite numbers, which terminates the episode
      next_observation: [T, N, O] what it led to, before any reset: its value belongs to a truncated
        episode
      played: [T, N] bool, False where ``next_step`` spent the step on a reset: no loss has it
      metrics: [T, N] each, the terms of the reward and what else the task tells
      episode_return: [T, N] the rewards of the episode so far; of all of it where it ended
      episode_length: [T, N] int32, its steps so far

    Examples:
      >>> import jax
      >>> import mjx_reinforce as mr
      >>> vec = mr.make_vec("CartPole-v1", num_envs=8)
      >>> state = vec.reset(jax.random.key(0))
      >>> family = mr.categorical(vec.action_space)
      >>> policy = mr.mlp_policy(vec.observation_size, family)
      >>> params = policy.init(jax.random.key(1))
      >>> state, segment = mr.unroll(
      ...     vec, policy.apply, params, family, state, jax.random.key(2), num_steps=5
      ... )
      >>> segment.reward.shape, segment.observation.shape
      ((5, 8), (5, 8, 4))
    """

    observation: jax.Array
    action: jax.Array
    log_prob: jax.Array
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    nonfinite: jax.Array
    next_observation: jax.Array
    played: jax.Array
    metrics: dict[str, jax.Array]
    episode_return: jax.Array
    episode_length: jax.Array

    @property
    def done(self) -> jax.Array:
        """Whether the episode ended [T, N], for one reason or the other."""
        return self.terminated | self.truncated


def unroll(
    vec: VectorEnv,
    act: Act,
    params: PyTree,
    distribution: ActsWithLogProb,
    state: VectorState,
    key: jax.Array,
    num_steps: int,
) -> tuple[VectorState, Segment]:
    """Plays T steps from where the environments are.

    The policy is computed for all environments together, by XLA, whatever its size; the step is
    that of ``vec``. Call this under ``jax.jit``, alone or within a whole training.

    Args:
      vec: the environments.
      act: (params, observation [O]) -> outputs [K] of the distribution.
      params: what ``act`` reads, a pytree of arrays.
      distribution: the family whose parameters the outputs are, ours or your own.
      state: of ``vec.reset``, or what this function returned before.
      key: of the actions' noise; consumed.
      num_steps: T.

    Returns:
      Where the environments are after that, and what was played.

    Raises:
      ValueError: an argument makes no sense.

    Examples:
      >>> import jax
      >>> import mjx_reinforce as mr
      >>> vec = mr.make_vec("CartPole-v1", num_envs=8)
      >>> state = vec.reset(jax.random.key(0))
      >>> family = mr.categorical(vec.action_space)
      >>> policy = mr.mlp_policy(vec.observation_size, family)
      >>> params = policy.init(jax.random.key(1))
      >>> state, segment = mr.unroll(
      ...     vec, policy.apply, params, family, state, jax.random.key(2), num_steps=5
      ... )
      >>> segment.reward.shape, segment.observation.shape
      ((5, 8), (5, 8, 4))
    """
    check_kind("vec", vec, VectorEnv, "mjx_reinforce.make_vec(id, num_envs)")
    vec.check_state(state)
    check_key(key)
    check_count("num_steps", num_steps)
    observation = jax.ShapeDtypeStruct(state.obs.shape[1:], state.obs.dtype)
    check_policy(act, params, distribution, observation)
    if not isinstance(distribution, ActsWithLogProb):
        raise ValueError(f"distribution must have the function log_prob, got {distribution!r}")
    resets_take_steps = vec.autoreset == "next_step"

    def step(state: VectorState, key: jax.Array) -> tuple[VectorState, Segment]:
        """Plays one step, and returns what was played in it, for ``lax.scan``."""
        outputs = jax.vmap(act, (None, 0))(params, state.obs)
        action = distribution.sample(outputs, distribution.noise(key, (vec.num_envs,)))
        next_state = vec.step(state, action)
        # What had ended before the step began its next episode instead, and ignored the action.
        played = ~state.done if resets_take_steps else jnp.ones_like(state.done)
        return next_state, Segment(
            observation=state.obs,
            action=action,
            log_prob=distribution.log_prob(outputs, action),
            reward=next_state.reward,
            terminated=next_state.terminated,
            truncated=next_state.truncated,
            nonfinite=next_state.nonfinite,
            next_observation=next_state.final_obs,
            played=played,
            metrics=next_state.metrics,
            episode_return=next_state.episode_return,
            episode_length=next_state.episode_length,
        )

    state_and_segment: Any = lax.scan(step, state, jax.random.split(key, num_steps))
    return state_and_segment
