"""The best policy of each seed, by its evaluations so far."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from mjx_reinforce.learners.learner import TrainState
from mjx_reinforce.policies.actor import Actor


@struct.dataclass(kw_only=True)
class Best:
    """The best policies so far.

    actor: [S, ...] each seed's
    eval_return: [S] what its evaluation returned; -inf before the first
    num_updates: [S] int32, how many updates the seed had made then
    """

    actor: Actor
    eval_return: jax.Array
    num_updates: jax.Array


def first_best(train_states: TrainState) -> Best:
    """Returns the state before the first evaluation, in memory of its own; it compiles nothing."""
    actor, num_updates = jax.tree.map(np.array, (train_states.actor, train_states.num_updates))
    worst = np.full(num_updates.shape, -np.inf, jnp.result_type(float))
    return jax.device_put(Best(actor=actor, eval_return=worst, num_updates=num_updates))


@jax.jit
def keep_best(best: Best, train_states: TrainState, eval_return: Any) -> Best:
    """Takes in an evaluation; of two that are equal, the later is the better.

    Args:
      best: so far.
      train_states: [S, ...] whose actors were evaluated; they are copied.
      eval_return: [S]; one that is not a number is never the best.
    """
    present = Best(
        actor=train_states.actor, eval_return=eval_return, num_updates=train_states.num_updates
    )
    better = eval_return >= best.eval_return

    def choose(new: jax.Array, old: jax.Array) -> jax.Array:
        return jnp.where(better.reshape(-1, *[1] * (old.ndim - 1)), new, old)

    return jax.tree.map(choose, present, best)
