"""The best policy of each seed, by its evaluations so far; on the host, where nothing compiles."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from mjx_reinforce.learners.learner import TrainState
from mjx_reinforce.policies.actor import Actor
from mjx_reinforce.training.programs import Looked


class Best(struct.PyTreeNode, kw_only=True):
    """The best policies so far.

    actor: [S, ...] each seed's
    eval_return: [S] what its evaluation returned; -inf before the first
    num_updates: [S, 2] how many updates the seed had made then, as ``counts`` has it
    """

    actor: Actor
    eval_return: Any
    num_updates: Any


def shape_of_best(train_states: TrainState) -> Best:
    """Returns the shapes of the best policies of states, or of their shapes."""
    num_updates = train_states.num_updates
    returns = jax.ShapeDtypeStruct(num_updates.shape[:1], jnp.result_type(float))
    return Best(actor=train_states.actor, eval_return=returns, num_updates=num_updates)


def first_best(train_states: TrainState) -> Best:
    """Returns the state before the first evaluation, in memory of its own."""
    returns = shape_of_best(train_states).eval_return
    actor, num_updates = jax.tree.map(np.array, (train_states.actor, train_states.num_updates))
    worst = np.full(returns.shape, -np.inf, returns.dtype)
    return Best(actor=actor, eval_return=worst, num_updates=num_updates)


def keep_best(best: Best, looked: Looked) -> Best:
    """Takes in an evaluation; of two that are equal, the later is the better.

    Args:
      best: so far.
      looked: the evaluation; a return that is not a number is never the best.
    """
    eval_return = looked.measured["eval_return"]
    present = Best(
        actor=looked.actor, eval_return=eval_return, num_updates=np.asarray(looked.num_updates)
    )
    better = eval_return >= np.asarray(best.eval_return)

    def choose(new: np.ndarray, old: np.ndarray) -> np.ndarray:
        return np.where(better.reshape(-1, *[1] * (new.ndim - 1)), new, old)

    return jax.tree.map(choose, present, best)
