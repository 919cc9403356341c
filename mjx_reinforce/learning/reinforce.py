"""REINFORCE (Williams 1992): ``reinforce`` has the formula."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax

from mjx_reinforce.engine.base import (
    Box,
    Discrete,
    Environment,
    Trajectory,
    action_space,
    observation_size,
)
from mjx_reinforce.engine.checks import check_count, check_key, check_number, check_type
from mjx_reinforce.engine.contract import check_environment
from mjx_reinforce.engine.devices import NONE, RUNS, SECOND, Devices
from mjx_reinforce.engine.play import choice
from mjx_reinforce.engine.play.choice import Engine
from mjx_reinforce.engine.play.episode import CHUNK_STEPS, check_each, episode_keys
from mjx_reinforce.engine.scalar import any_lane
from mjx_reinforce.learning import contract, counts, diagnostics, normalize
from mjx_reinforce.learning.actor import Actor, act
from mjx_reinforce.learning.distributions.categorical import categorical
from mjx_reinforce.learning.distributions.distribution import Distribution
from mjx_reinforce.learning.distributions.gaussian import normal
from mjx_reinforce.learning.estimators import Estimator, leave_one_out, standardize
from mjx_reinforce.learning.learner import (
    Guests,
    Host,
    Learner,
    Metrics,
    TrainState,
    episode_metrics,
    keep_finite,
)
from mjx_reinforce.learning.policy import Policy, mlp_policy
from mjx_reinforce.learning.schedules import Clock, Cut, check_cut
from mjx_reinforce.learning.updates import Problem, Update, full_batch, make_optimizer

#: Where functions are that make estimators, and are no schedules of them.
_ESTIMATORS = tuple(f"mjx_reinforce.learning.{name}" for name in ("estimators", "value_baseline"))
#: Episodes are short if none is longer than the horizon divided by this, or than the cut. An update
#: passes over all steps that there may be: it takes its time from the horizon, not the episodes.
_SHORT = 8
#: Updates of so many steps, of all seeds, are compiled for short episodes too. Measured on two CPU
#: cores: that saves 70 ns for each of these steps in such an update, and takes 4 s to compile.
_MANY = 2**19

#: How the episodes of an update are divided among devices.
_specs: Any = Trajectory
_EPISODES = _specs(
    observation=SECOND, action=SECOND, reward=SECOND, mask=SECOND, nonfinite=RUNS, simulated=NONE
)


def default_distribution(space: Box | Discrete) -> Distribution:
    """Returns a Normal with a trained std, or a categorical distribution if discrete."""
    return categorical(space) if isinstance(space, Discrete) else normal(space)


def reinforce(
    env: Environment,
    *,
    policy: Policy | None = None,
    estimator: Estimator | Callable[[jax.Array], Estimator] | None = None,
    optimizer: optax.GradientTransformation | None = None,
    update: Update | None = None,
    num_episodes: int = 16,
    horizon: int | None = None,
    cut: Cut | None = None,
    entropy_cost: float | jax.Array = 0.0,
    loss_per: str = "episode",
    max_kl: float | jax.Array | None = None,
    normalize_steps: float = 1000,
    normalize_min_std: float | jax.Array = 0.0,
    one_start: bool = False,
    num_seeds: int = 1,
    engine: str = "auto",
    devices: Devices | None = None,
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
        standard deviation plus 10. Or a function from ``TrainState.progress`` [] to one, where
        its numbers change as the budget is used.
      optimizer: by default Adam at 1e-2 with the gradient's norm clipped at 1.
      update: how the gradient is spent, from ``updates``; by default in one optimiser step.
      num_episodes: N, episodes an update.
      horizon: T, steps after which an episode ends; by default ``env.max_episode_steps``.
      cut: how many steps episodes have at most until a share of the budget is used, which is
        ``TrainState.progress``; by default they are never cut.
      entropy_cost: weight of the policy's entropy H, in return per nat.
      loss_per: "episode" divides the sum by N; "step" by the number of steps played, so that the
        gradient does not grow with the episodes.
      max_kl: the most, in nats, by which an update may move the policy: the mean over the steps
        that it visited of KL(before || after). A change that goes further is shortened, see
        ``diagnostics.within_kl``; None shortens none. A new scale of the observations comes on top.
      normalize_steps: scale observations by the mean and std of about the first so many steps,
        then keep that scale; 0 does not scale, inf never stops. (Where a policy learns to keep
        the state near the middle, statistics that never stop shrink, and magnify the
        observations until the policy fails.)
      normalize_min_std: the least that an observation is divided by, in its own unit. (What hardly
        changes in the first steps would be magnified for the rest of training.)
      one_start: reset every episode of a seed with the same key, drawn once at ``init``.
      num_seeds: how many will learn at once, vmapped. It decides nothing but speed
        and rounding: of many, updates whose episodes are all short pass over their first steps
        alone.
      engine: how episodes are played: "auto", "vmap" or "native", see
        ``engines.choice``.
      devices: among which the episodes of an update are divided; they stay where they are played,
        and XLA divides what is computed from them. Their count divides every number of episodes
        that an update has room for. None plays where ``jax.jit`` computes.

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
    return _Reinforce(**locals()).learner()


def _at(
    estimator: Estimator | Callable[[jax.Array], Estimator],
) -> Callable[[jax.Array], Estimator]:
    """Returns a function from the progress [] to an estimator."""
    made_here = getattr(estimator, "__module__", "") in _ESTIMATORS  # such as ``reward_to_go``
    if callable(estimator) and not made_here:
        return estimator
    unchanging: Any = estimator
    return lambda progress: unchanging


@dataclasses.dataclass(kw_only=True, eq=False)
class _Reinforce:
    """The arguments of ``reinforce``, checked and completed, and what it does with them."""

    env: Environment
    policy: Policy
    estimator: Any
    optimizer: optax.GradientTransformation
    update: Update
    num_episodes: int
    horizon: int
    cut: Cut | None
    entropy_cost: float | jax.Array
    loss_per: str
    max_kl: float | jax.Array | None
    normalize_steps: float
    normalize_min_std: float | jax.Array
    one_start: bool
    num_seeds: int
    engine: str
    devices: Devices | None
    observation_size: int = dataclasses.field(init=False)
    plays: Engine = dataclasses.field(init=False)

    def __post_init__(self):
        check_environment(self.env)
        self.observation_size = size = observation_size(self.env)
        self._check_numbers()
        self.horizon = contract.check_horizon(self.env, self.horizon)
        if self.policy is None:
            self.policy = mlp_policy(size, default_distribution(action_space(self.env)))
        contract.check_policy(self.policy, self.env, size, likelihood=True)
        if self.optimizer is None:
            self.optimizer = make_optimizer()
        contract.check_optimizer("optimizer", self.optimizer)
        if self.update is None:
            self.update = full_batch()
        contract.check_update(self.update)
        if self.estimator is None:
            self.estimator = standardize(leave_one_out(), floor=10.0)
        self.estimator = _at(self.estimator)
        first = self.estimator(jnp.zeros(()))
        contract.check_estimator(first, self.env, size, self.num_episodes)
        actor = jax.eval_shape(self._first_actor, jax.random.key(0))
        player = choice.ActingPolicy(self._act, actor, self.policy.distribution)
        self.plays = choice.choose(self.engine, self.env, player, self.horizon)

    def _check_numbers(self):
        check_count("num_episodes", self.num_episodes)
        check_count("num_seeds", self.num_seeds)
        if self.cut is not None:
            check_cut(self.cut)
        check_number("entropy_cost", self.entropy_cost)
        check_number("normalize_steps", self.normalize_steps, finite=False)
        check_number("normalize_min_std", self.normalize_min_std)
        if self.max_kl is not None:
            check_number("max_kl", self.max_kl, positive=True, finite=False)
        check_type("one_start", self.one_start, bool)
        if self.loss_per not in ("episode", "step"):
            raise ValueError(f"loss_per must be 'episode' or 'step', got {self.loss_per!r}")

    def learner(self) -> Learner:
        """Returns the learner."""
        host = Host(self._play)
        # Elsewhere an episode that is not played still takes its place.
        takes_guests = self.plays.name == "native" and not self.one_start
        play = host if takes_guests else host.alone
        return Learner(self._init, play, self._learn, self.policy, self.plays)

    def _act(self, actor: Actor, observation: jax.Array) -> jax.Array:
        return act(self.policy, actor, observation)

    def _first_actor(self, key: jax.Array) -> Actor:
        normalizer = normalize.init(self.observation_size)
        return Actor(params=self.policy.init(key), normalizer=normalizer)

    def _init(self, key: jax.Array) -> TrainState:
        check_key(key)
        policy_key, estimator_key, key = jax.random.split(key, 3)
        start_key = None
        if self.one_start:
            key, start_key = jax.random.split(key)
        actor, estimator = self._first_actor(policy_key), self.estimator(jnp.zeros(()))
        return TrainState(
            key=key,
            actor=actor,
            opt_state=self.optimizer.init(actor.params),
            estimator_state=estimator.init(estimator_key, self.observation_size),
            start_key=start_key,
        )

    def _play(
        self, state: TrainState, key: jax.Array, active: bool | jax.Array, guests: Guests | None
    ) -> tuple[Trajectory, Trajectory | None]:
        """Plays the episodes of an update, with guests before them if there are any."""
        check_each(self.num_episodes, active=active)
        visitors = None if guests is None else (guests.keys, guests.deterministic(), guests.active)
        chosen = jnp.broadcast_to(active, self.num_episodes)
        keys = episode_keys(key, self.num_episodes)
        limit = None if self.cut is None else self.cut.limit(state.progress, self.horizon)
        play: Any = self._play_part
        if self.devices is not None:
            given = NONE, NONE, NONE, NONE, RUNS, RUNS
            of_guests = None if guests is None else _EPISODES
            play = self.devices.map(play, given, (_EPISODES, of_guests))
        own, looked = play(state.actor, state.start_key, visitors, limit, keys, chosen)
        if self.devices is not None and guests is not None:
            # Those of the first device; the others played none.
            looked = looked.episodes(slice(len(guests.keys)))
        return own, looked

    def _play_part(
        self, actor: Actor, start_key: Any, visitors: Any, limit: Any, keys: Any, chosen: Any
    ) -> tuple[Trajectory, Trajectory | None]:
        """Plays episodes of these keys, as far as they are chosen, with guests before them.

        They have ``limit`` [] steps at most, guests those of the horizon. ``visitors`` are the keys
        of the guests, whether each takes the mode, and whether they are played; None without any.
        Of several devices each plays a part of the episodes, and the first one the guests.
        """
        count, modes = 0, False
        if visitors is not None:
            guest_keys, guest_modes, guest_active = visitors
            if self.devices is not None:
                guest_active = guest_active & (self.devices.number() == 0)
            count = len(guest_keys)
            modes = jnp.concatenate([guest_modes, jnp.zeros(len(keys), bool)])
            chosen = jnp.concatenate([jnp.broadcast_to(guest_active, count), chosen])
            if limit is not None:
                own = jnp.broadcast_to(limit, len(keys))
                limit = jnp.concatenate([jnp.full(count, self.horizon), own])
            keys = jnp.concatenate([guest_keys, keys])
        played = self.plays.rollout(
            self.env if start_key is None else _OneStart(self.env, start_key),
            self._act,
            actor,
            self.policy.distribution,
            keys,
            num_episodes=len(keys),
            horizon=self.horizon,
            deterministic=modes,
            active=chosen,
            limit=limit,
        )
        if self.devices is not None:
            played = dataclasses.replace(played, simulated=self.devices.sum(played.simulated))
        if visitors is None:
            return played, None
        return played.episodes(slice(count, None)), played.episodes(slice(count))

    def _learn(
        self, state: TrainState, trajectory: Trajectory, key: jax.Array
    ) -> tuple[TrainState, Metrics]:
        """Learns; where all episodes, of many seeds, were short, from their first steps alone."""
        few = max(self.horizon // _SHORT, 0 if self.cut is None else self.cut.steps)
        if not CHUNK_STEPS <= few < self.horizon or self.num_seeds * trajectory.mask.size < _MANY:
            return self._learn_from(state, trajectory, key)
        return jax.lax.cond(
            any_lane(jnp.any(trajectory.mask[few])),
            lambda: self._learn_from(state, trajectory, key),
            lambda: self._learn_from(state, trajectory.first(few), key),
        )

    def _learn_from(
        self, state: TrainState, trajectory: Trajectory, key: jax.Array
    ) -> tuple[TrainState, Metrics]:
        actor, mask = state.actor, trajectory.mask
        scaled = normalize.apply(actor.normalizer, trajectory.observation)
        seen = dataclasses.replace(trajectory, observation=scaled)
        estimator = self.estimator(state.progress)
        weight, estimator_state, metrics = estimator.update(state.estimator_state, seen)
        divisor = self.num_episodes if self.loss_per == "episode" else jnp.maximum(jnp.sum(mask), 1)
        problem = Problem(
            surrogate=_surrogate(self.policy, self.entropy_cost),
            optimizer=self.optimizer,
            samples=(scaled, trajectory.action, weight, mask),
            divisor=divisor,
            clock=Clock(state.progress, counts.as_float(state.env_steps)),
        )
        params, opt_state, update_metrics = self.update(problem, key, actor.params, state.opt_state)
        visited = diagnostics.visited_steps(trajectory)
        if self.max_kl is not None:
            params = diagnostics.within_kl(self.policy, actor, params, visited, self.max_kl)
        counted = mask & ~trajectory.nonfinite
        limits = self.normalize_steps, self.normalize_min_std
        normalizer = normalize.update(actor.normalizer, trajectory.observation, counted, *limits)
        learned = Actor(params=params, normalizer=normalizer), opt_state, estimator_state
        before = actor, state.opt_state, state.estimator_state
        (actor, opt_state, estimator_state), skipped = keep_finite(learned, before)
        state = dataclasses.replace(
            state, actor=actor, opt_state=opt_state, estimator_state=estimator_state
        )
        change = diagnostics.policy_metrics(self.policy, before[0], actor, visited)
        sound = (skipped == 0) & ~jnp.any(trajectory.nonfinite)
        measured = diagnostics.nan_unless(sound, metrics | update_metrics | change)
        return state, episode_metrics(trajectory) | measured | {"skipped_update": skipped}


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
