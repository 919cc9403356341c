"""Augmented random search (Mania, Guy and Recht 2018, arXiv:1803.07055), algorithms 1 and 2.

A direction delta is tried forwards and backwards by two deterministic policies of their own, and
the parameters move along the directions that made a difference:

    theta += step_size / (b sigma) * sum over the b best of (r_plus - r_minus) delta,

with sigma the standard deviation of those 2 b returns. An episode in which the simulation left the
finite numbers counts as the worst of the others; where all did, nothing is learned. No gradient of
the policy is taken. The learner has the same two functions as ``reinforce``, so whatever drives one
drives the other.
"""

import dataclasses
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax.typing import ArrayLike
from optax import Params

from mjx_reinforce.engine.base import (
    Discrete,
    Environment,
    Trajectory,
    action_space,
    observation_size,
)
from mjx_reinforce.engine.checks import check_count, check_key, check_number, check_type
from mjx_reinforce.engine.contract import check_environment
from mjx_reinforce.engine.play import choice
from mjx_reinforce.engine.play.choice import Engine
from mjx_reinforce.engine.play.rollouts import episode_returns
from mjx_reinforce.learning import contract, diagnostics, normalize
from mjx_reinforce.learning.distributions import categorical, deterministic
from mjx_reinforce.learning.estimators import replace_broken
from mjx_reinforce.learning.learner import (
    Learner,
    Metrics,
    TrainState,
    episode_metrics,
    keep_finite,
)
from mjx_reinforce.learning.policy import Actor, Policy, act, mlp_policy
from mjx_reinforce.learning.updates import signal_to_noise


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
    normalize_min_std: float | jax.Array = 0.0,
    shared_starts: bool = False,
    update: str = "paper",
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
      horizon: T, steps after which an episode ends; by default ``env.max_episode_steps``.
      normalize_steps: scale observations by the mean and std of about the first so many steps;
        inf is V2, 0 is V1.
      normalize_min_std: the least that an observation is divided by, in its own unit.
      shared_starts: the two episodes of a direction start alike; each has its own start in the
        paper.
      update: "paper", or "document" for that of a published notebook: ``document_increment``.
      engine: "auto" or "vmap", see ``engines.choice``.

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
    search = _RandomSearch(**locals())
    return Learner(search.init, search.play, search.learn, search.policy, search.plays)


class Trial(NamedTuple):
    """What is tried for one update.

    directions: like the params, with a leading axis [D]
    trajectory: 2 D episodes, an episode a policy; the forward ones first
    """

    directions: Any
    trajectory: Trajectory


