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

from mjx_reinforce.engine import counts
from mjx_reinforce.engine.base import Environment, Trajectory, action_space, observation_size
from mjx_reinforce.engine.checks import check_count, check_key, check_kind, check_number
from mjx_reinforce.engine.contract import check_environment
from mjx_reinforce.engine.devices import bytes_of, check_room
from mjx_reinforce.engine.episode import check_each, episode_keys
from mjx_reinforce.engine.play import choice
from mjx_reinforce.engine.play.choice import Engine, Rollout
from mjx_reinforce.engine.play.rollouts import episode_lengths, episode_returns
from mjx_reinforce.learning import contract, diagnostics, normalize, trust_region
from mjx_reinforce.learning.diagnostics import Metrics
from mjx_reinforce.learning.distributions import default_distribution
from mjx_reinforce.learning.estimators import Estimator, leave_one_out, standardize
from mjx_reinforce.learning.policy import Actor, Policy, act, mlp_policy, within_bounds
from mjx_reinforce.learning.samples import in_groups
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
      opt_state: the optimizer's state
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
        episodes or a pytree that holds one; nothing where ``active`` [] is False; consumes the key.
        That of ``reinforce`` also takes a rollout in place of the engine's, see ``RolloutPlay``
      learn: (TrainState, what was played, key) -> (TrainState, metrics), with the actor and all
        else that changes by learning; consumes the key
      policy: the policy that is trained; its mode is clipped to the action space
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
    play: Callable[..., Any]
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
        # One key is carried on, two are consumed: no key is ever used twice.
        next_key, play_key, learn_key = jax.random.split(state.key, 3)
        episodes = self.play(state, play_key, active)
        next_state, metrics = self.learn(state, episodes, learn_key)
        # Counted here and not in ``learn``, which may have kept the old state: a skipped update has
        # played its episodes, too.
        next_state = dataclasses.replace(
            next_state,
            key=next_key,
            num_updates=counts.plus(state.num_updates, 1),
            env_steps=counts.plus(state.env_steps, metrics["env_steps"]),
        )
        # Under ``vmap`` over seeds some may be at their end while others go on.
        if active is not True:
            next_state = jax.tree.map(
                lambda new, old: jnp.where(active, new, old), next_state, state
            )
        return next_state, metrics

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

        (1/N) sum_n sum_t (w[t, n] log pi(a[t, n] | o[t, n]) + entropy_cost H[t, n])

    with the weights w that the estimator gives. An episode with numbers that are not finite counts
    as the worst of the others; if all episodes have such numbers, nothing is learned.

    Numbers such as ``entropy_cost``, the estimator's discount and the optimizer's learning rate
    may be traced: build the learner inside a function to vmap over them.

    Args:
      env: what is played; any brax-style environment.
      policy: by default an MLP of 32 and 32 tanh units with ``default_distribution``.
      estimator: by default leave-one-out on the return to go (discount 0.99), divided by its
        standard deviation plus 10.
      optimizer: by default Adam at 1e-2 with the gradient's norm clipped at 1.
      update: how the gradient is spent, from ``updates``; by default in one optimizer step.
      num_episodes: N, episodes an update.
      horizon: T, steps after which an episode ends; by default ``env.max_episode_steps``.
      entropy_cost: weight of the policy's entropy H, in return per nat.
      max_kl: the most, in nats, by which an update may move the policy: the mean over the steps
        that it visited, 64 of them, of KL(before || after), with the scale of the observations
        that each has. A change that goes further is shortened, the scale with it, see
        ``trust_region.within_kl``; None shortens none.
      normalize_steps: scale observations by the mean and std of about the first so many steps,
        then keep that scale; 0 does not scale, inf never stops. (Where a policy learns to keep
        the state near the middle, statistics that never stop shrink, and magnify the
        observations until the policy fails.)
      normalize_min_std: the least that an observation is divided by, in its own unit. (What hardly
        changes in the first steps would be magnified for the rest of training.)
      engine: how episodes are played: "auto", "vmap" or "native", see ``engine.play.choice``.

    Raises:
      ValueError: an argument makes no sense for this environment, or the policy does not fit into
        memory.

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
    contract.check_num_steps(num_episodes, horizon)
    if policy is None:
        policy = mlp_policy(size, default_distribution(action_space(env)))
    contract.check_policy(policy, env, size, likelihood=True)
    policy = within_bounds(policy, action_space(env))
    if optimizer is None:
        optimizer = make_optimizer()
    check_kind("optimizer", optimizer, optax.GradientTransformation, "optax.adam(1e-2)")
    if update is None:
        update = full_batch()
    contract.check_update(update)
    if estimator is None:
        estimator = standardize(leave_one_out(), floor=10.0)
    contract.check_estimator(estimator, env, size, num_episodes)

    actor_shapes = _actor_shapes(policy, estimator, size)
    actor_policy = choice.ActingPolicy(
        functools.partial(act, policy), actor_shapes, policy.distribution
    )
    parts = _Reinforce(
        env=env,
        policy=policy,
        estimator=estimator,
        optimizer=optimizer,
        update=update,
        num_episodes=num_episodes,
        horizon=horizon,
        entropy_cost=entropy_cost,
        max_kl=max_kl,
        normalize_steps=normalize_steps,
        normalize_min_std=normalize_min_std,
        engine=choice.choose(engine, env, actor_policy, horizon),
    )
    return Learner(parts.init, RolloutPlay(parts.play), parts.learn, policy, parts.engine)


