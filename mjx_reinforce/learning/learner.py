"""REINFORCE (Williams 1992): ``reinforce`` has the formula, ``learn`` in it the update.

A learner is ``init``, then ``play`` and ``learn`` in turn, over one state pytree.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jax.flatten_util import ravel_pytree

from mjx_reinforce.engine.base import (
    Environment,
    PyTree,
    Trajectory,
    action_space,
    observation_size,
)
from mjx_reinforce.engine.checks import check_count, check_key, check_kind, check_number
from mjx_reinforce.engine.contract import check_environment
from mjx_reinforce.engine.play import choice
from mjx_reinforce.engine.play.choice import Engine
from mjx_reinforce.engine.play.episode import check_each, episode_keys
from mjx_reinforce.engine.play.rollouts import episode_lengths, episode_returns
from mjx_reinforce.learning import contract, counts, diagnostics, normalize
from mjx_reinforce.learning.diagnostics import Metrics
from mjx_reinforce.learning.distributions import default_distribution
from mjx_reinforce.learning.estimators import Estimator, leave_one_out, standardize
from mjx_reinforce.learning.policy import Actor, Policy, act, mlp_policy
from mjx_reinforce.learning.updates import Clock, Problem, Update, full_batch, make_optimizer


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
      >>> state = mr.reinforce(env).init(jax.random.key(0))
      >>> state.num_updates.tolist(), state.progress.item()
      ([0, 0], 0.0)
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


class Learner(NamedTuple):
    """How a policy learns on one environment; any part may be replaced with ``_replace``.

    Attributes:
      init: (key) -> TrainState; consumes the key
      play: (TrainState, key, active) -> what is played for one update, a ``Trajectory`` of N fresh
        episodes or a pytree that holds one; nothing where ``active`` [] is False; consumes the key
      learn: (TrainState, what was played, key) -> (TrainState, metrics), with the actor and all
        else that changes by learning; consumes the key
      policy: the policy that is trained
      engine: how its episodes are played

    Examples:
      >>> import jax
      >>> import mjx_reinforce as mr
      >>> env = mr.envs.make("CartPole-v1")
      >>> learner = mr.reinforce(env, num_episodes=4, horizon=20)
      >>> played = learner.play(learner.init(jax.random.key(0)), jax.random.key(1), True)
      >>> played.reward.shape
      (20, 4)
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
        key, play_key, learn_key = jax.random.split(state.key, 3)
        played = self.play(state, play_key, active)
        learned, metrics = self.learn(state, played, learn_key)
        after = dataclasses.replace(
            learned,
            key=key,
            num_updates=counts.plus(state.num_updates, 1),
            env_steps=counts.plus(state.env_steps, metrics["env_steps"]),
        )
        if active is not True:
            after = jax.tree.map(lambda new, old: jnp.where(active, new, old), after, state)
        return after, metrics

    def act(self, actor: Actor, observation: jax.Array) -> jax.Array:
        """Returns the outputs [..., K] of the policy's distribution; see ``policy.act``."""
        return act(self.policy, actor, observation)


