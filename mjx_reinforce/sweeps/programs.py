"""The compiled programs of a group: those of a run, for a chunk of runs on all devices."""

import dataclasses
import functools
from collections.abc import Callable, Collection
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_reinforce.runs.blocks import block_length
from mjx_reinforce.runs.config import MAX_COUNT, Config
from mjx_reinforce.runs.state import (
    Arrays,
    Budget,
    BuildLearner,
    RunState,
    beginning,
    block_of_updates,
    budget_of,
    evaluation,
    evaluation_key,
    to_numpy,
)
from mjx_reinforce.sweeps.devices import NONE, RUNS, SECOND, Devices


class Programs(NamedTuple):
    """The compiled programs of a group. They move ``width`` runs at once: a slot of a chunk.

    A chunk in progress is a list of the states of its slots.

    width: a multiple of the number of devices
    like: the shapes of a slot
    begin: (keys [W], settings [W] each, padding [W]) -> the first state of a slot; a run that is
      padding stands still from the start
    block: (slot) -> (slot, (updates made [D], metrics [K, W], moved [W])), as
      ``state.block_of_updates``, with whether each run made an update
    look: (slot, which [W]) -> evaluation [W] of the present policies of these runs
    every: [W] that is all of them
    """

    width: int
    like: RunState
    begin: Callable[..., RunState]
    block: Callable[[RunState], tuple[RunState, Any]]
    look: Callable[[RunState, jax.Array], dict[str, jax.Array]]
    every: jax.Array

    def advance(self, chunk: list[RunState]) -> tuple[list[RunState], Arrays, Arrays]:
        """Makes a block of updates of all runs, see ``state.Programs``, and evaluates them.

        Returns:
          The chunk, the metrics [K, R] and the evaluation [R], which says nothing of runs that
          made no update: their ``active`` is False in all metrics.
        """
        blocks = [self.block(slot) for slot in chunk]
        chunk = [slot for slot, _ in blocks]
        # Begun before the host waits for anything.
        looked = [self.look(slot, moved) for slot, (_, _, moved) in blocks]
        made = max(int(np.max(made)) for _, (made, _, _) in blocks)
        metrics = _joined([to_numpy(metrics) for _, (_, metrics, _) in blocks])
        return chunk, {name: x[:made] for name, x in metrics.items()}, _fetch(looked)

    def evaluate(self, chunk: list[RunState]) -> Arrays:
        """Evaluates the present policies of all runs [R]."""
        return _fetch([self.look(slot, self.every) for slot in chunk])


def compile_programs(
    env: Any,
    build_learner: BuildLearner,
    horizon: int,
    config: Config,
    traced: Collection[str],
    width: int,
    devices: Devices,
) -> Programs:
    """Compiles the programs of a group.

    Args:
      env: what is trained on.
      build_learner: from the traced settings of a run to its learner.
      horizon: T, the time limit of an episode in steps.
      config: the settings, in which those that are traced stand for any value.
      traced: the names of those that are.
      width: how many runs are moved at once, a multiple of the number of devices.
      devices: where.
    """
    key, budget = devices.put((evaluation_key(config), budget_of(config)), NONE)
    begin = devices.jit(_with_padding(beginning(build_learner)), (RUNS,) * 3, RUNS)
    first = devices.shapes(jax.eval_shape(functools.partial(_arguments, traced, width)), RUNS)
    like = devices.shapes(shape_of_slot(build_learner, traced, width), RUNS)
    block = _with_totals(block_of_updates(build_learner, block_length(config)))
    advance = devices.jit(block, (RUNS, NONE), (RUNS, (RUNS, SECOND, RUNS)), donate_argnums=0)
    # Policies and engines are those of any of its learners.
    look = evaluation(env, build_learner({}), horizon, config)
    look = devices.jit(look, (RUNS, NONE, RUNS), RUNS)
    with ThreadPoolExecutor() as pool:  # each compiles while the next is traced
        beginning_ = pool.submit(begin.lower(*first).compile)
        every = devices.put(np.ones(width, bool), RUNS)
        looking = pool.submit(look.lower(like.train_states.actor, key, every).compile)
        advancing = advance.lower(like, budget).compile()
        began, looked = beginning_.result(), looking.result()
    return Programs(
        width,
        like,
        began,
        lambda slot: advancing(slot, budget),
        lambda slot, which: looked(slot.train_states.actor, key, which),
        every,
    )


def shape_of_slot(build_learner: BuildLearner, traced: Collection[str], width: int) -> RunState:
    """Returns the shapes of the states of ``width`` runs."""
    arguments = jax.eval_shape(functools.partial(_arguments, traced, width))
    return jax.eval_shape(_with_padding(beginning(build_learner)), *arguments)


def _arguments(traced: Collection[str], width: int) -> tuple[Any, dict[str, jax.Array], Any]:
    """Returns arguments of ``Programs.begin``."""
    keys = jax.random.split(jax.random.key(0), width)
    return keys, {name: jnp.zeros(width) for name in traced}, jnp.zeros(width, bool)


def _with_padding(begin: Callable[..., RunState]) -> Callable[..., RunState]:
    """Returns ``begin`` with a third argument [W]: the runs that have no budget."""

    def begin_padded(keys: jax.Array, settings: Any, padding: jax.Array) -> RunState:
        state = begin(keys, settings)
        used = jnp.where(padding, MAX_COUNT, state.env_steps)
        return dataclasses.replace(state, env_steps=used)

    return begin_padded


def _with_totals(block: Callable[..., Any]) -> Callable[..., Any]:
    """Returns ``block`` with the counts in every row after its last update, and which runs moved.

    Another device may make more updates, and the counts of all are read in one row.
    """

    def filled(state: RunState, budget: Budget) -> Any:
        before = state.train_states.num_updates
        state, (made, rows) = block(state, budget)
        moved = state.train_states.num_updates > before
        counts = {"updates_total": state.train_states.num_updates}
        counts["env_steps_total"] = state.env_steps
        for name, count in counts.items():
            late = jnp.arange(len(rows[name]))[:, None] >= made
            rows = rows | {name: jnp.where(late, count, rows[name])}
        return state, (made[None], rows, moved)

    return filled


def _joined(slots: list[Arrays]) -> Arrays:
    """Returns the arrays of all slots side by side, the runs on their last axis."""
    return {name: np.concatenate([slot[name] for slot in slots], axis=-1) for name in slots[0]}


def _fetch(slots: list[dict[str, jax.Array]]) -> Arrays:
    return _joined([to_numpy(slot) for slot in slots])