@dataclasses.dataclass(frozen=True, eq=False)
class RolloutPlay:
    """A ``Learner.play`` that also takes a rollout in place of the engine's.

    It returns what that rollout returns, of whatever type.
    """

    function: Callable[..., Any]

    def __call__(
        self,
        state: TrainState,
        key: jax.Array,
        active: bool | jax.Array = True,
        rollout: Rollout | None = None,
    ) -> Any:
        """Plays for one update."""
        return self.function(state, key, active, rollout)


def _actor_shapes(policy: Policy, estimator: Estimator, observation_size: int) -> Actor:
    """Returns the shapes of an actor, or raises ValueError where training it has no room."""
    # Shapes alone, so that a network that is too large is refused before it takes its memory.
    key = jax.random.key(0)
    actor_shapes = jax.eval_shape(functools.partial(first_actor, policy, observation_size), key)
    estimator_shapes = jax.eval_shape(lambda key: estimator.init(key, observation_size), key)
    # Three times: the parameters, their gradient, and what they become. Twice: what an estimator
    # has learned, and what that becomes.
    check_room(3 * bytes_of(actor_shapes) + 2 * bytes_of(estimator_shapes))
    return actor_shapes


def first_actor(policy: Policy, observation_size: int, key: jax.Array) -> Actor:
    """Returns the actor before training."""
    return Actor(params=policy.init(key), normalizer=normalize.init(observation_size))


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class _Reinforce:
    """The functions of a learner; the fields are arguments of ``reinforce``, checked."""

    env: Environment
    policy: Policy
    estimator: Estimator
    optimizer: optax.GradientTransformation
    update: Update
    num_episodes: int
    horizon: int
    entropy_cost: float | jax.Array
    max_kl: float | jax.Array | None
    normalize_steps: float
    normalize_min_std: float | jax.Array
    engine: Engine

    def init(self, key: jax.Array) -> TrainState:
        """``Learner.init``."""
        check_key(key)
        # The third key is the seed's own, from which every later key is split.
        policy_key, estimator_key, key = jax.random.split(key, 3)
        size = observation_size(self.env)
        actor = first_actor(self.policy, size, policy_key)
        return TrainState(
            key=key,
            actor=actor,
            opt_state=self.optimizer.init(actor.params),
            estimator_state=self.estimator.init(estimator_key, size),
        )

    def play(
        self,
        state: TrainState,
        key: jax.Array,
        active: bool | jax.Array = True,
        rollout: Rollout | None = None,
    ) -> Trajectory:
        """``Learner.play``; what is wrapped around it may play by another rollout."""
        check_each(self.num_episodes, active=active)
        # A wrapper that cuts episodes or resets all alike puts its own rollout around the engine's.
        rollout = self.engine.rollout if rollout is None else rollout
        return rollout(
            self.env,
            functools.partial(act, self.policy),
            state.actor,
            self.policy.distribution,
            episode_keys(key, self.num_episodes),
            num_episodes=self.num_episodes,
            horizon=self.horizon,
            active=active,
        )

    def learn(
        self, state: TrainState, trajectory: Trajectory, key: jax.Array
    ) -> tuple[TrainState, Metrics]:
        """``Learner.learn``: the update, in the order of the formula of ``reinforce``.

        Shapes are [T, N]: T steps of each of N episodes, of which those in the mask were played.
        """
        # The actor that played: theta, the parameters of pi, and the scale of its observations.
        old_actor = state.actor
        # The few steps at which the policies before and after the update are compared.
        visited = diagnostics.visited_steps(trajectory)

        # An episode whose return overflows float32 counts as broken [N], as one does in which the
        # simulation left the finite numbers: its return compares with nothing.
        overflow = ~jnp.isfinite(episode_returns(trajectory))
        trajectory = trajectory.replace(nonfinite=trajectory.nonfinite | overflow)

        # o[t, n]: observations [T, N, O] as the policy saw them, in the scale of ``old_actor``. The
        # scale of after the update would give the actions other probabilities than they had.
        scaled_trajectory = normalize.scale_observations(old_actor.normalizer, trajectory)

        # w[t, n]: the weights [T, N] of the score (Williams 1992, equation 8), from rewards, and
        # from observations where a baseline is learned. That baseline is in ``estimator_state``. It
        # is fitted to these returns after it was subtracted from them: one that had seen an
        # action's own return would bias the gradient.
        weight, estimator_state, estimator_metrics = self.estimator.update(
            state.estimator_state, scaled_trajectory
        )

        # theta: the optimizer's steps. The value of the surrogate means nothing; its gradient at
        # the old theta is minus the formula's.
        problem = self._problem(state, scaled_trajectory, weight)
        params, opt_state, step_metrics = self.update(
            problem, key, old_actor.params, state.opt_state
        )

        # The next scale, from the raw observations: scaled ones would always have mean 0 and
        # standard deviation 1. An episode that broke is left out whole.
        sound_steps = trajectory.mask & ~trajectory.nonfinite
        normalizer = normalize.update(
            old_actor.normalizer,
            trajectory.observation,
            sound_steps,
            max_count=self.normalize_steps,
            min_std=self.normalize_min_std,
        )

        # A trust region (Schulman et al. 2015, arXiv:1502.05477): parameters and scale both change
        # what the policy does, so the two are shortened together.
        proposal = Actor(params=params, normalizer=normalizer)
        actor = trust_region.within_kl(self.policy, old_actor, proposal, visited, self.max_kl)
        next_state = state.replace(
            actor=actor, opt_state=opt_state, estimator_state=estimator_state
        )

        # Without one sound episode, or with a norm that overflows, the step would say nothing.
        is_sound = ~jnp.all(trajectory.nonfinite)
        is_sound &= jnp.isfinite(step_metrics.get("gradient_norm", 0.0))
        next_state, num_skipped = keep_finite(next_state, state, is_sound)

        # Measured of the actor that was kept, at the same steps at which the change was limited.
        policy_kl = diagnostics.policy_metrics(self.policy, old_actor, next_state.actor, visited)
        measurements = estimator_metrics | step_metrics | policy_kl
        return next_state, update_metrics(trajectory, num_skipped, measurements)

    def _problem(self, state: TrainState, trajectory: Trajectory, weight: jax.Array) -> Problem:
        """Returns minus the sum in the formula, and all else that an ``Update`` reads.

        Args:
          state: before the update.
          trajectory: [T, N] what was played, with scaled observations.
          weight: [T, N] w, from the estimator.
        """
        distribution = self.policy.distribution

        def surrogate(params, samples):
            """Returns minus the sum [] over samples, and the sum of their entropies H."""
            observation, action, weight, mask = samples
            outputs = in_groups(self.policy.apply)(params, observation)
            entropy = distribution.entropy(outputs)
            # No gradient flows into the weight, which is data here. Minus, as optimizers descend.
            terms = distribution.log_prob(outputs, action) * weight + self.entropy_cost * entropy
            # Where no step was played, the numbers may be anything, NaN too: 0 times NaN is NaN.
            loss = -jnp.sum(jnp.where(mask, terms, 0.0))
            return loss, {"entropy": jnp.sum(jnp.where(mask, entropy, 0.0))}

        return Problem(
            surrogate=surrogate,
            optimizer=self.optimizer,
            samples=(trajectory.observation, trajectory.action, weight, trajectory.mask),
            # By N, not by the steps that were played, which depend on the policy.
            divisor=self.num_episodes,
            clock=Clock(state.progress, counts.as_float(state.env_steps)),
        )


