"""REINFORCE as a pair of pure functions, ``init`` and ``step``, over one state pytree."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import struct

from mjx_reinforce import engines, normalize
from mjx_reinforce.distributions import normal
from mjx_reinforce.estimators import Estimator, leave_one_out, standardize
from mjx_reinforce.gradients import accumulate_gradient
from mjx_reinforce.policies import Policy, mlp_policy
from mjx_reinforce.rollouts import episode_lengths, episode_returns, simulated_steps
from mjx_reinforce.types import Environment, Trajectory, action_space, observation_size

Metrics = dict[str, jax.Array]


@struct.dataclass(kw_only=True)
class Actor:
    """All that playing needs.

    params: the policy's parameters
    normalizer: the statistics that scale its observations
    """

    params: Any
    normalizer: normalize.Normalizer


@struct.dataclass(kw_only=True)
class TrainState:
    """All that the next update needs; no environment state is among it.

    key: [] the seed's own random key, split by every update
    update: [] how many updates were made
    actor: the policy's parameters and the observation statistics
    opt_state: the optimiser's state
    estimator_state: the estimator's, such as a critic
    """

    key: jax.Array
    update: jax.Array
    actor: Actor
    opt_state: Any
    estimator_state: Any


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


def default_optimizer(
    learning_rate: Any = 1e-2, max_grad_norm: float | jax.Array = 1.0
) -> optax.GradientTransformation:
    """Adam on the gradient scaled down to a norm of at most ``max_grad_norm``.

    Args:
      learning_rate: a number or an optax schedule over updates.
      max_grad_norm: bound of the Euclidean norm of the whole gradient.
    """
    return optax.chain(optax.clip_by_global_norm(max_grad_norm), optax.adam(learning_rate))


def reinforce(
    env: Environment,
    *,
    policy: Policy | None = None,
    estimator: Estimator | None = None,
    optimizer: optax.GradientTransformation | None = None,
    num_episodes: int = 16,
    horizon: int | None = None,
    entropy_cost: float | jax.Array = 0.0,
    loss_per: str = "episode",
    normalize_steps: int = 1000,
    engine: str = "auto",
) -> Learner:
    """Builds REINFORCE (Williams 1992) for an environment.

    One update plays N complete episodes and follows the gradient of

        (1/N) sum_n sum_t weight[t, n] log pi(a[t, n] | o[t, n]) + entropy_cost H[t, n]

    Numbers such as ``entropy_cost``, the estimator's discount and the optimiser's
    learning rate may be traced: build the learner inside a function to vmap over them.

    Args:
      env: what is played; any brax-style environment.
      policy: by default an MLP of 32 and 32 tanh units with a Normal.
      estimator: by default leave-one-out on the return to go (discount 0.99),
        divided by its standard deviation plus 10.
      optimizer: by default Adam at 1e-2 with the gradient's norm clipped at 1.
      num_episodes: N, episodes an update.
      horizon: T, steps after which an episode ends; by default the environment's
        ``max_episode_steps``.
      entropy_cost: weight of the policy's entropy H, in return per nat.
      loss_per: "episode" divides the sum by N, as the formula says; "step" by the
        number of steps played, which makes the step shrink as episodes grow.
      normalize_steps: observations are scaled by the mean and standard deviation
        of about the first so many steps, then the scale stands still: one that
        follows a policy which learns to keep near the middle drives up its gain
        until it fails. 0 leaves them as they are. Each update uses the statistics
        that its episodes were played with.
      engine: how episodes are played: "auto", "mjx", "fused" or "kernel", see ``engines``.

    Returns:
      The learner: ``init(key)`` makes a state, ``train_step(learner, state)`` moves it on.

    Raises:
      ValueError: an argument makes no sense for this environment.
    """
    horizon = check_horizon(env, horizon)
    size = observation_size(env)
    if policy is None:
        policy = mlp_policy(size, normal(action_space(env)))
    estimator = standardize(leave_one_out(), floor=10.0) if estimator is None else estimator
    optimizer = default_optimizer() if optimizer is None else optimizer
    if num_episodes < estimator.min_episodes:
        raise ValueError(
            f"this estimator needs at least {estimator.min_episodes} episodes an update, "
            f"got num_episodes={num_episodes}"
        )
    if loss_per not in ("episode", "step"):
        raise ValueError(f"loss_per must be 'episode' or 'step', got {loss_per!r}")
    surrogate = _surrogate(policy, entropy_cost)

    def act(actor, observation):
        return policy.apply(actor.params, normalize.apply(actor.normalizer, observation))

    def first_actor(key):
        return Actor(params=policy.init(key), normalizer=normalize.init(size))

    def init(key):
        policy_key, estimator_key, key = jax.random.split(key, 3)
        actor = first_actor(policy_key)
        return TrainState(
            key=key,
            update=jnp.zeros((), jnp.int32),
            actor=actor,
            opt_state=optimizer.init(actor.params),
            estimator_state=estimator.init(estimator_key, size),
        )

    shapes = jax.eval_shape(first_actor, jax.random.key(0))
    player = engines.Player(act, shapes, policy.distribution)
    chosen = engines.choose(engine, env, player)

    def play(actor, key, active):
        return chosen.rollout(
            env,
            act,
            actor,
            policy.distribution,
            key,
            num_episodes=num_episodes,
            horizon=horizon,
            active=active,
        )

    def learn(state, trajectory):
        """Returns the actor, optimiser state and estimator state that the episodes lead to."""
        actor, mask = state.actor, trajectory.mask
        scaled = normalize.apply(actor.normalizer, trajectory.observation)
        seen = dataclasses.replace(trajectory, observation=scaled)
        weight, estimator_state, metrics = estimator.update(state.estimator_state, seen)
        data = (scaled, trajectory.action, weight, mask)
        _, grads, sums = accumulate_gradient(surrogate, actor.params, data)
        steps = jnp.maximum(jnp.sum(mask), 1)
        divisor = num_episodes if loss_per == "episode" else steps
        grads = jax.tree.map(lambda g: g / divisor, grads)
        updates, opt_state = optimizer.update(grads, state.opt_state, actor.params)
        params = optax.apply_updates(actor.params, updates)
        normalizer = normalize.update(
            actor.normalizer, trajectory.observation, mask, normalize_steps
        )
        metrics |= {"entropy": sums["entropy"] / steps, "gradient_norm": optax.tree.norm(grads)}
        return (Actor(params=params, normalizer=normalizer), opt_state, estimator_state), metrics

    def step(state, active=True):
        key, episodes_key = jax.random.split(state.key)
        trajectory = play(state.actor, episodes_key, active)
        learned, metrics = learn(state, trajectory)
        known = state.actor, state.opt_state, state.estimator_state
        (actor, opt_state, estimator_state), skipped = keep_finite(learned, known)
        proposed = TrainState(
            key=key,
            update=state.update + 1,
            actor=actor,
            opt_state=opt_state,
            estimator_state=estimator_state,
        )
        if active is not True:
            proposed = jax.tree.map(lambda new, old: jnp.where(active, new, old), proposed, state)
        return proposed, episode_metrics(trajectory) | metrics | {"skipped_update": skipped}

    return Learner(init, step, act, policy, chosen)


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
