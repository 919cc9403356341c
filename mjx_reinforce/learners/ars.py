"""Augmented random search (Mania, Guy and Recht 2018, arXiv:1803.07055), algorithms 1 and 2.

A direction delta is tried forwards and backwards by two deterministic policies of their own, and
the parameters move along the directions that made a difference:

    theta += step_size / (b sigma) * sum over the b best of (r_plus - r_minus) delta,

with sigma the standard deviation of those 2 b returns. No gradient of the policy is taken. The
learner has the same two functions as ``reinforce``, so whatever drives one drives the other.
"""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import optax

from mjx_reinforce.engines import choice as engines
from mjx_reinforce.engines.rollouts import episode_returns
from mjx_reinforce.learners.learner import (
    Actor,
    Learner,
    TrainState,
    check_horizon,
    episode_metrics,
    keep_finite,
)
from mjx_reinforce.policies import normalize
from mjx_reinforce.policies.distribution import categorical
from mjx_reinforce.policies.normal import deterministic
from mjx_reinforce.policies.policy import Policy, mlp_policy
from mjx_reinforce.types import (
    Discrete,
    Environment,
    Trajectory,
    action_space,
    observation_size,
)


def ars(
    env: Environment,
    *,
    policy: Policy | None = None,
    num_directions: int = 8,
    top_directions: int | None = None,
    step_size: float | jax.Array = 0.02,
    noise_std: float | jax.Array = 0.03,
    horizon: int | None = None,
    normalize_steps: float = math.inf,
    shared_starts: bool = False,
    update: str = "paper",
    engine: str = "auto",
) -> Learner:
    """Builds augmented random search for an environment.

    Args:
      env: what is played; any brax-style environment.
      policy: whose mode plays; by default linear and zero. All its params are
        searched, so it should have none that the mode does not read.
      num_directions: directions tried in an update, by two episodes each.
      top_directions: b, how many of them count, those with the greatest of their
        two returns (V1-t, V2-t); by default all (V1, V2).
      step_size: alpha.
      noise_std: nu, how far along a direction the policies are.
      horizon: T, steps after which an episode ends; by default the environment's
        ``max_episode_steps``.
      normalize_steps: observations are scaled by the mean and standard deviation
        of about the first so many steps; inf is V2, 0 is V1.
      shared_starts: the two episodes of a direction start alike; each starts for
        itself in the paper.
      update: "paper", or "document" for that of a published notebook, see
        ``_document_increment``.
      engine: "auto", "mjx" or "fused", see ``engines``.

    Returns:
      The learner. Where sigma is zero the parameters stay.

    Raises:
      ValueError: an argument makes no sense.
    """
    horizon = check_horizon(env, horizon)
    size = observation_size(env)
    top = num_directions if top_directions is None else top_directions
    _check(num_directions, top, step_size, noise_std, update)
    policy = _zero_policy(env, size) if policy is None else policy
    tie = _bias_overwriter(policy) if update == "document" else lambda params: params
    chosen = engines.choose(engine, env)
    play = _both_ways(env, policy, chosen, num_directions, horizon)

    def act(actor, observation):
        return policy.apply(actor.params, normalize.apply(actor.normalizer, observation))

    def init(key):
        policy_key, key = jax.random.split(key)
        return TrainState(
            key=key,
            update=jnp.zeros((), jnp.int32),
            actor=Actor(params=policy.init(policy_key), normalizer=normalize.init(size)),
            opt_state=(),
            estimator_state=(),
        )

    def perturb(params, directions):
        """Returns the params of all policies, [2, D, ...], the forward ones first."""
        moves = jax.tree.map(lambda d: jnp.stack([noise_std * d, -noise_std * d]), directions)
        return jax.vmap(jax.vmap(tie))(jax.tree.map(jnp.add, params, moves))

    def step(state, active=True):
        actor = state.actor
        key, directions_key, episodes_key = jax.random.split(state.key, 3)
        keys = jax.random.split(episodes_key)
        keys = keys[jnp.array([0, 0])] if shared_starts else keys
        directions = _draw(directions_key, actor.params, num_directions)
        trajectory = play(perturb(actor.params, directions), actor.normalizer, keys, active)
        returns = episode_returns(trajectory).reshape(2, num_directions)
        if update == "paper":
            increment = _paper_increment(directions, returns, top)
        else:
            increment = _document_increment(directions, returns, noise_std)
        params = tie(jax.tree.map(lambda p, d: p + step_size * d, actor.params, increment))
        normalizer = normalize.update(
            actor.normalizer, trajectory.observation, trajectory.mask, normalize_steps
        )
        learned, skipped = keep_finite(Actor(params=params, normalizer=normalizer), actor)
        proposed = state.replace(key=key, update=state.update + 1, actor=learned)
        if active is not True:
            proposed = jax.tree.map(lambda new, old: jnp.where(active, new, old), proposed, state)
        return proposed, episode_metrics(trajectory) | {
            "entropy": jnp.zeros(()),
            "gradient_norm": optax.tree.norm(increment),
            "return_std": jnp.std(returns),
            "skipped_update": skipped,
        }

    return Learner(init, step, act, policy, chosen)


