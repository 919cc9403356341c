"""Augmented random search (Mania, Guy and Recht 2018, arXiv:1803.07055), algorithms 1 and 2.

A direction delta is tried forwards and backwards by two deterministic policies of their own, and
the parameters move along the directions that made a difference:

    theta += step_size / (b sigma) * sum over the b best of (r_plus - r_minus) delta,

with sigma the standard deviation of those 2 b returns. An episode in which the simulation left the
finite numbers counts as the worst of the others; where all did, nothing is learned. No gradient of
the policy is taken. The learner has the same functions as that of ``reinforce``, so whatever drives
one drives the other.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from optax import Params

from mjx_reinforce.engine.base import (
    Discrete,
    Environment,
    Trajectory,
    action_space,
    observation_size,
)
from mjx_reinforce.engine.checks import check_count, check_key, check_number
from mjx_reinforce.engine.contract import check_environment
from mjx_reinforce.engine.play import choice
from mjx_reinforce.engine.play.rollouts import episode_returns
from mjx_reinforce.learning import contract, diagnostics, learner, normalize
from mjx_reinforce.learning.distributions import categorical, deterministic
from mjx_reinforce.learning.estimators import replace_broken
from mjx_reinforce.learning.learner import Learner, Metrics, TrainState
from mjx_reinforce.learning.policy import Actor, Policy, act, mlp_policy
from mjx_reinforce.learning.updates import signal_to_noise

#: (directions, like the params with a leading axis [D]; returns [2, D] forwards and backwards;
#: noise_std) -> what the parameters move by, over the step size.
Increment = Callable[[Any, jax.Array, Any], Any]


class Trial(NamedTuple):
    """What is tried for one update.

    directions: like the params, with a leading axis [D]
    trajectory: 2 D episodes, an episode a policy; the forward ones first
    """

    directions: Any
    trajectory: Trajectory


def ars(
    env: Environment,
    *,
    policy: Policy | None = None,
    num_directions: int = 8,
    top_directions: int | None = None,
    step_size: float | jax.Array = 0.02,
    noise_std: float | jax.Array = 0.03,
    increment: Increment | None = None,
    horizon: int | None = None,
    normalize_steps: float = math.inf,
    normalize_min_std: float | jax.Array = 0.0,
    engine: str = "auto",
) -> Learner:
    """Builds augmented random search for an environment.

    Args:
      env: what is played; any brax-style environment.
      policy: whose mode plays; by default linear and zero. All its params are searched, so it
        should have none that the mode does not read.
      num_directions: D, directions tried in an update, by two episodes each.
      top_directions: b, how many of them count, those with the greatest of their two returns
        (V1-t, V2-t); by default all (V1, V2).
      step_size: alpha.
      noise_std: nu, how far along a direction the policies are.
      increment: in place of the paper's sum over the b best.
      horizon: T, steps after which an episode ends; by default ``env.max_episode_steps``.
      normalize_steps: scale observations by the mean and std of about the first so many steps;
        inf is V2, 0 is V1.
      normalize_min_std: the least that an observation is divided by, in its own unit.
      engine: "auto" or "vmap", see ``engine.play.choice``.

    Returns:
      The learner. Where sigma is zero the parameters stay.

    Raises:
      ValueError: an argument makes no sense.

    Examples:
      >>> import jax
      >>> import mjx_reinforce as mr
      >>> env = mr.envs.make("ContinuousCartPole-v0")
      >>> learner = mr.ars(env, num_directions=2, horizon=20)
      >>> state, metrics = mr.train_step(learner, learner.init(jax.random.key(0)))
      >>> metrics["episodes"].item()  # two a direction
      4
    """
    check_environment(env)
    horizon = contract.check_horizon(env, horizon)
    check_count("num_directions", num_directions)
    top = num_directions if top_directions is None else top_directions
    check_count("top_directions", top)
    if top > num_directions:
        raise ValueError(f"top_directions must lie in [1, {num_directions}], got {top}")
    check_number("step_size", step_size, positive=True)
    check_number("noise_std", noise_std, positive=True)
    check_number("normalize_steps", normalize_steps, finite=False)
    check_number("normalize_min_std", normalize_min_std)
    size = observation_size(env)
    policy = _zero_policy(env, size) if policy is None else policy
    contract.check_policy(policy, env, size)
    plays = choice.choose(engine, env)

    make_step = functools.partial(_of_the_best, top) if increment is None else increment

    def init(key: jax.Array) -> TrainState:
        check_key(key)
        policy_key, key = jax.random.split(key)
        return TrainState(key=key, actor=learner.first_actor(policy, size, policy_key))

    play = _play(env, policy, plays, num_directions, noise_std, horizon)
    learn = _learn(make_step, step_size, noise_std, (normalize_steps, normalize_min_std))
    return Learner(init, play, learn, policy, plays)


def _play(
    env: Environment,
    policy: Policy,
    plays: choice.Engine,
    num_directions: int,
    noise_std: float | jax.Array,
    horizon: int,
) -> Callable[..., Trial]:
    """Returns ``Learner.play``."""

    def play(state: TrainState, key: jax.Array, active: bool | jax.Array = True) -> Trial:
        directions_key, episodes_key = jax.random.split(key)
        directions = _draw_directions(directions_key, state.actor.params, num_directions)
        moves = jax.tree.map(lambda d: jnp.stack([noise_std * d, -noise_std * d]), directions)

        def one_way(params: Params, key: jax.Array) -> Trajectory:
            return plays.rollout(
                env,
                functools.partial(_act_each, policy),
                state.actor.replace(params=params),
                policy.distribution,
                key,
                num_episodes=num_directions,
                deterministic=True,
                horizon=horizon,
                active=active,
            )

        params = jax.tree.map(jnp.add, state.actor.params, moves)
        played = jax.vmap(one_way)(params, jax.random.split(episodes_key))
        return Trial(directions, _join_rollouts(played))

    return play


def _learn(
    increment: Increment,
    step_size: float | jax.Array,
    noise_std: float | jax.Array,
    normalize_limits: tuple[float, float | jax.Array],
) -> Callable[[TrainState, Trial, jax.Array], tuple[TrainState, Metrics]]:
    """Returns ``Learner.learn``."""

    def learn(state: TrainState, trial: Trial, key: jax.Array) -> tuple[TrainState, Metrics]:
        del key
        actor, played = state.actor, trial.trajectory
        returns = replace_broken(episode_returns(played), played.nonfinite).reshape(2, -1)
        step = increment(trial.directions, returns, noise_std)
        params = jax.tree.map(lambda p, d: p + step_size * d, actor.params, step)
        normalizer = normalize.count(actor.normalizer, played, *normalize_limits)
        kept, skipped = learner.keep_finite(Actor(params=params, normalizer=normalizer), actor)
        measured = {
            "entropy": jnp.zeros(()),
            "gradient_norm": optax.tree.norm(step),
            "return_std": jnp.std(returns),
        }
        if returns.shape[1] > 1:
            measured["gradient_snr"] = _step_signal_to_noise(trial.directions, returns)
        sound = (skipped == 0) & ~jnp.any(played.nonfinite)
        metrics = learner.episode_metrics(played) | diagnostics.nan_unless(sound, measured)
        return dataclasses.replace(state, actor=kept), metrics | {"skipped_update": skipped}

    return learn


def _of_the_best(top: int, directions: Params, returns: jax.Array, noise_std: Any) -> Any:
    """Returns the sum in the module's formula over b sigma; zero where sigma is."""
    del noise_std
    best = jnp.argsort(-jnp.max(returns, axis=0))[:top]
    gain = over_std(returns[0, best] - returns[1, best], returns[:, best]) / top
    return jax.tree.map(
        lambda d: jnp.sum(gain.reshape(-1, *(1,) * (d.ndim - 1)) * d[best], axis=0), directions
    )


