"""REINFORCE (Williams 1992): ``reinforce`` has the formula."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax

from mjx_reinforce.checks import check_type
from mjx_reinforce.devices import NONE, RUNS, SECOND, Devices
from mjx_reinforce.engines import choice
from mjx_reinforce.engines.choice import Engine
from mjx_reinforce.engines.chunks import CHUNK_STEPS
from mjx_reinforce.engines.contract import check_environment
from mjx_reinforce.engines.episode import check_shapes, episode_keys
from mjx_reinforce.fused import any_lane
from mjx_reinforce.learners import counts
from mjx_reinforce.learners.contract import check_estimator, check_optimizer, check_update
from mjx_reinforce.learners.diagnostics import (
    nan_unless,
    policy_metrics,
    visited_steps,
    within_kl,
)
from mjx_reinforce.learners.estimators import Estimator, leave_one_out, standardize
from mjx_reinforce.learners.learner import (
    Guests,
    Host,
    Learner,
    Metrics,
    TrainState,
    check_horizon,
    episode_metrics,
    keep_finite,
)
from mjx_reinforce.learners.schedules import Clock, Cut, check_cut
from mjx_reinforce.learners.updates import Problem, Update, full_batch, make_optimizer
from mjx_reinforce.policies import normalize
from mjx_reinforce.policies.actor import Actor, act
from mjx_reinforce.policies.arguments import check_count, check_key, check_number
from mjx_reinforce.policies.contract import check_policy
from mjx_reinforce.policies.distributions.categorical import categorical
from mjx_reinforce.policies.distributions.distribution import Distribution
from mjx_reinforce.policies.distributions.normal import normal
from mjx_reinforce.policies.policy import Policy, mlp_policy
from mjx_reinforce.types import (
    Box,
    Discrete,
    Environment,
    Trajectory,
    action_space,
    observation_size,
)

#: Where functions are that make estimators, and are no schedules of them.
_ESTIMATORS = tuple(f"mjx_reinforce.learners.{name}" for name in ("estimators", "value_baseline"))
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
    check_environment(env)
    size = observation_size(env)
    if policy is None:
        policy = mlp_policy(size, default_distribution(action_space(env)))
    if optimizer is None:
        optimizer = make_optimizer()
    update = full_batch() if update is None else update
    check_update(update)
    check_count("num_episodes", num_episodes)
    check_count("num_seeds", num_seeds)
    if cut is not None:
        check_cut(cut)
    check_number("entropy_cost", entropy_cost)
    check_number("normalize_steps", normalize_steps, finite=False)
    check_number("normalize_min_std", normalize_min_std)
    if max_kl is not None:
        check_number("max_kl", max_kl, positive=True, finite=False)
    check_type("one_start", one_start, bool)
    check_policy(policy, env, size, likelihood=True)
    check_optimizer("optimizer", optimizer)
    if estimator is None:
        estimator = standardize(leave_one_out(), floor=10.0)
    estimator_at = _at(estimator)
    check_estimator(estimator_at(jnp.zeros(())), env, size, num_episodes)
    return _Reinforce(
        env=env,
        policy=policy,
        estimator=estimator_at,
        optimizer=optimizer,
        update=update,
        num_episodes=num_episodes,
        horizon=check_horizon(env, horizon),
        cut=cut,
        entropy_cost=entropy_cost,
        loss_per=loss_per,
        max_kl=max_kl,
        normalize_steps=normalize_steps,
        normalize_min_std=normalize_min_std,
        one_start=one_start,
        num_seeds=num_seeds,
        devices=devices,
        observation_size=size,
    ).learner(engine)


def _at(
    estimator: Estimator | Callable[[jax.Array], Estimator],
) -> Callable[[jax.Array], Estimator]:
    """Returns a function from the progress [] to an estimator."""
    made_here = getattr(estimator, "__module__", "") in _ESTIMATORS  # such as ``reward_to_go``
    if callable(estimator) and not made_here:
        return estimator
    unchanging: Any = estimator
    return lambda progress: unchanging


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class _Reinforce:
    """The arguments of ``reinforce``, and what it does with them; ``observation_size`` is O."""

    env: Environment
    policy: Policy
    estimator: Callable[[jax.Array], Estimator]
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
    devices: Devices | None
    observation_size: int

    def __post_init__(self):
        if self.loss_per not in ("episode", "step"):
            raise ValueError(f"loss_per must be 'episode' or 'step', got {self.loss_per!r}")

    def learner(self, engine: str) -> Learner:
        """Returns the learner, whose episodes are played by the engine of that name."""
        actor = jax.eval_shape(self._first_actor, jax.random.key(0))
        player = choice.ActingPolicy(self._act, actor, self.policy.distribution)
        chosen = choice.choose(engine, self.env, player, self.horizon)
        play: Any = functools.partial(self._play, chosen)
        with_guests: Any = functools.partial(self._play_all, chosen)
        if chosen.name == "native" and not self.one_start:
            # Elsewhere an episode that is not played still takes its place.
            play = Host(play, with_guests)
        return Learner(self._init, play, self._learn, self.policy, chosen)

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
        actor = self._first_actor(policy_key)
        return TrainState(
            key=key,
            num_updates=counts.zero(),
            env_steps=counts.zero(),
            progress=jnp.zeros(()),
            actor=actor,
            opt_state=self.optimizer.init(actor.params),
            estimator_state=self.estimator(jnp.zeros(())).init(
                estimator_key, self.observation_size
            ),
            start_key=start_key,
        )

    def _play(
        self, engine: Engine, state: TrainState, key: jax.Array, active: bool | jax.Array = True
    ) -> Trajectory:
        return self._play_all(engine, state, key, active, None)[0]

    def _play_all(
        self,
        engine: Engine,
        state: TrainState,
        key: jax.Array,
        active: bool | jax.Array,
        guests: Guests | None,
    ) -> tuple[Trajectory, Trajectory | None]:
        """Plays the episodes of an update, with guests before them if there are any."""
        play = functools.partial(self._play_part, engine)
        visitors = None if guests is None else (guests.keys, guests.deterministic(), guests.active)
        check_shapes((), (self.num_episodes,), active=active)
        chosen = jnp.broadcast_to(active, self.num_episodes)
        keys = episode_keys(key, self.num_episodes)
        limit = None if self.cut is None else self.cut.limit(state.progress, self.horizon)
        given = state.actor, state.start_key, visitors, limit, keys, chosen
        if self.devices is None:
            return play(*given)
        specs = _EPISODES, None if guests is None else _EPISODES
        divided = self.devices.map(
            functools.partial(_part, self.devices, play),
            (NONE, NONE, NONE, NONE, RUNS, RUNS),
            specs,
        )
        own, looked = divided(*given)
        # Those of the first device; the others played none.
        return own, None if guests is None else looked.episodes(slice(len(guests.keys)))

    def _play_part(
        self,
        engine: Engine,
        actor: Actor,
        start_key: Any,
        visitors: Any,
        limit: jax.Array | None,
        keys: Any,
        chosen: Any,
    ) -> tuple[Trajectory, Trajectory | None]:
        """Plays episodes of these keys, as far as they are chosen, with guests before them.

        They have ``limit`` [] steps at most, guests those of the horizon. ``visitors`` are the keys
        of the guests, whether each takes the mode, and whether they are played; None without any.
        """
        count, modes = 0, False
        if visitors is not None:
            guest_keys, guest_modes, guest_active = visitors
            count = len(guest_keys)
            modes = jnp.concatenate([guest_modes, jnp.zeros(len(keys), bool)])
            chosen = jnp.concatenate([jnp.broadcast_to(guest_active, count), chosen])
            if limit is not None:
                own = jnp.broadcast_to(limit, len(keys))
                limit = jnp.concatenate([jnp.full(count, self.horizon), own])
            keys = jnp.concatenate([guest_keys, keys])
        played = engine.rollout(
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
        problem = Problem(
            surrogate=_surrogate(self.policy, self.entropy_cost),
            optimizer=self.optimizer,
            samples=(scaled, trajectory.action, weight, mask),
            divisor=self._divisor(trajectory),
            clock=Clock(state.progress, counts.as_float(state.env_steps)),
        )
        params, opt_state, update_metrics = self.update(problem, key, actor.params, state.opt_state)
        visited = visited_steps(trajectory)
        if self.max_kl is not None:
            params = within_kl(self.policy, actor, params, visited, self.max_kl)
        normalizer = normalize.update(
            actor.normalizer,
            trajectory.observation,
            mask & ~trajectory.nonfinite,
            self.normalize_steps,
            self.normalize_min_std,
        )
        learned = Actor(params=params, normalizer=normalizer), opt_state, estimator_state
        before = actor, state.opt_state, state.estimator_state
        (actor, opt_state, estimator_state), skipped = keep_finite(learned, before)
        state = dataclasses.replace(
            state, actor=actor, opt_state=opt_state, estimator_state=estimator_state
        )
        change = policy_metrics(self.policy, before[0], actor, visited)
        sound = (skipped == 0) & ~jnp.any(trajectory.nonfinite)
        diagnostics = nan_unless(sound, metrics | update_metrics | change)
        return state, episode_metrics(trajectory) | diagnostics | {"skipped_update": skipped}

    def _divisor(self, trajectory: Trajectory) -> int | jax.Array:
        """Returns what the sum over all steps is divided by."""
        if self.loss_per == "step":
            return jnp.maximum(jnp.sum(trajectory.mask), 1)
        return self.num_episodes


def _part(devices: Devices, play: Callable[..., Any], *given: Any) -> tuple[Any, Any]:
    """Returns what ``_play_part`` plays of one device's part, guests on the first device alone."""
    actor, start_key, visitors, limit, keys, chosen = given
    if visitors is not None:
        *others, active = visitors
        visitors = *others, active & (devices.number() == 0)
    played = play(actor, start_key, visitors, limit, keys, chosen)
    simulated = devices.sum(played[0].simulated)
    return jax.tree.map(
        lambda x: dataclasses.replace(x, simulated=simulated),
        played,
        is_leaf=lambda x: isinstance(x, Trajectory),
    )


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