def reinforce(
    env: Environment,
    *,
    policy: Policy | None = None,
    estimator: Estimator | None = None,
    optimizer: optax.GradientTransformation | None = None,
    update: Update | None = None,
    num_episodes: int = 16,
    horizon: int | None = None,
    entropy_cost: float | jax.Array = 0.0,
    max_kl: float | jax.Array | None = None,
    normalize_steps: float = 1000,
    normalize_min_std: float | jax.Array = 0.0,
    engine: str = "auto",
) -> Learner:
    """Builds REINFORCE for an environment.

    One update plays N complete episodes and follows the gradient of

        (1/N) sum_n sum_t (weight[t, n] log pi(a[t, n] | o[t, n]) + entropy_cost H[t, n])

    with the weights that the estimator gives. An episode in which the simulation left the finite
    numbers counts as the worst of the others; where all did, nothing is learned.

    Numbers such as ``entropy_cost``, the estimator's discount and the optimiser's learning rate
    may be traced: build the learner inside a function to vmap over them.

    Args:
      env: what is played; any brax-style environment.
      policy: by default an MLP of 32 and 32 tanh units with ``default_distribution``.
      estimator: by default leave-one-out on the return to go (discount 0.99), divided by its
        standard deviation plus 10.
      optimizer: by default Adam at 1e-2 with the gradient's norm clipped at 1.
      update: how the gradient is spent, from ``updates``; by default in one optimiser step.
      num_episodes: N, episodes an update.
      horizon: T, steps after which an episode ends; by default ``env.max_episode_steps``.
      entropy_cost: weight of the policy's entropy H, in return per nat.
      max_kl: the most, in nats, by which an update may move the policy: the mean over the steps
        that it visited of KL(before || after). A change that goes further is shortened, see
        ``diagnostics.within_kl``; None shortens none. A new scale of the observations comes on top.
      normalize_steps: scale observations by the mean and std of about the first so many steps,
        then keep that scale; 0 does not scale, inf never stops. (Where a policy learns to keep
        the state near the middle, statistics that never stop shrink, and magnify the
        observations until the policy fails.)
      normalize_min_std: the least that an observation is divided by, in its own unit. (What hardly
        changes in the first steps would be magnified for the rest of training.)
      engine: how episodes are played: "auto", "vmap" or "native", see ``engine.play.choice``.

    Raises:
      ValueError: an argument makes no sense for this environment.

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
    check_environment(env)
    size = observation_size(env)
    check_count("num_episodes", num_episodes)
    check_number("entropy_cost", entropy_cost)
    check_number("normalize_steps", normalize_steps, finite=False)
    check_number("normalize_min_std", normalize_min_std)
    if max_kl is not None:
        check_number("max_kl", max_kl, positive=True, finite=False)
    horizon = contract.check_horizon(env, horizon)
    if policy is None:
        policy = mlp_policy(size, default_distribution(action_space(env)))
    contract.check_policy(policy, env, size, likelihood=True)
    optimizer = make_optimizer() if optimizer is None else optimizer
    contract.check_optimizer("optimizer", optimizer)
    update = full_batch() if update is None else update
    contract.check_update(update)
    estimator = standardize(leave_one_out(), floor=10.0) if estimator is None else estimator
    contract.check_estimator(estimator, env, size, num_episodes)

    example = jax.eval_shape(functools.partial(first_actor, policy, size), jax.random.key(0))
    player = choice.ActingPolicy(functools.partial(act, policy), example, policy.distribution)
    plays = choice.choose(engine, env, player, horizon)
    return Learner(
        init=_init(policy, optimizer, estimator, size),
        play=_play(env, policy, plays, num_episodes, horizon),
        learn=_learn(
            policy=policy,
            estimator=estimator,
            update=update,
            problem=_problem(policy, optimizer, num_episodes, entropy_cost),
            max_kl=max_kl,
            normalize_limits=(normalize_steps, normalize_min_std),
        ),
        policy=policy,
        engine=plays,
    )


def first_actor(policy: Policy, observation_size: int, key: jax.Array) -> Actor:
    """Returns the actor before training."""
    return Actor(params=policy.init(key), normalizer=normalize.init(observation_size))


def _init(
    policy: Policy, optimizer: optax.GradientTransformation, estimator: Estimator, size: int
) -> Callable[[jax.Array], TrainState]:
    """Returns ``Learner.init``."""

    def init(key: jax.Array) -> TrainState:
        check_key(key)
        policy_key, estimator_key, key = jax.random.split(key, 3)
        actor = first_actor(policy, size, policy_key)
        return TrainState(
            key=key,
            actor=actor,
            opt_state=optimizer.init(actor.params),
            estimator_state=estimator.init(estimator_key, size),
        )

    return init


def _play(
    env: Environment, policy: Policy, plays: Engine, num_episodes: int, horizon: int
) -> Callable[..., Trajectory]:
    """Returns ``Learner.play``, which takes a ``limit`` [] of an episode's steps besides."""

    def play(
        state: TrainState,
        key: jax.Array,
        active: bool | jax.Array = True,
        limit: jax.Array | None = None,
    ) -> Trajectory:
        check_each(num_episodes, active=active)
        return plays.rollout(
            begins_as(env, state.start_key),
            functools.partial(act, policy),
            state.actor,
            policy.distribution,
            episode_keys(key, num_episodes),
            num_episodes=num_episodes,
            horizon=horizon,
            active=active,
            limit=None if limit is None else jnp.minimum(limit, horizon),
        )

    return play


