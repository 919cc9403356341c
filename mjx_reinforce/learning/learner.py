"""What a learner is: ``init``, then ``play`` and ``learn`` in turn, over one state pytree."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jax.flatten_util import ravel_pytree

from mjx_reinforce.engine.base import PyTree, Trajectory
from mjx_reinforce.engine.checks import check_kind
from mjx_reinforce.engine.play.choice import Engine
from mjx_reinforce.engine.play.rollouts import episode_lengths, episode_returns
from mjx_reinforce.learning import counts
from mjx_reinforce.learning.actor import Actor, act
from mjx_reinforce.learning.diagnostics import Metrics
from mjx_reinforce.learning.policy import Policy


class TrainState(struct.PyTreeNode, kw_only=True):
    """All that the next update needs; it holds no environment state.

    Attributes:
      key: [] the seed's own random key, split by every update
      num_updates: [2] how many updates were made, as ``counts`` has it
      env_steps: [2] how many env steps were played in them, as ``counts`` has it
      progress: [] the share of the budget that is used, for what changes with it, such as the
        learning rate; the caller of the learner sets it
      actor: the policy's parameters and the observation statistics
      opt_state: the optimiser's state
      estimator_state: the estimator's, such as a critic
      start_key: [] what every episode is reset with, where all start alike; else None

    Examples:
      >>> import jax
      >>> import mjx_reinforce as mr
      >>> env = mr.envs.make("CartPole-v1")
      >>> learner = mr.reinforce(env, num_episodes=4, horizon=20)
      >>> state = learner.init(jax.random.key(0))
      >>> state, metrics = mr.train_step(learner, state)
      >>> metrics["episodes"].item(), metrics["episode_return"].shape
      (4, ())
    """

    key: jax.Array
    num_updates: jax.Array = struct.field(default_factory=counts.zero)
    env_steps: jax.Array = struct.field(default_factory=counts.zero)
    progress: jax.Array = struct.field(default_factory=lambda: jnp.zeros(()))
    actor: Actor
    opt_state: Any = ()
    estimator_state: Any = ()
    start_key: jax.Array | None = None

    def __repr__(self) -> str:
        seeds = f", seeds {list(self.key.shape)}" if self.key.shape else ""
        return f"TrainState({self.actor!r}{seeds})"


class Guests(NamedTuple):
    """E episodes that are played in one go with those of an update, and from which nothing learns.

    keys: [E] their own keys, as ``engines.episode.episode_keys`` makes them
    num_modes: how many of them, the first, take the policy's mode; the others its samples
    active: [] whether they are played
    """

    keys: jax.Array
    num_modes: int
    active: jax.Array

    def deterministic(self) -> jax.Array:
        """Returns which of them [E] take the mode."""
        return jnp.arange(len(self.keys)) < self.num_modes


@dataclasses.dataclass(frozen=True, eq=False)
class Host:
    """A ``Learner.play`` that can take guests.

    with_guests: (TrainState, key, active, ``Guests`` or None) -> what is played, and the
      ``Trajectory`` of the guests
    """

    with_guests: Callable[..., tuple[Any, Any]]

    def alone(self, state: TrainState, key: jax.Array, active: bool | jax.Array = True) -> Any:
        """Plays without guests."""
        return self.with_guests(state, key, active, None)[0]

    __call__ = alone


class Learner(NamedTuple):
    """How a policy learns on one environment; any part may be replaced with ``_replace``.

    Attributes:
      init: (key) -> TrainState; consumes the key
      play: (TrainState, key, active) -> what is played for one update, a ``Trajectory`` of N fresh
        episodes or a pytree that holds one; nothing where ``active`` [] is False; consumes the key.
        A ``Host`` where guests do not make the others wait
      learn: (TrainState, what was played, key) -> (TrainState, metrics), with the actor and all
        else that changes by learning; consumes the key
      policy: the policy that is trained
      engine: how its episodes are played

    Examples:
      >>> import jax
      >>> import mjx_reinforce as mr
      >>> env = mr.envs.make("CartPole-v1")
      >>> learner = mr.reinforce(env, num_episodes=4, horizon=20)
      >>> state = learner.init(jax.random.key(0))
      >>> state, metrics = mr.train_step(learner, state)
      >>> metrics["episodes"].item(), metrics["episode_return"].shape
      (4, ())
    """

    init: Callable[[jax.Array], TrainState]
    play: Callable[[TrainState, jax.Array, Any], Any]
    learn: Callable[[TrainState, Any, jax.Array], tuple[TrainState, Metrics]]
    policy: Policy
    engine: Engine

    def __repr__(self) -> str:
        return f"Learner({self.policy!r}, {self.engine!r})"

    def step(
        self, state: TrainState, active: bool | jax.Array = True
    ) -> tuple[TrainState, Metrics]:
        """Makes one update: ``play``, then ``learn``.

        Args:
          state: from ``init`` or the step before.
          active: [] where False nothing is played and the state stays.
        """
        return self.step_with(state, active, None)[:2]

    def step_with(
        self, state: TrainState, active: bool | jax.Array, guests: Guests | None
    ) -> tuple[TrainState, Metrics, Trajectory | None]:
        """Makes one update as ``step``; also returns the episodes of guests, if there are any."""
        key, play_key, learn_key = jax.random.split(state.key, 3)
        if guests is not None and isinstance(self.play, Host):
            played, looked = self.play.with_guests(state, play_key, active, guests)
        else:
            played, looked = self.play(state, play_key, active), None
        learned, metrics = self.learn(state, played, learn_key)
        after = dataclasses.replace(
            learned,
            key=key,
            num_updates=counts.plus(state.num_updates, 1),
            env_steps=counts.plus(state.env_steps, metrics["env_steps"]),
        )
        if active is not True:
            after = jax.tree.map(lambda new, old: jnp.where(active, new, old), after, state)
        return after, metrics, looked

    def act(self, actor: Actor, observation: jax.Array) -> jax.Array:
        """Returns the outputs [..., K] of the policy's distribution; see ``policies.actor.act``."""
        return act(self.policy, actor, observation)


