"""What changes as a run goes on: behind an optimizer, and in how episodes are cut.

Optax transformations go by the share of the budget that is used, which ``updates`` tells the
optimizer of, or by the env steps played. Counted in env steps, a policy whose episodes are short
keeps its rate and its noise, and one that has learned to play long ones settles soon.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax.typing import ArrayLike

from mjx_reinforce.engine.checks import check_count, check_number
from mjx_reinforce.learning.learner import RolloutPlay
from mjx_reinforce.learning.updates import Clock

#: The standard deviation shrinks in so many steps. Each is far greater than float32's rounding of
#: its logarithm, however many updates there are.
_NUM_STEPS = 4096


class Cut(NamedTuple):
    """Episodes of training end after some steps, until a share of the budget is used.

    On a GPU an update of cut episodes is done sooner. A policy that was trained on cut episodes
    alone may fail later in an episode, where it never was.

    Attributes:
      steps: after which an episode ends
      until: the share of the budget, in [0, 1], from which on episodes are whole

    Examples:
      >>> import jax
      >>> import mjx_reinforce as mr
      >>> env = mr.envs.make("CartPole-v1")
      >>> learner = mr.Cut(steps=20, until=0.5)(mr.reinforce(env, horizon=100))
      >>> state, metrics = learner.step(learner.init(jax.random.key(0)))
      >>> int(metrics["episode_length"]) <= 20
      True
    """

    steps: int
    until: float

    def __call__(self, learner: Any) -> Any:
        """Returns a learner of ``reinforce`` whose episodes of training are cut.

        Raises:
          ValueError: a number makes no sense, or ``reinforce`` did not make the learner.
        """
        # Only the ``play`` of ``reinforce`` takes a rollout, to which a limit can be given.
        play_whole = getattr(learner, "play", None)
        if not isinstance(play_whole, RolloutPlay):
            raise ValueError(f"a cut takes a learner of mjx_reinforce.reinforce, got {learner!r}")
        check_count("cut.steps", self.steps)
        check_number("cut.until", self.until)
        if self.until > 1:
            raise ValueError(f"cut.until must be a share of the budget in [0, 1], got {self.until}")

        def play(state: Any, key: jax.Array, active: Any = True, rollout: Any = None) -> Any:
            full_rollout = learner.engine.rollout if rollout is None else rollout
            cut_rollout = functools.partial(full_rollout, limit=self.limit(state.progress))
            return play_whole(state, key, active, cut_rollout)

        return learner._replace(play=RolloutPlay(play))

    def limit(self, progress: jax.Array) -> jax.Array:
        """Returns the most steps [] of an episode where this share [] of the budget is used."""
        return jnp.where(progress < self.until, self.steps, jnp.iinfo(jnp.int32).max)


class Shrunk(NamedTuple):
    """State of ``shrink_std``: the share of its change that was made so far, []."""

    share: jax.Array


def share(clock: Clock, env_steps: float | jax.Array | None) -> jax.Array:
    """Returns how much [] of a schedule has passed, at most 1.

    Args:
      clock: of the run.
      env_steps: the schedule's length; None is as long as the budget.
    """
    if env_steps is None:
        return jnp.minimum(clock.progress, 1.0)
    # As a float: an int beyond 2^31 would not fit into JAX's.
    fraction = clock.env_steps / jnp.asarray(env_steps, clock.env_steps.dtype)
    return jnp.minimum(fraction, 1.0)


def decay_rate(
    final_share: float | jax.Array, env_steps: float | jax.Array | None = None
) -> optax.GradientTransformationExtraArgs:
    """Multiplies changes by a factor that falls linearly from 1 to ``final_share``, then stays.

    Args:
      final_share: the factor at the end.
      env_steps: over which it falls; None: over the budget.
    """

    def update(updates, state, params=None, **rollout: Any):
        del params
        # From the clock at the rollout's start: all steps of an update have the same rate.
        rate_factor = 1 + (final_share - 1) * share(rollout["clock"], env_steps)
        return jax.tree.map(lambda x: rate_factor * x, updates), state

    return optax.GradientTransformationExtraArgs(lambda params: optax.EmptyState(), update)


def shrink_std(
    ratio: ArrayLike, env_steps: float | jax.Array | None = None
) -> optax.GradientTransformationExtraArgs:
    """Multiplies standard deviations that are parameters by ``ratio`` in all, evenly in the log.

    Learning changes them besides, and an update that ``max_kl`` shortens shrinks them less. They
    are the entry ``constants`` of ``mlp_policy``'s parameters, log standard deviations of the
    families that keep one for all states; others have no entries.

    Args:
      ratio: of the standard deviation at the end to that at the start, [] or [A] of each entry.
      env_steps: over which it shrinks; None: over the budget.
    """

    def update(updates, state, params=None, **rollout: Any):
        """Adds to the change of the log standard deviations what the schedule is ahead."""
        del params
        # Optax adds updates to parameters, so the log of the std moves by the difference between
        # what is due and what was made so far; learning's own changes of it stay.
        scheduled_share = jnp.floor(share(rollout["clock"], env_steps) * _NUM_STEPS) / _NUM_STEPS
        log_change = (scheduled_share - state.share) * jnp.log(ratio)
        return updates | {"constants": updates["constants"] + log_change}, Shrunk(scheduled_share)

    def init(params):
        del params
        return Shrunk(jnp.zeros(()))

    return optax.GradientTransformationExtraArgs(init, update)