def begins_as(env: Environment, start_key: jax.Array | None) -> Any:
    """Returns an environment whose every episode starts with a key, if there is one."""
    return env if start_key is None else _OneStart(env, start_key)


class _OneStart:
    """An environment whose every episode starts with the same key."""

    def __init__(self, env: Environment, key: jax.Array):
        self._env, self._key = env, key

    def reset(self, rng: jax.Array) -> Any:
        del rng
        return self._env.reset(self._key)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._env, name)


def _learn(
    *,
    policy: Policy,
    estimator: Estimator,
    update: Update,
    problem: Callable[..., Problem],
    max_kl: float | jax.Array | None,
    normalize_limits: tuple[float, float | jax.Array],
) -> Callable[[TrainState, Trajectory, jax.Array], tuple[TrainState, Metrics]]:
    """Returns ``Learner.learn``: the update, in the order of the formula."""

    def learn(
        state: TrainState, trajectory: Trajectory, key: jax.Array
    ) -> tuple[TrainState, Metrics]:
        before, visited = state.actor, diagnostics.visited_steps(trajectory)
        # Normalize, weigh, follow the gradient, limit the change, count, keep what is finite.
        seen = normalize.seen(before.normalizer, trajectory)
        weight, estimator_state, metrics = estimator.update(state.estimator_state, seen)
        params, opt_state, measured = update(
            problem(state, seen, weight), key, before.params, state.opt_state
        )
        params = diagnostics.within_kl(policy, before, params, visited, max_kl)
        normalizer = normalize.count(before.normalizer, trajectory, *normalize_limits)
        learned, skipped = keep_finite(
            (Actor(params=params, normalizer=normalizer), opt_state, estimator_state),
            (before, state.opt_state, state.estimator_state),
        )
        actor, opt_state, estimator_state = learned
        change = diagnostics.policy_metrics(policy, before, actor, visited)
        sound = (skipped == 0) & ~jnp.any(trajectory.nonfinite)
        measured = diagnostics.nan_unless(sound, metrics | measured | change)
        state = dataclasses.replace(
            state, actor=actor, opt_state=opt_state, estimator_state=estimator_state
        )
        return state, episode_metrics(trajectory) | measured | {"skipped_update": skipped}

    return learn


def _problem(
    policy: Policy,
    optimizer: optax.GradientTransformation,
    num_episodes: int,
    entropy_cost: float | jax.Array,
) -> Callable[[TrainState, Trajectory, jax.Array], Problem]:
    """Returns (state, trajectory, weight [T, N]) -> the ``Problem`` of an update."""
    surrogate = _surrogate(policy, entropy_cost)

    def problem(state: TrainState, seen: Trajectory, weight: jax.Array) -> Problem:
        return Problem(
            surrogate=surrogate,
            optimizer=optimizer,
            samples=(seen.observation, seen.action, weight, seen.mask),
            divisor=num_episodes,
            clock=Clock(state.progress, counts.as_float(state.env_steps)),
        )

    return problem


def _surrogate(policy: Policy, entropy_cost: float | jax.Array) -> Callable[..., Any]:
    """Returns (params, samples) -> (minus the sum in the formula, the sum of the entropy)."""
    distribution = policy.distribution

    def surrogate(params, chunk):
        observation, action, weight, mask = chunk
        outputs = policy.apply(params, observation)
        entropy = distribution.entropy(outputs)
        terms = distribution.log_prob(outputs, action) * weight + entropy_cost * entropy
        loss = -jnp.sum(jnp.where(mask, terms, 0.0))
        return loss, {"entropy": jnp.sum(jnp.where(mask, entropy, 0.0))}

    return surrogate


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