_step = jax.jit(Learner.step, static_argnums=0)


def train_step(learner: Learner, state: TrainState) -> tuple[TrainState, Metrics]:
    """Plays N episodes and makes one update, compiled.

    Nothing is donated: ``state`` stays usable. For many seeds,
    ``jax.vmap(functools.partial(train_step, learner))(states)``.

    Args:
      learner: from ``reinforce`` or ``ars``; another learner is compiled again.
      state: from ``learner.init`` or the step before.

    Returns:
      The next state, and metrics, each []: ``episodes`` (N), ``episode_return`` (mean over the N
      episodes; with ``_min`` and ``_max``), ``episode_length``, ``env_steps``
      (played in this update), ``simulated_steps`` (with those in which an episode was over
      already; of the native engine they depend on which thread is first),
      ``nonfinite_episodes`` (those that broke, which count above with what they earned until
      then), and ``skipped_update`` (1 where the proposed state was not finite, as where all
      episodes broke, and the old one was kept). Then the
      diagnostics, NaN where an episode was not finite or the update was skipped:
      ``entropy``, ``kl``, ``policy_std`` (see ``diagnostics.policy_metrics``),
      ``gradient_norm``, ``gradient_snr`` (of ``full_batch``, ``natural_gradient`` and ``ars``
      alone), ``clipped_gradients`` (see ``updates``),
      ``explained_variance`` (of an estimator with a baseline), and the estimator's own.

    Examples:
      >>> import jax
      >>> import mjx_reinforce as mr
      >>> env = mr.envs.make("CartPole-v1")
      >>> learner = mr.reinforce(env, num_episodes=4, horizon=20)
      >>> state = learner.init(jax.random.key(0))
      >>> state, metrics = mr.train_step(learner, state)
      >>> metrics["episodes"].item(), metrics["episode_return"].shape
      (4, ())
    """
    check_kind("state", state, TrainState, "learner.init(jax.random.key(0))")
    return _step(learner, state)


def keep_finite(learned: PyTree, before: PyTree) -> tuple[Any, jax.Array]:
    """Returns ``learned`` and 0 if all of it is finite, else ``before`` and 1.

    So an update that breaks costs its seed that one update.
    """
    # Floats are joined into one vector for the choice. With a choice for each leaf XLA's CPU
    # backend makes a program for each, and each of them computes again what they share.
    vector, unravel = ravel_pytree(_floats(learned))
    finite = jnp.all(jnp.isfinite(vector))
    floats = iter(unravel(jnp.where(finite, vector, ravel_pytree(_floats(before))[0])))

    def choose(new, old):
        return next(floats) if _is_float(new) else jnp.where(finite, new, old)

    kept = jax.tree.map(choose, learned, before)
    return kept, jnp.where(finite, 0, 1)


def _floats(tree: PyTree) -> list[jax.Array]:
    return [x for x in jax.tree.leaves(tree) if _is_float(x)]


def _is_float(x: jax.Array) -> bool:
    return jnp.issubdtype(x.dtype, jnp.floating)


def episode_metrics(trajectory: Trajectory) -> Metrics:
    """Returns what a person wants to know of the episodes."""
    returns, lengths = episode_returns(trajectory), episode_lengths(trajectory)
    return {
        "episodes": jnp.int32(trajectory.mask.shape[1]),
        "episode_return": jnp.mean(returns),
        "episode_return_min": jnp.min(returns),
        "episode_return_max": jnp.max(returns),
        "episode_length": jnp.mean(lengths),
        "env_steps": jnp.sum(lengths),
        "simulated_steps": trajectory.simulated,
        "nonfinite_episodes": jnp.sum(trajectory.nonfinite),
    }