def over_std(x: jax.Array, returns: jax.Array) -> jax.Array:
    """Returns ``x`` over the standard deviation of all returns, 0 if they are all equal."""
    std = jnp.std(returns)
    return jnp.where(std > 0, x / jnp.where(std > 0, std, 1.0), 0.0)


def _act_each(policy: Policy, actor: Actor, observation: jax.Array) -> jax.Array:
    """Returns the outputs [D, K] of D policies for an observation [D, O] of each."""
    return jax.vmap(lambda params, seen: act(policy, actor.replace(params=params), seen))(
        actor.params, observation
    )


def _draw_directions(key: jax.Array, params: Params, num_directions: int) -> Any:
    """Returns standard Normal directions, like the params with a leading axis [D]."""
    leaves, tree = jax.tree.flatten(params)
    keys = jax.random.split(key, len(leaves))
    drawn = [
        jax.random.normal(k, (num_directions, *x.shape), x.dtype)
        for k, x in zip(keys, leaves, strict=True)
    ]
    return jax.tree.unflatten(tree, drawn)


def _step_signal_to_noise(directions: Params, returns: jax.Array) -> jax.Array:
    """Returns the signal-to-noise ratio [] over all directions [D] of the mean step.

    See ``signal_to_noise``; a direction's share is (r_plus - r_minus) delta. Where only
    the best directions count, the step is another, of which nothing is said.
    """
    difference = returns[0] - returns[1]
    each = jax.vmap(lambda r, delta: jax.tree.map(lambda x: r * x, delta))(difference, directions)
    mean = jax.tree.map(lambda x: jnp.mean(x, axis=0), each)
    return signal_to_noise(mean, each, len(difference))


def _join_rollouts(played: Trajectory) -> Trajectory:
    """Returns [T, 2 D, ...] from two rollouts stacked [2, T, D, ...]."""

    def join(x: jax.Array) -> jax.Array:
        joined = jnp.moveaxis(x, 0, 1)
        return joined.reshape(joined.shape[0], -1, *joined.shape[3:])

    return played.replace(
        observation=join(played.observation),
        action=join(played.action),
        reward=join(played.reward),
        mask=join(played.mask),
        nonfinite=played.nonfinite.reshape(-1),
        simulated=jnp.sum(played.simulated),
    )


def _zero_policy(env: Environment, size: int) -> Policy:
    """A linear policy that starts at zero, as the paper's do."""
    space = action_space(env)
    family = categorical if isinstance(space, Discrete) else deterministic
    policy = mlp_policy(size, family(space), ())
    return policy._replace(init=lambda key: jax.tree.map(jnp.zeros_like, policy.init(key)))