_jitted_step = jax.jit(Learner.step, static_argnums=0)


def train_step(learner: Learner, state: TrainState) -> tuple[TrainState, Metrics]:
    """Plays N episodes and makes one update, compiled.

    Nothing is donated: ``state`` stays usable. For many seeds,
    ``jax.vmap(functools.partial(train_step, learner))(states)``.

    Args:
      learner: from ``reinforce`` or ``ars``; another learner is compiled again.
      state: from ``learner.init`` or the step before.

    Returns:
      The next state, and metrics, each []: ``episodes`` (N), ``episode_return`` (mean over the N
      episodes; with ``episode_return_min`` and ``episode_return_max``), ``episode_length``,
      ``env_steps`` (played in this
      update), ``simulated_steps`` (also those after an episode's end; with the native engine they
      depend on which thread is first), ``nonfinite_episodes`` (those that broke; they count above
      with what they earned until then), and ``skipped_update`` (1 if the proposed state was not
      finite, or if all episodes broke, so that the old one was kept). Then the diagnostics, NaN if
      an episode was not finite or the update was skipped: ``entropy``, ``kl``, ``policy_std`` (see
      ``diagnostics.policy_metrics``), ``gradient_norm``, ``gradient_snr`` (of ``full_batch`` and
      ``natural_gradient`` alone), ``explained_variance`` (of an estimator with a baseline), and the
      estimator's own.

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
    # Before it is traced: of a wrong argument, jit would say that it is no JAX type.
    check_kind("state", state, TrainState, "learner.init(jax.random.key(0))")
    return _jitted_step(learner, state)


# All that a jitted function has besides, to compile ahead of time and to see shapes and costs.
vars(train_step).update(
    {name: getattr(_jitted_step, name) for name in ("lower", "eval_shape", "trace", "clear_cache")}
)


def keep_finite(
    candidate: TrainState, old_state: TrainState, is_sound: jax.Array | bool = True
) -> tuple[TrainState, jax.Array]:
    """Returns ``candidate`` and 0 if all of it is finite and sound, else ``old_state`` and 1.

    So an update that breaks costs its seed that one update.
    """
    # Floats are joined into one vector for the choice. With a choice for each leaf XLA's CPU
    # backend makes a program for each, and each of them computes again what they share.
    new_floats, unravel = ravel_pytree(list(filter(is_float, jax.tree.leaves(candidate))))
    old_floats, _ = ravel_pytree(list(filter(is_float, jax.tree.leaves(old_state))))
    is_finite = jnp.all(jnp.isfinite(new_floats)) & is_sound
    chosen_floats = iter(unravel(jnp.where(is_finite, new_floats, old_floats)))

    def choose(new: jax.Array, old: jax.Array) -> jax.Array:
        # ``jax.tree.map`` visits leaves in the order of ``jax.tree.leaves`` above.
        if is_float(new):
            return next(chosen_floats)
        return new if new is old else jnp.where(is_finite, new, old)  # no update touches the key

    return jax.tree.map(choose, candidate, old_state), jnp.where(is_finite, 0, 1)


def is_float(x: jax.Array) -> bool:
    """Returns whether an array holds floating-point numbers."""
    return jnp.issubdtype(x.dtype, jnp.floating)


def update_metrics(
    trajectory: Trajectory, num_skipped: jax.Array, measurements: Metrics
) -> Metrics:
    """Returns the metrics of an update, see ``train_step``.

    Args:
      trajectory: what was played.
      num_skipped: [] 1 if the update was not finite, else 0.
      measurements: the rest of the metrics; their floats are NaN where the update was not finite.
    """
    returns = episode_returns(trajectory)
    lengths = episode_lengths(trajectory)
    # Means over steps of which some are garbage say nothing. NaN is a gap in a chart, 0 a value.
    is_sound = (num_skipped == 0) & ~jnp.any(trajectory.nonfinite)
    floats = {
        name: jnp.where(is_sound, x, jnp.nan) for name, x in measurements.items() if is_float(x)
    }
    return {
        "episodes": jnp.int32(trajectory.mask.shape[1]),
        "episode_return": jnp.mean(returns),
        "episode_return_min": jnp.min(returns),
        "episode_return_max": jnp.max(returns),
        "episode_length": jnp.mean(lengths),
        "env_steps": jnp.sum(lengths),
        "simulated_steps": trajectory.simulated,
        "nonfinite_episodes": jnp.sum(trajectory.nonfinite),
        **(measurements | floats),
        "skipped_update": num_skipped,
    }