@dataclasses.dataclass(kw_only=True, eq=False)
class _RandomSearch:
    """The arguments of ``ars``, checked and completed, and what it does with them."""

    env: Environment
    policy: Policy
    num_directions: int
    top_directions: int
    step_size: float | jax.Array
    noise_std: float | jax.Array
    horizon: int
    normalize_steps: float
    normalize_min_std: float | jax.Array
    shared_starts: bool
    update: str
    engine: str
    observation_size: int = dataclasses.field(init=False)
    plays: Engine = dataclasses.field(init=False)

    def __post_init__(self):
        check_environment(self.env)
        self.horizon = contract.check_horizon(self.env, self.horizon)
        check_count("num_directions", self.num_directions)
        check_type("top_directions", self.top_directions, int | None)
        check_type("shared_starts", self.shared_starts, bool)
        check_number("normalize_steps", self.normalize_steps, finite=False)
        check_number("normalize_min_std", self.normalize_min_std)
        if self.top_directions is None:
            self.top_directions = self.num_directions
        if not 1 <= self.top_directions <= self.num_directions:
            raise ValueError(
                f"top_directions must lie in [1, {self.num_directions}], got {self.top_directions}"
            )
        check_number("step_size", self.step_size, positive=True)
        check_number("noise_std", self.noise_std, positive=True)
        if self.update not in ("paper", "document"):
            raise ValueError(f"update must be 'paper' or 'document', got {self.update!r}")
        if self.update == "document" and self.top_directions != self.num_directions:
            raise ValueError("update='document' uses all directions: leave top_directions out")
        self.observation_size = observation_size(self.env)
        if self.policy is None:
            self.policy = _zero_policy(self.env, self.observation_size)
        else:
            contract.check_policy(self.policy, self.env, self.observation_size)
        if self.update == "document":
            _check_linear(self.policy)
        self.plays = choice.choose(self.engine, self.env)

    def init(self, key: jax.Array) -> TrainState:
        check_key(key)
        policy_key, key = jax.random.split(key)
        normalizer = normalize.init(self.observation_size)
        actor = Actor(params=self.policy.init(policy_key), normalizer=normalizer)
        return TrainState(key=key, actor=actor)

    def play(self, state: TrainState, key: jax.Array, active: bool | jax.Array = True) -> Trial:
        directions_key, episodes_key = jax.random.split(key)
        keys = jax.random.split(episodes_key)
        keys = keys[jnp.array([0, 0])] if self.shared_starts else keys
        directions = _draw_directions(directions_key, state.actor.params, self.num_directions)
        params = self._perturb(state.actor.params, directions)

        def one_way(params, key):
            return self.plays.rollout(
                self.env,
                self._act_each,
                Actor(params=params, normalizer=state.actor.normalizer),
                self.policy.distribution,
                key,
                num_episodes=self.num_directions,
                deterministic=True,
                horizon=self.horizon,
                active=active,
            )

        return Trial(directions, _join_rollouts(jax.vmap(one_way)(params, keys)))

    def learn(self, state: TrainState, trial: Trial, key: jax.Array) -> tuple[TrainState, Metrics]:
        del key
        actor, trajectory = state.actor, trial.trajectory
        returns = replace_broken(episode_returns(trajectory), trajectory.nonfinite)
        returns = returns.reshape(2, self.num_directions)
        if self.update == "paper":
            increment = paper_increment(trial.directions, returns, self.top_directions)
        else:
            increment = document_increment(trial.directions, returns, self.noise_std)
        moved = jax.tree.map(lambda p, d: p + self.step_size * d, actor.params, increment)
        counted = trajectory.mask & ~trajectory.nonfinite
        limits = self.normalize_steps, self.normalize_min_std
        normalizer = normalize.update(actor.normalizer, trajectory.observation, counted, *limits)
        learned = Actor(params=self._tie(moved), normalizer=normalizer)
        actor, skipped = keep_finite(learned, actor)
        measured = {
            "entropy": jnp.zeros(()),
            "gradient_norm": optax.tree.norm(increment),
            "return_std": jnp.std(returns),
        }
        if self.num_directions > 1:
            measured["gradient_snr"] = _step_signal_to_noise(trial.directions, returns)
        sound = (skipped == 0) & ~jnp.any(trajectory.nonfinite)
        metrics = episode_metrics(trajectory) | diagnostics.nan_unless(sound, measured)
        return dataclasses.replace(state, actor=actor), metrics | {"skipped_update": skipped}

    def _act_each(self, actor: Actor, observation: jax.Array) -> jax.Array:
        """Returns the outputs [D, K] of D policies for an observation [D, O] of each."""

        def act_one(params, observation):
            return act(self.policy, dataclasses.replace(actor, params=params), observation)

        return jax.vmap(act_one)(actor.params, observation)

    def _tie(self, params: Params) -> Any:
        """Returns the params as the update ties them; the paper's does not."""
        return params if self.update == "paper" else overwrite_bias(params)

    def _perturb(self, params: Params, directions: Params) -> Any:
        """Returns the params of all policies, [2, D, ...], the forward ones first."""
        moves = jax.tree.map(
            lambda d: jnp.stack([self.noise_std * d, -self.noise_std * d]), directions
        )
        return jax.vmap(jax.vmap(self._tie))(jax.tree.map(jnp.add, params, moves))


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


