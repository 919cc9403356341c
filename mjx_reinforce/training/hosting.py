"""What is wrapped around a learner where many seeds train: none of it changes the algorithm.

Each function takes a learner and returns one. ``hosted`` lets an evaluation ride with the episodes
of an update, and divides them among devices; ``short_episodes`` makes updates of many seeds cheap
while all episodes are short.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mjx_reinforce.engine.base import Environment, PyTree, Trajectory
from mjx_reinforce.engine.checks import check_kind
from mjx_reinforce.engine.devices import NONE, RUNS, SECOND, Devices
from mjx_reinforce.engine.play.episode import CHUNK_STEPS, check_each, episode_keys
from mjx_reinforce.engine.scalar import any_lane
from mjx_reinforce.learning.contract import traced
from mjx_reinforce.learning.learner import Learner, Metrics, TrainState, begins_as
from mjx_reinforce.learning.policy import Actor
from mjx_reinforce.learning.schedules import Cut

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

#: Metrics without which no run can be recorded.
_METRICS = (
    *("episodes", "episode_return", "episode_length", "env_steps", "simulated_steps"),
    *("nonfinite_episodes", "skipped_update"),
)


class Guests(NamedTuple):
    """E episodes that are played in one go with those of an update, and from which nothing learns.

    keys: [E] their own keys, as ``engine.play.episode.episode_keys`` makes them
    num_modes: how many of them, the first, take the policy's mode; the others its samples
    active: [] whether they are played
    """

    keys: jax.Array
    num_modes: int
    active: jax.Array

    def deterministic(self) -> jax.Array:
        """Returns which of them [E] take the mode."""
        return jnp.arange(len(self.keys)) < self.num_modes


@dataclasses.dataclass(frozen=True, eq=False)
class Host:
    """A ``Learner.play`` of ``reinforce`` that can take guests, and divides episodes among devices.

    env, num_episodes, horizon: those of ``reinforce``
    learner: which ``reinforce`` made
    limit: (progress []) -> the most steps [] of an episode that is no guest; None without a cut
    devices: among which the episodes of an update are divided; they stay where they are played, and
      XLA divides what is computed from them. Their count divides every number of episodes that an
      update has room for. None plays where ``jax.jit`` computes
    """

    env: Environment
    num_episodes: int
    horizon: int
    learner: Learner
    limit: Callable[[jax.Array], jax.Array] | None = None
    devices: Devices | None = None

    def __call__(
        self, state: TrainState, key: jax.Array, active: bool | jax.Array = True
    ) -> Trajectory:
        """Plays without guests."""
        return self.with_guests(state, key, active, None)[0]

    def with_guests(
        self, state: TrainState, key: jax.Array, active: bool | jax.Array, guests: Guests | None
    ) -> tuple[Trajectory, Trajectory | None]:
        """Plays the episodes of an update, with guests before them if there are any."""
        check_each(self.num_episodes, active=active)
        visitors = None if guests is None else (guests.keys, guests.deterministic(), guests.active)
        chosen = jnp.broadcast_to(active, self.num_episodes)
        keys = episode_keys(key, self.num_episodes)
        limit = None
        if self.limit is not None:
            limit = jnp.minimum(self.limit(state.progress), self.horizon)
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
        played = self.learner.engine.rollout(
            begins_as(self.env, start_key),
            self.learner.act,
            actor,
            self.learner.policy.distribution,
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


def step_with(
    learner: Learner, state: TrainState, active: bool | jax.Array, guests: Guests | None
) -> tuple[TrainState, Metrics, Trajectory | None]:
    """Makes one update as ``Learner.step``; also returns the episodes of guests, if any."""
    host, looked = learner.play, []
    if guests is None or not isinstance(host, Host):
        return *learner.step(state, active), None

    def play(state: TrainState, key: jax.Array, active: bool | jax.Array) -> Trajectory:
        own, theirs = host.with_guests(state, key, active, guests)
        looked.append(theirs)
        return own

    return *learner._replace(play=play).step(state, active), *looked


def short_episodes(learner: Learner, horizon: int, num_seeds: int, cut_steps: int = 0) -> Learner:
    """Returns a learner that learns from the first steps alone where all episodes are short.

    Args:
      learner: whose ``play`` returns a ``Trajectory``.
      horizon: T, the time limit in steps.
      num_seeds: how many learn at once, vmapped. It decides nothing but speed and rounding.
      cut_steps: after which episodes of training are cut, 0 if they are not.
    """
    few = max(horizon // _SHORT, cut_steps)

    def learn(
        state: TrainState, trajectory: Trajectory, key: jax.Array
    ) -> tuple[TrainState, Metrics]:
        if not CHUNK_STEPS <= few < horizon or num_seeds * trajectory.mask.size < _MANY:
            return learner.learn(state, trajectory, key)
        return jax.lax.cond(
            any_lane(jnp.any(trajectory.mask[few])),
            lambda: learner.learn(state, trajectory, key),
            lambda: learner.learn(state, trajectory.first(few), key),
        )

    return learner._replace(learn=learn)


def hosted(
    learner: Learner,
    env: Environment,
    num_episodes: int,
    horizon: int,
    *,
    cut: Cut | None = None,
    devices: Devices | None = None,
) -> Learner:
    """Returns a learner of ``reinforce`` that plays as ``Host`` does.

    Args:
      learner: of ``reinforce``, with the next three arguments.
      env: what is played.
      num_episodes: N.
      horizon: T, in steps.
      cut: of the episodes of training.
      devices: see ``Host``.
    """
    limit = None if cut is None else cut.limit
    host = Host(env, num_episodes, horizon, learner, limit, devices)

    if jax.eval_shape(learner.init, jax.random.key(0)).start_key is not None:
        return learner._replace(play=host.__call__)
    # Elsewhere an episode that is not played still takes its place.
    return learner._replace(play=host if learner.engine.name == "native" else host.__call__)


def check_learner(name: str, learner: Learner) -> None:
    """Raises ValueError for a learner that a run cannot train, in one line that says why.

    Args:
      name: of the function that returned it.
      learner: what it returned. Its functions are traced.
    """
    check_kind(f"what {name} returns", learner, Learner, "mjx_reinforce.reinforce(env)")
    state = traced(f"the learner of {name}", learner.init, jax.random.key(0))
    after, metrics = traced(f"the learner of {name}", learner.step, state)
    if _shapes(after) != _shapes(state):
        raise ValueError(
            f"learn of the learner of {name} must return a state of the structure, shapes and "
            "dtypes of the one that it gets"
        )
    if missing := [each for each in _METRICS if each not in metrics]:
        raise ValueError(
            f"learn of the learner of {name} must also return the metrics {', '.join(missing)}: "
            "see mjx_reinforce.train_step"
        )


def _shapes(tree: PyTree) -> Any:
    """Returns the structure of a tree, and the shape and dtype of each leaf."""
    leaves, structure = jax.tree.flatten(tree)
    return structure, [(x.shape, x.dtype) for x in leaves]
