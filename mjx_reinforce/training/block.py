"""A block of updates of runs side by side, as a function to be compiled."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from mjx_reinforce.learning import counts
from mjx_reinforce.learning.learner import Learner, TrainState
from mjx_reinforce.training.evaluation import measure
from mjx_reinforce.training.hosting import Guests, step_with
from mjx_reinforce.training.state import Budget, RunState

#: Returns the learner of settings that may be traced, of one run each.
BuildLearner = Callable[[dict[str, jax.Array]], Learner]


class Block(NamedTuple):
    """What a block of updates measured.

    made: [] how many updates were made
    metrics: [length, R] each; the rows after the last update are zero
    looked: [R] each, what ``evaluation.measure`` returns of the policies before the first update;
      empty where the evaluation does not ride with it
    """

    made: jax.Array
    metrics: dict[str, jax.Array]
    looked: dict[str, jax.Array]


def block_of_updates(
    build_learner: BuildLearner, length: int, visit: Callable[..., Guests] | None
) -> Callable[..., tuple[RunState, Block]]:
    """Returns a function that makes ``length`` updates of all runs, or fewer if that is the end.

    It takes a ``RunState``, a ``Budget``, and whether to evaluate the policies before the first
    update, [] or [R]. Its result is the state, and a ``Block``.

    Args:
      build_learner: called while the settings of one run are traced.
      length: rows of the metrics.
      visit: (key of an evaluation [], whether it is made []) -> its episodes, which are played in
        one go with those of the first update; None where learners cannot.
    """

    def active(state: RunState, budget: Budget) -> jax.Array:
        used = counts.reached(state.train_states.env_steps, budget.env_steps)
        return ~(used | counts.reached(state.train_states.num_updates, budget.updates))

    def progress(state: RunState, budget: Budget) -> jax.Array:
        """Returns the share [R] of its budget that each run has used."""
        env_steps = counts.as_float(state.train_states.env_steps)
        updates = counts.as_float(state.train_states.num_updates)
        # No run goes on whose budget is nothing.
        limits = (counts.as_float(x) for x in budget)
        one, other = (jnp.maximum(limit, 1.0) for limit in limits)
        return jnp.minimum(jnp.maximum(env_steps / one, updates / other), 1.0)

    def step(
        state: TrainState,
        settings: dict[str, jax.Array],
        going: jax.Array,
        eval_key: jax.Array,
        look: jax.Array,
    ) -> Any:
        guests = None if visit is None else visit(eval_key, look)
        state, metrics, played = step_with(build_learner(settings), state, going, guests)
        looked = {} if guests is None or played is None else measure(played, guests)
        return state, metrics | {"active": going}, looked

    @functools.partial(jax.jit, inline=True)  # traced once, for its shapes and for the loop
    def update(state: RunState, budget: Budget, look: jax.Array) -> Any:
        before = dataclasses.replace(state.train_states, progress=progress(state, budget))
        going, looks = active(state, budget), jnp.broadcast_to(look, len(state.eval_keys))
        train_states, metrics, looked = jax.vmap(step)(
            before, state.settings, going, state.eval_keys, looks
        )
        return dataclasses.replace(state, train_states=train_states), metrics, looked

    def advance(state: RunState, budget: Budget, look: jax.Array) -> tuple[RunState, Block]:
        def unfinished(carry: tuple[RunState, Block]) -> jax.Array:
            state, block = carry
            return (block.made < length) & jnp.any(active(state, budget))

        def body(carry: tuple[RunState, Block]) -> tuple[RunState, Block]:
            state, (made, rows, looked) = carry
            state, row, now = update(state, budget, look & (made == 0))
            write = functools.partial(lax.dynamic_update_index_in_dim, index=made, axis=0)
            looked = jax.tree.map(lambda x, old: jnp.where(made == 0, x, old), now, looked)
            return state, Block(made + 1, jax.tree.map(write, rows, row), looked)

        _, row, looked = jax.eval_shape(update, state, budget, look)
        zeros = functools.partial(jax.tree.map, lambda x: jnp.zeros(x.shape, x.dtype))
        rows = jax.tree.map(lambda x: jnp.zeros((length, *x.shape), x.dtype), row)
        return lax.while_loop(unfinished, body, (state, Block(jnp.int32(0), rows, zeros(looked))))

    return advance