def _join_rollouts(trajectory: Trajectory) -> Trajectory:
    """Returns [T, 2 D, ...] from two rollouts stacked [2, T, D, ...]."""

    def join(x):
        joined = jnp.moveaxis(x, 0, 1)
        return joined.reshape(joined.shape[0], -1, *joined.shape[3:])

    names = "observation", "action", "reward", "mask"
    return trajectory.replace(
        **{name: join(getattr(trajectory, name)) for name in names},
        nonfinite=trajectory.nonfinite.reshape(-1),
        simulated=jnp.sum(trajectory.simulated),
    )


def _zero_policy(env: Environment, size: int) -> Policy:
    """A linear policy that starts at zero, as the paper's do."""
    space = action_space(env)
    family = categorical if isinstance(space, Discrete) else deterministic
    policy = mlp_policy(size, family(space), ())

    def init(key):
        return jax.tree.map(jnp.zeros_like, policy.init(key))

    return policy._replace(init=init)


def paper_increment(directions: Params, returns: jax.Array, top: int) -> Any:
    """Returns the sum in the module's formula over b sigma; zero where sigma is.

    Args:
      directions: like the params, with a leading axis [D].
      returns: [2, D] forwards and backwards.
      top: b.
    """
    best = jnp.argsort(-jnp.max(returns, axis=0))[:top]
    gain = _over_std(returns[0, best] - returns[1, best], returns[:, best]) / top
    return jax.tree.map(lambda d: _weighted_sum(gain, d[best]), directions)


def document_increment(directions: Params, returns: jax.Array, noise_std: ArrayLike) -> Any:
    """Returns the increment of a published notebook, mistakes included, for reproducing it.

    Its ``np.sum`` without an axis adds up the entries of the direction too, so all parameters move
    by the same number; it does not divide by how many directions there are, and multiplies by
    ``noise_std``. The bias is overwritten besides, see ``overwrite_bias``. Not reproduced: where
    all returns are equal it divides 0 by 0, and its parameters are NaN for good.
    """
    totals = sum(jnp.sum(d.reshape(len(d), -1), axis=1) for d in jax.tree.leaves(directions))
    increment = noise_std * jnp.sum(_over_std(returns[0] - returns[1], returns) * totals)
    return jax.tree.map(lambda d: jnp.full(d.shape[1:], increment, d.dtype), directions)


def overwrite_bias(params: Any) -> Any:
    """Returns a linear policy's params with the first A weights in place of the bias [A].

    The notebook writes the same first entries of its flat vector into every parameter.
    """
    layer = params["network"]["params"]["Dense_0"]
    # PyTorch stores weights as [A, O], flax as [O, A].
    bias = layer["kernel"].T.reshape(-1)[: layer["bias"].size]
    return params | {"network": {"params": {"Dense_0": layer | {"bias": bias}}}}


def _check_linear(policy: Policy) -> None:
    """Raises ValueError for a policy whose bias ``overwrite_bias`` does not find."""
    params = jax.eval_shape(policy.init, jax.random.key(0))
    if set(params) != {"network", "constants"} or set(params["network"]["params"]) != {"Dense_0"}:
        raise ValueError("update='document' is for linear policies: pass one with hidden_sizes=()")


def _over_std(x: jax.Array, returns: jax.Array) -> jax.Array:
    """Returns ``x`` over the standard deviation of all returns, 0 if they are all equal."""
    std = jnp.std(returns)
    return jnp.where(std > 0, x / jnp.where(std > 0, std, 1.0), 0.0)


def _weighted_sum(weight: jax.Array, x: jax.Array) -> jax.Array:
    """Returns the sum over the first axis of ``x`` [D, ...] times ``weight`` [D]."""
    return jnp.sum(weight.reshape(-1, *(1,) * (x.ndim - 1)) * x, axis=0)
