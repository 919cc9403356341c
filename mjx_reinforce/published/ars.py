"""Augmented random search (Mania, Guy and Recht 2018, arXiv:1803.07055), algorithms 1 and 2.

A direction delta is tried forwards and backwards by two deterministic policies of their own, and
the parameters move along the D directions that made a difference:

    theta += step_size / (D sigma) * sum of (r_plus - r_minus) delta,

with sigma the standard deviation of those 2 D returns. An episode in which the simulation left the
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

import mjx_reinforce as mr
from mjx_reinforce.engine import base, choose
from mjx_reinforce.engine.checks import check_count, check_key, check_number
from mjx_reinforce.engine.contract import check_environment
from mjx_reinforce.engine.devices import bytes_of, check_room
from mjx_reinforce.engine.play.choice import Engine
from mjx_reinforce.engine.play.rollouts import episode_returns
from mjx_reinforce.learning import contract, normalize
from mjx_reinforce.learning.estimators import replace_broken
from mjx_reinforce.learning.learner import Metrics, first_actor, keep_finite, update_metrics
from mjx_reinforce.learning.policy import within_bounds

#: (directions, like the params with a leading axis [D]; returns [2, D] forwards and backwards;
#: noise_std) -> what the parameters move by, over the step size.
Increment = Callable[[Any, jax.Array, Any], Any]


class Trial(NamedTuple):
    """What is tried for one update.

    directions: like the params, with a leading axis [D]
    trajectory: 2 D episodes, an episode a policy; the forward ones first
    """

    directions: Any
    trajectory: mr.Trajectory


def ars(
    env: mr.Environment,
    *,
    policy: mr.Policy | None = None,
    num_directions: int = 8,
    step_size: float | jax.Array = 0.02,
    noise_std: float | jax.Array = 0.03,
    increment: Increment | None = None,
    horizon: int | None = None,
    normalize_steps: float = math.inf,
    normalize_min_std: float | jax.Array = 0.0,
    engine: str = "auto",
) -> mr.Learner:
    """Builds augmented random search for an environment.

    Args:
      env: what is played; any brax-style environment.
      policy: whose mode plays; by default linear and zero. All its params are searched, so it
        should have none that the mode does not read.
      num_directions: D, directions tried in an update, by two episodes each.
      step_size: alpha.
      noise_std: nu, how far along a direction the policies are.
      increment: in place of the paper's sum.
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
    check_count("num_directions", num_directions)
    check_number("step_size", step_size, positive=True)
    check_number("noise_std", noise_std, positive=True)
    check_number("normalize_steps", normalize_steps, finite=False)
    check_number("normalize_min_std", normalize_min_std)
    if policy is None:
        policy = _zero_policy(env)
    size = base.observation_size(env)
    contract.check_policy(policy, env, size)
    # The parameters, and what they become.
    actor_shapes = jax.eval_shape(functools.partial(first_actor, policy, size), jax.random.key(0))
    check_room(2 * bytes_of(actor_shapes))
    horizon = contract.check_horizon(env, horizon)
    contract.check_num_steps(2 * num_directions, horizon)
    search = _Search(
        env=env,
        policy=policy,
        num_directions=num_directions,
        step_size=step_size,
        noise_std=noise_std,
        increment=mean_difference if increment is None else increment,
        horizon=horizon,
        normalize_steps=normalize_steps,
        normalize_min_std=normalize_min_std,
        engine=choose(engine, env),
    )
    # The search plays what the policy puts out; whoever plays the learner's policy stays in bounds.
    clipped_policy = within_bounds(policy, base.action_space(env))
    return mr.Learner(search.init, search.play, search.learn, clipped_policy, search.engine)


