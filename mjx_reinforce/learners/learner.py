"""REINFORCE as a pair of pure functions, ``init`` and ``step``, over one state pytree."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import struct

from mjx_reinforce.engines import choice as engines
from mjx_reinforce.engines.rollouts import episode_lengths, episode_returns, simulated_steps
from mjx_reinforce.learners.estimators import Estimator, leave_one_out, standardize
from mjx_reinforce.learners.updates import Problem, Update, full_batch, make_optimizer
from mjx_reinforce.policies import normalize
from mjx_reinforce.policies.actor import Actor
from mjx_reinforce.policies.distribution import Distribution, categorical
from mjx_reinforce.policies.normal import normal
from mjx_reinforce.policies.policy import Policy, mlp_policy
from mjx_reinforce.types import (
    Box,
    Discrete,
    Environment,
    Trajectory,
    action_space,
    observation_size,
)

Metrics = dict[str, jax.Array]


@struct.dataclass(kw_only=True)
class TrainState:
    """All that the next update needs; no environment state is among it.

    key: [] the seed's own random key, split by every update
    update: [] how many updates were made
    actor: the policy's parameters and the observation statistics
    opt_state: the optimiser's state
    estimator_state: the estimator's, such as a critic
    start_key: [] what every episode is reset with, where all start alike; else None
    """

    key: jax.Array
    update: jax.Array
    actor: Actor
    opt_state: Any
    estimator_state: Any
    start_key: jax.Array | None = None


class Learner(NamedTuple):
    """REINFORCE on one environment.

    init: (key) -> TrainState; consumes the key
    step: (TrainState, active=True) -> (TrainState, metrics), one update on N fresh
      episodes; where ``active`` [] is False nothing is played and the state stays
    act: (Actor, observation [..., O]) -> outputs [..., K] of the distribution
    policy: the policy that is trained
    engine: how its episodes are played
    """

    init: Callable[[jax.Array], TrainState]
    step: Callable[..., tuple[TrainState, Metrics]]
    act: Callable[[Actor, jax.Array], jax.Array]
    policy: Policy
    engine: engines.Engine


def default_distribution(space: Box | Discrete) -> Distribution:
    """Returns a Normal with a trained std, or a categorical distribution if discrete."""
    return categorical(space) if isinstance(space, Discrete) else normal(space)


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
    loss_per: str = "episode",
    normalize_steps: float = 1000,
    one_start: bool = False,
    engine: str = "auto",
) -> Learner:
    """Builds REINFORCE (Williams 1992) for an environment.

    One update plays N complete episodes and follows the gradient of

        (1/N) sum_n sum_t weight[t, n] log pi(a[t, n] | o[t, n]) + entropy_cost H[t, n]

    Numbers such as ``entropy_cost``, the estimator's discount and the optimiser's
    learning rate may be traced: build the learner inside a function to vmap over them.

    Args:
      env: what is played; any brax-style environment.
      policy: by default an MLP of 32 and 32 tanh units with ``default_distribution``.
      estimator: by default leave-one-out on the return to go (discount 0.99),
        divided by its standard deviation plus 10.
      optimizer: by default Adam at 1e-2 with the gradient's norm clipped at 1.
      update: how the gradient is spent, from ``updates``; by default in one step.
      num_episodes: N, episodes an update.
      horizon: T, steps after which an episode ends; by default the environment's
        ``max_episode_steps``.
      entropy_cost: weight of the policy's entropy H, in return per nat.
      loss_per: "episode" divides the sum by N, as the formula says; "step" by the
        number of steps played, which makes the step shrink as episodes grow.
      normalize_steps: observations are scaled by the mean and standard deviation
        of about the first so many steps, then the scale stands still: one that
        follows a policy which learns to keep near the middle drives up its gain
        until it fails. 0 leaves them as they are, inf never stops. Each update uses
        the statistics that its episodes were played with.
      one_start: reset every episode of a seed with the same key, drawn at ``init``: it
        knows a single start, which is easier, and not the task. Seeds differ in theirs.
      engine: how episodes are played: "auto", "mjx", "fused" or "kernel", see ``engines``.

    Returns:
      The learner: ``init(key)`` makes a state, ``train_step(learner, state)`` moves it on.

    Raises:
      ValueError: an argument makes no sense for this environment.
    """
    horizon = check_horizon(env, horizon)
    size = observation_size(env)
    if policy is None:
        policy = mlp_policy(size, default_distribution(action_space(env)))
    estimator = standardize(leave_one_out(), floor=10.0) if estimator is None else estimator
    if num_episodes < estimator.min_episodes:
        raise ValueError(
            f"this estimator needs at least {estimator.min_episodes} episodes an update, "
            f"got num_episodes={num_episodes}"
        )
    if loss_per not in ("episode", "step"):
        raise ValueError(f"loss_per must be 'episode' or 'step', got {loss_per!r}")
    parts = _Reinforce(
        env=env,
        policy=policy,
        estimator=estimator,
        optimizer=make_optimizer() if optimizer is None else optimizer,
        update=full_batch() if update is None else update,
        num_episodes=num_episodes,
        horizon=horizon,
        entropy_cost=entropy_cost,
        per_step=loss_per == "step",
        normalize_steps=normalize_steps,
        one_start=one_start,
        size=size,
    )
    actor = jax.eval_shape(parts.first_actor, jax.random.key(0))
    chosen = engines.choose(engine, env, engines.Player(parts.act, actor, policy.distribution))
    step = functools.partial(parts.step, chosen.rollout)
    return Learner(parts.init, step, parts.act, policy, chosen)


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class _Reinforce:
    """The arguments of ``reinforce``, and what it does with them; ``size`` is O."""

    env: Environment
    policy: Policy
    estimator: Estimator
    optimizer: optax.GradientTransformation
    update: Update
    num_episodes: int
    horizon: int
    entropy_cost: float | jax.Array
    per_step: bool
    normalize_steps: float
    one_start: bool
    size: int

    def act(self, actor: Actor, observation: jax.Array) -> jax.Array:
        return self.policy.apply(actor.params, normalize.apply(actor.normalizer, observation))

    def first_actor(self, key: jax.Array) -> Actor:
        return Actor(params=self.policy.init(key), normalizer=normalize.init(self.size))

    def init(self, key: jax.Array) -> TrainState:
        policy_key, estimator_key, key = jax.random.split(key, 3)
        start_key = None
        if self.one_start:
            key, start_key = jax.random.split(key)
        actor = self.first_actor(policy_key)
        return TrainState(
            key=key,
            update=jnp.zeros((), jnp.int32),
            actor=actor,
            opt_state=self.optimizer.init(actor.params),
            estimator_state=self.estimator.init(estimator_key, self.size),
            start_key=start_key,
        )

    def step(
        self, rollout: Callable[..., Trajectory], state: TrainState, active: Any = True
    ) -> tuple[TrainState, Metrics]:
        key, episodes_key, update_key = jax.random.split(state.key, 3)
        trajectory = rollout(
            self.env if state.start_key is None else _OneStart(self.env, state.start_key),
            self.act,
            state.actor,
            self.policy.distribution,
            episodes_key,
            num_episodes=self.num_episodes,
            horizon=self.horizon,
            active=active,
        )
        learned, metrics = self._learn(state, trajectory, update_key)
        known = state.actor, state.opt_state, state.estimator_state
        (actor, opt_state, estimator_state), skipped = keep_finite(learned, known)
        proposed = dataclasses.replace(
            state,
            key=key,
            update=state.update + 1,
            actor=actor,
            opt_state=opt_state,
            estimator_state=estimator_state,
        )
        if active is not True:
            proposed = jax.tree.map(lambda new, old: jnp.where(active, new, old), proposed, state)
        return proposed, episode_metrics(trajectory) | metrics | {"skipped_update": skipped}

    def _learn(
        self, state: TrainState, trajectory: Trajectory, key: jax.Array
    ) -> tuple[tuple[Actor, Any, Any], Metrics]:
        """Returns the actor, optimiser state and estimator state that the episodes lead to."""
        actor, mask = state.actor, trajectory.mask
        scaled = normalize.apply(actor.normalizer, trajectory.observation)
        seen = dataclasses.replace(trajectory, observation=scaled)
        weight, estimator_state, metrics = self.estimator.update(state.estimator_state, seen)
        problem = Problem(
            surrogate=_surrogate(self.policy, self.entropy_cost),
            optimizer=self.optimizer,
            samples=(scaled, trajectory.action, weight, mask),
            divisor=jnp.maximum(jnp.sum(mask), 1) if self.per_step else self.num_episodes,
        )
        params, opt_state, spent = self.update(problem, key, actor.params, state.opt_state)
        normalizer = normalize.update(
            actor.normalizer, trajectory.observation, mask, self.normalize_steps
        )
        actor = Actor(params=params, normalizer=normalizer)
        return (actor, opt_state, estimator_state), metrics | spent


class _OneStart:
    """An environment whose every episode starts with the same key."""

    def __init__(self, env: Environment, key: jax.Array):
        self._env, self._key = env, key

    def reset(self, rng: jax.Array) -> Any:
        del rng
        return self._env.reset(self._key)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._env, name)


def _surrogate(policy: Policy, entropy_cost: float | jax.Array) -> Callable[..., Any]:
    """Returns the sum over samples whose gradient is followed, and the entropy's sum."""

    def surrogate(params, chunk):
        observation, action, weight, mask = chunk
        outputs = policy.apply(params, observation)
        entropy = policy.distribution.entropy(outputs)
        terms = policy.distribution.log_prob(outputs, action) * weight + entropy_cost * entropy
        loss = -jnp.sum(jnp.where(mask, terms, 0.0))
        return loss, {"entropy": jnp.sum(jnp.where(mask, entropy, 0.0))}

    return surrogate


