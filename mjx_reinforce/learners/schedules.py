"""What changes with the env steps played: optax transformations that stand behind an optimiser.

Counted in env steps, a policy whose episodes are short keeps its rate and its noise, and one that
has learned to play long ones settles soon. ``updates`` tells the optimiser of each rollout's steps.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax


class Played(NamedTuple):
    """State of a schedule: how many env steps were played so far, float []."""

    env_steps: jax.Array


def decay_rate(
    least: float | jax.Array, env_steps: float | jax.Array
) -> optax.GradientTransformationExtraArgs:
    """Multiplies changes by a factor that falls linearly from 1 to ``least``, then stays.

    Args:
      least: the factor at the end.
      env_steps: over which it falls.
    """

    def change(updates, before, after):
        del after
        factor = least + (1 - least) * jnp.maximum(1 - before / env_steps, 0)
        return jax.tree.map(lambda x: factor * x, updates)

    return _schedule(change)


def shrink_std(
    ratio: float | jax.Array, env_steps: float | jax.Array
) -> optax.GradientTransformationExtraArgs:
    """Multiplies standard deviations that are parameters by ``ratio`` in all, evenly in the log.

    Learning changes them besides, and an update that ``max_kl`` shortens shrinks them less. They
    are the entry ``constants`` of ``mlp_policy``'s parameters, log standard deviations of the
    families that keep one for all states; others have no entries.

    Args:
      ratio: of the standard deviation at the end to that at the start.
      env_steps: over which it shrinks.
    """

    def change(updates, before, after):
        share = jnp.minimum(after / env_steps, 1) - jnp.minimum(before / env_steps, 1)
        return updates | {"constants": updates["constants"] + share * jnp.log(ratio)}

    return _schedule(change)


def _schedule(change: Callable[..., Any]) -> optax.GradientTransformationExtraArgs:
    """Changes updates by a function of them and of the env steps before and after the rollout."""

    def init(params):
        del params
        return Played(jnp.zeros(()))

    def update(updates, state, params=None, **rollout: Any):
        del params
        after = state.env_steps + rollout["env_steps"]
        return change(updates, state.env_steps, after), Played(after)

    return optax.GradientTransformationExtraArgs(init, update)