def make(env: mr.Environment, config: Any, **shared: Any) -> mr.Learner:
    """Returns the learner of ``--algorithm ars``, with the numbers of ``ars``.

    Args:
      env: what it learns on.
      config: the settings; it reads none.
      shared: the policy, the horizon and more, as ``ars`` takes them.
    """
    del config
    return ars(env, **shared)


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class _Search:
    """The functions of a learner; the fields are arguments of ``ars``, checked."""

    env: mr.Environment
    policy: mr.Policy
    num_directions: int
    step_size: float | jax.Array
    noise_std: float | jax.Array
    increment: Increment
    horizon: int
    normalize_steps: float
    normalize_min_std: float | jax.Array
    engine: Engine

    def init(self, key: jax.Array) -> mr.TrainState:
        """``Learner.init``."""
        check_key(key)
        policy_key, key = jax.random.split(key)
        observation_size = base.observation_size(self.env)
        return mr.TrainState(key=key, actor=first_actor(self.policy, observation_size, policy_key))

    def play(self, state: mr.TrainState, key: jax.Array, active: bool | jax.Array = True) -> Trial:
        """``Learner.play``: draws the directions, and plays an episode each way along each."""
        directions_key, episodes_key = jax.random.split(key)
        # theta once for each direction, [D, ...], and a standard normal delta of that shape.
        params_copies = jax.tree.map(
            lambda p: jnp.broadcast_to(p, (self.num_directions, *p.shape)), state.actor.params
        )
        directions = optax.tree.random_like(directions_key, params_copies)
        # theta + nu delta and theta - nu delta, [2, D, ...].
        params_moves = jax.tree.map(lambda d: self.noise_std * d, directions)
        params_both_ways = jax.tree.map(
            lambda p, d: jnp.stack([p + d, p - d]), params_copies, params_moves
        )

        def play_one_way(params: Any, key: jax.Array) -> mr.Trajectory:
            """Returns [T, D] of D policies, an episode each, by their modes."""
            return self.engine.rollout(
                self.env,
                self._act_each,
                state.actor.replace(params=params),
                self.policy.distribution,
                key,
                num_episodes=self.num_directions,
                deterministic=True,
                horizon=self.horizon,
                active=active,
            )

        # The two ways have keys of their own, so that their episodes start apart.
        keys = jax.random.split(episodes_key)
        return Trial(directions, _join(jax.vmap(play_one_way)(params_both_ways, keys)))

    def _act_each(self, actor: mr.Actor, observation: jax.Array) -> jax.Array:
        """Returns the outputs [D, K] of D policies for an observation [D, O] of each."""
        # Each policy has its own params, axis 0; all share one normalizer.
        axes = actor.replace(params=0, normalizer=None)
        return jax.vmap(functools.partial(mr.act, self.policy), (axes, 0))(actor, observation)

    def learn(
        self, state: mr.TrainState, trial: Trial, key: jax.Array
    ) -> tuple[mr.TrainState, Metrics]:
        """``Learner.learn``: the module's formula."""
        del key
        actor = state.actor
        trajectory = trial.trajectory
        # r_plus and r_minus, [2, D].
        returns = replace_broken(episode_returns(trajectory), trajectory.nonfinite).reshape(2, -1)
        params_increment = self.increment(trial.directions, returns, self.noise_std)
        params = jax.tree.map(lambda p, d: p + self.step_size * d, actor.params, params_increment)
        # V2 of the paper counts the states that all policies met, for the next update.
        sound_steps = trajectory.mask & ~trajectory.nonfinite
        normalizer = normalize.update(
            actor.normalizer,
            trajectory.observation,
            sound_steps,
            max_count=self.normalize_steps,
            min_std=self.normalize_min_std,
        )
        next_state = state.replace(actor=mr.Actor(params=params, normalizer=normalizer))
        next_state, num_skipped = keep_finite(next_state, state)
        measurements = {
            "entropy": jnp.zeros(()),
            "gradient_norm": optax.tree.norm(params_increment),
            "return_std": jnp.std(returns),
        }
        return next_state, update_metrics(trajectory, num_skipped, measurements)


def _join(trajectory: mr.Trajectory) -> mr.Trajectory:
    """Returns [T, 2 D, ...] from two rollouts stacked [2, T, D, ...]."""

    def join(x: jax.Array) -> jax.Array:
        return jnp.moveaxis(x, 0, 1).reshape(x.shape[1], -1, *x.shape[3:])

    # ``nonfinite`` has no time axis, and ``simulated`` one number a rollout.
    return trajectory.replace(
        observation=join(trajectory.observation),
        action=join(trajectory.action),
        reward=join(trajectory.reward),
        mask=join(trajectory.mask),
        nonfinite=trajectory.nonfinite.reshape(-1),
        simulated=jnp.sum(trajectory.simulated),
    )


def mean_difference(directions: Any, returns: jax.Array, noise_std: Any) -> Any:
    """Returns the sum in the module's formula over D sigma; zero where sigma is."""
    del noise_std
    gain = over_std(returns[0] - returns[1], returns) / returns.shape[1]
    weighted_directions = jax.vmap(optax.tree.scale)(gain, directions)
    return jax.tree.map(lambda x: jnp.sum(x, axis=0), weighted_directions)


def over_std(x: jax.Array, returns: jax.Array) -> jax.Array:
    """Returns ``x`` over the standard deviation of all returns, 0 if they are all equal."""
    std = jnp.std(returns)
    # 0 where all returns are equal, NaN where all episodes broke: the parameters then stay.
    return jnp.where(std > 0, x / jnp.where(std > 0, std, 1.0), 0.0)


def _zero_policy(env: mr.Environment) -> mr.Policy:
    """A linear policy that starts at zero, as the paper's do."""
    space = base.action_space(env)
    family = mr.categorical if isinstance(space, mr.Discrete) else mr.deterministic
    policy = mr.mlp_policy(base.observation_size(env), family(space), ())
    return policy._replace(init=lambda key: jax.tree.map(jnp.zeros_like, policy.init(key)))