def _train_step(learner: Learner, state: TrainState) -> tuple[TrainState, Metrics]:
    """Plays N episodes and makes one update, compiled.

    Nothing is donated: ``state`` stays usable. For many seeds,
    ``jax.vmap(functools.partial(train_step, learner))(states)``.

    Args:
      learner: from ``reinforce``; another learner compiles anew.
      state: from ``learner.init`` or the step before.

    Returns:
      The next state, and metrics, each []: ``episode_return`` (mean over the N
      episodes; with ``_min`` and ``_max``), ``episode_length``, ``env_steps``
      (played in this update), ``simulated_steps`` (with those in which an
      episode was over already), ``entropy``, ``gradient_norm``,
      ``nonfinite_episodes``, ``skipped_update`` (1 where the proposed state was
      not finite and the old one was kept), and the estimator's own.
    """
    return learner.step(state)


train_step = jax.jit(_train_step, static_argnums=0)


def check_horizon(env: Environment, horizon: int | None) -> int:
    """Returns the time limit in steps, or raises ValueError."""
    horizon = getattr(env, "max_episode_steps", None) if horizon is None else horizon
    if horizon is None:
        raise ValueError("this environment declares no max_episode_steps: pass horizon=...")
    if horizon < 1:
        raise ValueError(f"the horizon must be at least one step, got {horizon}")
    return horizon


def keep_finite(learned: Any, known: Any) -> tuple[Any, jax.Array]:
    """Returns what was learned if all of it is finite, else what was known, and 1 in that case.

    A broken update must cost one seed one update, not the seed, and nothing else.
    """
    leaves = [x for x in jax.tree.leaves(learned) if jnp.issubdtype(x.dtype, jnp.floating)]
    finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(x)) for x in leaves]))
    kept = jax.tree.map(lambda new, old: jnp.where(finite, new, old), learned, known)
    return kept, jnp.where(finite, 0, 1)


def episode_metrics(trajectory: Trajectory) -> Metrics:
    """Returns what a person wants to know of the episodes."""
    returns, lengths = episode_returns(trajectory), episode_lengths(trajectory)
    return {
        "episode_return": jnp.mean(returns),
        "episode_return_min": jnp.min(returns),
        "episode_return_max": jnp.max(returns),
        "episode_length": jnp.mean(lengths),
        "env_steps": jnp.sum(lengths),
        "simulated_steps": simulated_steps(trajectory),
        "nonfinite_episodes": jnp.sum(trajectory.nonfinite),
    }
