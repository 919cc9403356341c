"""What is wrapped around a learner where many seeds train: none of it changes the algorithm.

Each function takes a learner and returns one. ``in_one_launch`` plays an evaluation with the
episodes of an update, and divides them among devices; ``short_episodes`` makes updates of many
seeds cheap while all episodes are short.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mjx_reinforce.engine.base import Act, Acts, Environment, PyTree, Trajectory
from mjx_reinforce.engine.checks import check_kind
from mjx_reinforce.engine.devices import NONE, RUNS, SECOND, Devices
from mjx_reinforce.engine.episode import CHUNK_STEPS
from mjx_reinforce.engine.scalar import any_lane
from mjx_reinforce.learning.contract import traced
from mjx_reinforce.learning.learner import Learner, Metrics, TrainState
from mjx_reinforce.learning.policy import Actor

#: Episodes are short if none is longer than the horizon divided by this, or than the cut. An update
#: passes over all steps that there may be: it takes its time from the horizon, not the episodes.
_SHORT_DIVISOR = 8
#: Updates of so many steps, of all seeds, are compiled for short episodes too. Measured on two CPU
#: cores: that saves 70 ns for each of these steps in such an update, and takes 4 s to compile.
_MIN_STEPS = 2**19

#: How the episodes of an update are divided among devices.
_TrajectorySpecs: Any = Trajectory
_EPISODES = _TrajectorySpecs(
    observation=SECOND,
    action=SECOND,
    reward=SECOND,
    mask=SECOND,
    nonfinite=RUNS,
    simulated=NONE,
    terms=SECOND,
)

#: Metrics without which no run can be recorded.
_METRICS = (
    "episodes",
    "episode_return",
    "episode_length",
    "env_steps",
    "simulated_steps",
    "nonfinite_episodes",
    "skipped_update",
)

#: Among the metrics of an update, the episodes of the evaluation that shared its launch.
_EVALUATION = "evaluation episodes"


class EvaluationEpisodes(NamedTuple):
    """E episodes that are played in one launch with an update, and from which nothing learns.

    keys: [E] their own keys, as ``engine.episode.episode_keys`` makes them
    num_modes: how many of them, the first, take the policy's mode; the others its samples
    active: [] whether they are played
    """

    keys: jax.Array
    num_modes: int
    active: jax.Array

    def deterministic(self) -> jax.Array:
        """Returns which of them [E] take the mode."""
        return jnp.arange(len(self.keys)) < self.num_modes


class SharedEpisodes(NamedTuple):
    """What one launch played.

    training: [T, N] the episodes of an update
    evaluation: [T, E] those of an evaluation; None without one
    """

    training: Trajectory
    evaluation: Trajectory | None


@dataclasses.dataclass(frozen=True, eq=False)
class SharedLaunch:
    """A ``Learner.play`` whose launch may play an evaluation too, and is divided among devices.

    learner: whose ``play`` takes another rollout and returns what that does, see ``RolloutPlay``
    devices: among which the episodes of an update are divided; they stay where they are played, and
      XLA divides what is computed from them. Their count divides every number of episodes that an
      update has room for. None plays where ``jax.jit`` computes
    """

    learner: Learner
    devices: Devices | None = None

    def __call__(
        self, state: TrainState, key: jax.Array, active: bool | jax.Array = True
    ) -> Trajectory:
        """Plays the episodes of an update alone."""
        return self.with_evaluation(state, key, active, None).training

    def with_evaluation(
        self,
        state: TrainState,
        key: jax.Array,
        active: bool | jax.Array,
        evaluation: EvaluationEpisodes | None,
    ) -> SharedEpisodes:
        """Plays the episodes of an update, and before them those of an evaluation, if any."""

        def rollout(
            env: Environment,
            act: Act,
            actor: Actor,
            distribution: Acts,
            keys: jax.Array,
            *,
            num_episodes: int,
            horizon: int,
            active: bool | jax.Array,
            limit: jax.Array | None = None,
        ) -> SharedEpisodes:
            """Plays what the learner asks for, and the evaluation, in one launch a device."""

            def play(actor: Actor, keys: jax.Array, **options: Any) -> Trajectory:
                return self.learner.engine.rollout(
                    env, act, actor, distribution, keys, num_episodes=len(keys), **options
                )

            play_share: Any = functools.partial(self._play_share, play, horizon)
            # In arrays and None, which may be arguments of a function on several devices.
            evaluation_arrays = None
            evaluation_specs = None
            if evaluation is not None:
                evaluation_arrays = evaluation.keys, evaluation.deterministic(), evaluation.active
                evaluation_specs = _EPISODES
            if self.devices is not None:
                # The keys and the choice of the episodes are divided; all devices have the rest.
                in_specs = NONE, NONE, NONE, RUNS, RUNS
                out_specs = SharedEpisodes(_EPISODES, evaluation_specs)
                play_share = self.devices.map(play_share, in_specs, out_specs)
            active_episodes = jnp.broadcast_to(active, num_episodes)
            return play_share(actor, evaluation_arrays, limit, keys, active_episodes)

        episodes: SharedEpisodes = self.learner.play(state, key, active, rollout)
        if self.devices is None or evaluation is None:
            return episodes
        assert episodes.evaluation is not None
        # Those of the first device; the others played none.
        evaluation_episodes = episodes.evaluation.episodes(slice(len(evaluation.keys)))
        return episodes._replace(evaluation=evaluation_episodes)

    def _play_share(
        self,
        play: Callable[..., Trajectory],
        horizon: int,
        actor: Actor,
        evaluation: Any,
        limit: Any,
        keys: Any,
        active: Any,
    ) -> SharedEpisodes:
        """Plays episodes of these keys, as far as they are chosen, after those of an evaluation.

        They have ``limit`` [] steps at most, an evaluation's those of the horizon. ``evaluation``
        has the keys of its episodes, whether each takes the mode, and whether they are played; None
        without one. Of several devices each plays a share of the episodes, and the first one the
        evaluation's.
        """
        num_evaluated = 0
        modes = False
        if evaluation is not None:
            eval_keys, eval_modes, eval_active = evaluation
            # All devices run one program, so all have room for the evaluation; one plays it.
            if self.devices is not None:
                eval_active = eval_active & (self.devices.number() == 0)
            num_evaluated = len(eval_keys)
            # Its episodes come first, so that a slice takes either kind below.
            modes = jnp.concatenate([eval_modes, jnp.zeros(len(keys), bool)])
            active = jnp.concatenate([jnp.broadcast_to(eval_active, num_evaluated), active])
            if limit is not None:
                training_limit = jnp.broadcast_to(limit, len(keys))
                limit = jnp.concatenate([jnp.full(num_evaluated, horizon), training_limit])
            keys = jnp.concatenate([eval_keys, keys])
        episodes = play(
            actor, keys, horizon=horizon, deterministic=modes, active=active, limit=limit
        )
        if self.devices is not None:
            # Each has counted its own; the metrics of an update have the steps of all.
            simulated_steps = self.devices.sum(episodes.simulated)
            episodes = dataclasses.replace(episodes, simulated=simulated_steps)
        if evaluation is None:
            return SharedEpisodes(episodes, None)
        return SharedEpisodes(
            training=episodes.episodes(slice(num_evaluated, None)),
            evaluation=episodes.episodes(slice(num_evaluated)),
        )


def step_with(
    learner: Learner,
    state: TrainState,
    active: bool | jax.Array,
    evaluation: EvaluationEpisodes | None,
) -> tuple[TrainState, Metrics, Trajectory | None]:
    """Makes one update as ``Learner.step``; also returns the episodes of the evaluation, if any."""
    launch = learner.play
    if evaluation is None or not isinstance(launch, SharedLaunch):
        return *learner.step(state, active), None

    # ``step`` hands what ``play`` returns to ``learn``, and returns the metrics of ``learn``: the
    # episodes of the evaluation come out among them, and nothing has learned from these.
    def learn(
        state: TrainState, episodes: SharedEpisodes, key: jax.Array
    ) -> tuple[TrainState, dict[str, Any]]:
        next_state, metrics = learner.learn(state, episodes.training, key)
        return next_state, metrics | {_EVALUATION: episodes.evaluation}

    play = functools.partial(launch.with_evaluation, evaluation=evaluation)
    after, metrics = learner._replace(play=play, learn=learn).step(state, active)
    episodes: Any = metrics.pop(_EVALUATION)
    return after, metrics, episodes


def short_episodes(learner: Learner, horizon: int, num_seeds: int, cut_steps: int = 0) -> Learner:
    """Returns a learner that learns from the first steps alone where all episodes are short.

    Args:
      learner: whose ``play`` returns a ``Trajectory``.
      horizon: T, the time limit in steps.
      num_seeds: how many learn at once, vmapped. It decides nothing but speed and rounding.
      cut_steps: after which episodes of training are cut, 0 if they are not.
    """
    max_length = max(horizon // _SHORT_DIVISOR, cut_steps)

    def learn(
        state: TrainState, trajectory: Trajectory, key: jax.Array
    ) -> tuple[TrainState, Metrics]:
        """``Learner.learn``, which passes over ``max_length`` steps where no episode is longer."""
        # A second program for short episodes does not pay where updates are small or hardly longer.
        if not CHUNK_STEPS <= max_length < horizon or num_seeds * trajectory.mask.size < _MIN_STEPS:
            return learner.learn(state, trajectory, key)
        # One choice for all seeds: of a choice for each, vmap would compute both.
        return jax.lax.cond(
            any_lane(jnp.any(trajectory.mask[max_length])),
            lambda: learner.learn(state, trajectory, key),
            lambda: learner.learn(state, trajectory.first(max_length), key),
        )

    return learner._replace(learn=learn)


def in_one_launch(learner: Learner, devices: Devices | None = None) -> Learner:
    """Returns a learner that plays as ``SharedLaunch`` does.

    Args:
      learner: of ``reinforce``, or one that is wrapped around it.
      devices: see ``SharedLaunch``.
    """
    launch = SharedLaunch(learner, devices)
    # Where all episodes start alike, those of an evaluation would too: it is played alone.
    if jax.eval_shape(learner.init, jax.random.key(0)).start_key is not None:
        return learner._replace(play=launch.__call__)
    # With another engine an episode that is not played takes as long as one that is, and every
    # update would play the evaluation.
    if learner.engine.name != "native":
        return learner._replace(play=launch.__call__)
    return learner._replace(play=launch)


def check_learner(name: str, learner: Learner) -> None:
    """Raises ValueError for a learner that a run cannot train, in one line that says why.

    Args:
      name: of the function that returned it.
      learner: what it returned. Its functions are traced.
    """
    check_kind(f"what {name} returns", learner, Learner, "mjx_reinforce.reinforce(env)")
    # Shapes alone: nothing is played.
    state = traced(f"the learner of {name}", learner.init, jax.random.key(0))
    next_state, metrics = traced(f"the learner of {name}", learner.step, state)
    if _shapes(next_state) != _shapes(state):
        raise ValueError(
            f"learn of the learner of {name} must return a state of the structure, shapes and "
            "dtypes of the one that it gets"
        )
    if missing_metrics := [name for name in _METRICS if name not in metrics]:
        raise ValueError(
            f"learn of the learner of {name} must also return the metrics "
            f"{', '.join(missing_metrics)}: see mjx_reinforce.train_step"
        )


def _shapes(array_tree: PyTree) -> Any:
    """Returns the structure of a tree, and the shape and dtype of each leaf."""
    leaves, treedef = jax.tree.flatten(array_tree)
    return treedef, [(x.shape, x.dtype) for x in leaves]