def _both_ways(
    env: Environment, policy: Policy, chosen: engines.Engine, num_directions: int, horizon: int
) -> Callable[..., Trajectory]:
    """Returns what plays 2 D policies, an episode each: (params, normalizer, keys, active) -> ...

    The params are [2, D, ...], the keys [2], and of the N = 2 D episodes the first D are those of
    the first D policies.
    """

    def act_each(actor, observation):
        scaled = normalize.apply(actor.normalizer, observation)
        return jax.vmap(policy.apply)(actor.params, scaled)

    def play(params, normalizer, keys, active):
        def one_way(params, key):
            return chosen.rollout(
                env,
                act_each,
                Actor(params=params, normalizer=normalizer),
                policy.distribution,
                key,
                num_episodes=num_directions,
                num_deterministic=num_directions,
                horizon=horizon,
                active=active,
            )

        return _side_by_side(jax.vmap(one_way)(params, keys))

    return play


def _paper_increment(directions: Any, returns: jax.Array, top: int) -> Any:
    """Returns the sum in the module's formula over b sigma; zero where sigma is.

    Args:
      directions: like the params, with a leading axis [D].
      returns: [2, D] forwards and backwards.
      top: b.
    """
    best = jnp.argsort(-jnp.max(returns, axis=0))[:top]
    gain = _over_std(returns[0, best] - returns[1, best], returns[:, best]) / top
    return jax.tree.map(lambda d: _weighted_sum(gain, d[best]), directions)


def _document_increment(directions: Any, returns: jax.Array, noise_std: Any) -> Any:
    """Returns the increment of a published notebook, mistakes included, for reproducing it.

    Its ``np.sum`` without an axis adds up the entries of the direction too, so all parameters move
    by the same number; it does not divide by how many directions there are, and multiplies by
    ``noise_std``. The bias is overwritten besides, see ``_bias_overwriter``. Not reproduced: where
    all returns are equal it divides 0 by 0, and its parameters are NaN for good.
    """
    totals = sum(jnp.sum(d.reshape(len(d), -1), axis=1) for d in jax.tree.leaves(directions))
    increment = noise_std * jnp.sum(_over_std(returns[0] - returns[1], returns) * totals)
    return jax.tree.map(lambda d: jnp.full(d.shape[1:], increment, d.dtype), directions)


def _bias_overwriter(policy: Policy) -> Callable[[Any], Any]:
    """Returns what overwrites a linear policy's bias [A] with its first A weights.

    The notebook writes the same first entries of its flat vector into every parameter.

    Raises:
      ValueError: the policy is not linear.
    """
    params = jax.eval_shape(policy.init, jax.random.key(0))
    if set(params) != {"network", "constants"} or set(params["network"]["params"]) != {"Dense_0"}:
        raise ValueError("update='document' is for linear policies: pass one with hidden_sizes=()")

    def overwrite(params):
        layer = params["network"]["params"]["Dense_0"]
        # PyTorch stores weights as [A, O], flax as [O, A].
        bias = layer["kernel"].T.reshape(-1)[: layer["bias"].size]
        return params | {"network": {"params": {"Dense_0": layer | {"bias": bias}}}}

    return overwrite


def _over_std(x: jax.Array, returns: jax.Array) -> jax.Array:
    """Returns ``x`` over the standard deviation of all returns, 0 if they are all equal."""
    std = jnp.std(returns)
    return jnp.where(std > 0, x / jnp.where(std > 0, std, 1.0), 0.0)


def _weighted_sum(weight: jax.Array, x: jax.Array) -> jax.Array:
    """Returns the sum over the first axis of ``x`` [D, ...] times ``weight`` [D]."""
    return jnp.sum(weight.reshape(-1, *(1,) * (x.ndim - 1)) * x, axis=0)


def _draw(key: jax.Array, params: Any, num_directions: int) -> Any:
    """Returns standard Normal directions, like the params with a leading axis [D]."""
    leaves, tree = jax.tree.flatten(params)
    keys = jax.random.split(key, len(leaves))
    drawn = [
        jax.random.normal(k, (num_directions, *x.shape), x.dtype)
        for k, x in zip(keys, leaves, strict=True)
    ]
    return jax.tree.unflatten(tree, drawn)


def _side_by_side(trajectory: Trajectory) -> Trajectory:
    """Returns [T, 2 D, ...] from two rollouts stacked [2, T, D, ...]."""

    def join(x):
        joined = jnp.moveaxis(x, 0, 1)
        return joined.reshape(joined.shape[0], -1, *joined.shape[3:])

    return Trajectory(
        observation=join(trajectory.observation),
        action=join(trajectory.action),
        reward=join(trajectory.reward),
        mask=join(trajectory.mask),
        nonfinite=trajectory.nonfinite.reshape(-1),
    )


def _zero_policy(env: Environment, size: int) -> Policy:
    """A linear policy that starts at zero, as the paper's do."""
    space = action_space(env)
    family = categorical if isinstance(space, Discrete) else deterministic
    policy = mlp_policy(size, family(space), ())

    def init(key):
        return jax.tree.map(jnp.zeros_like, policy.init(key))

    return policy._replace(init=init)


def _check(num_directions: int, top: int, step_size: Any, noise_std: Any, update: str) -> None:
    """Raises ValueError for numbers that make no sense; traced ones are taken on trust."""
    if num_directions < 1:
        raise ValueError(f"num_directions must be at least 1, got {num_directions}")
    if not 1 <= top <= num_directions:
        raise ValueError(f"top_directions must lie in [1, {num_directions}], got {top}")
    for name, value in (("step_size", step_size), ("noise_std", noise_std)):
        if not (isinstance(value, jax.core.Tracer) or float(value) > 0):
            raise ValueError(f"{name} must be positive, got {value}")
    if update not in ("paper", "document"):
        raise ValueError(f"update must be 'paper' or 'document', got {update!r}")
    if update == "document" and top != num_directions:
        raise ValueError("update='document' uses all directions: leave top_directions out")
