"""The programs that move runs on side by side; ``slots`` compiles them."""

import dataclasses
import functools
from collections.abc import Callable, Collection, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_reinforce.engine.base import Environment, plain
from mjx_reinforce.learning import counts
from mjx_reinforce.learning.learner import TrainState
from mjx_reinforce.settings.config import MAX_COUNT, Config
from mjx_reinforce.training import state
from mjx_reinforce.training.block import (
    BuildLearner,
    block_of_updates,
    evaluate,
    evaluation_episodes,
)
from mjx_reinforce.training.division import ALONE, Division
from mjx_reinforce.training.state import Budget, RunState, Seed, StateRows
from mjx_reinforce.training.wrappers import SharedLaunch


class Programs(NamedTuple):
    """The programs of R runs before they are compiled. States are rows [R, B], see ``StateRows``.

    What differs from sweep to sweep without another program is their input: seeds, budgets, and
    the settings that are traced.

    begin: (seed, the numbers [R] of the runs' seeds, settings [R] each) -> the first states, and
      the data of the keys [K, R] of the last test, which plays the episodes of K evaluations
    advance: (states, the parts of a ``Budget``, which rows have a run [R], whether to evaluate [])
      -> (states, metrics [K, R] each, what was evaluated [R] each), as in ``block.Block``
    evaluate: (states, whether to [R]) -> what ``block.evaluate`` returns, [R] each
    rides: whether ``advance`` evaluates; else ``evaluate`` does, before it
    like: the shapes of a ``RunState``
    division: among which devices the runs are divided; R are those of one device
    """

    begin: Callable[..., tuple[jax.Array, jax.Array]]
    advance: Callable[..., tuple[jax.Array, dict[str, jax.Array], dict[str, jax.Array]]]
    evaluate: Callable[..., dict[str, jax.Array]]
    rides: bool
    like: RunState
    division: Division = ALONE


#: The metrics that say how far a run is, and which of its updates broke.
_COUNTED = ("active", "env_steps", "nonfinite_episodes", "skipped_update")


def programs_of(
    env: Environment,
    build_learner: BuildLearner,
    horizon: int,
    config: Config,
    num_runs: int,
    traced: Collection[str] = (),
    *,
    whole: bool = True,
    division: Division = ALONE,
) -> Programs:
    """Returns the programs of runs.

    Args:
      env: what is trained on.
      build_learner: called while the settings of one run are traced, and without any.
      horizon: T, the time limit of an episode in steps.
      config: the settings, in which those that are traced stand for any value.
      num_runs: R, of the shapes; those of one device.
      traced: the names of the settings that differ from run to run.
      whole: whether all is measured that ``metrics.csv`` has. Else evaluations play the policy's
        mode alone, and of the metrics those of ``_COUNTED`` are returned.
      division: among which devices the runs are divided.
    """
    learner = build_learner({})  # policies and engines are those of any
    rides = isinstance(learner.play, SharedLaunch) and config.training_horizon(horizon) == horizon

    def first(key: jax.Array, settings: dict[str, jax.Array]) -> TrainState:
        return build_learner(settings).init(key)

    # One program, whatever the seeds are: a program for each operation on keys takes longer.
    def states(seed: Seed, numbers: jax.Array, settings: dict[str, jax.Array]) -> RunState:
        keys = state.seed_keys(seed, numbers)
        return RunState(
            train_states=jax.vmap(first)(keys, settings),
            eval_keys=state.eval_keys(numbers),
            settings=settings,
        )

    def begin(seed: Seed, numbers: jax.Array, settings: dict[str, jax.Array]) -> Any:
        rows = layout.traced_rows(states(seed, numbers, settings))
        return rows, plain(state.last_test_keys(numbers, config))

    size: Any = {"num_episodes": config.eval_episodes, "sampled": whole}
    visit = functools.partial(evaluation_episodes, **size)
    play = functools.partial(evaluate, env, learner, horizon=horizon, **size)

    def look_at(rows: jax.Array, which: jax.Array) -> dict[str, jax.Array]:
        now = layout.traced_states(rows)
        return jax.vmap(play)(now.train_states.actor, now.eval_keys, active=which)

    updates = block_of_updates(build_learner, config.block_length, visit if rides else None)

    def advance(
        rows: jax.Array, budget: Sequence[jax.Array], which: jax.Array, look: jax.Array
    ) -> Any:
        before = layout.traced_states(rows)
        # A row without a run has no budget.
        played = before.train_states.env_steps
        played = jnp.where(which[:, None], played, counts.from_int(MAX_COUNT))
        train_states = dataclasses.replace(before.train_states, env_steps=played)
        before = dataclasses.replace(before, train_states=train_states)
        after, (_, metrics, looked) = updates(before, Budget(*budget), which & look)
        measured = metrics if whole else {name: metrics[name] for name in _COUNTED}
        return layout.traced_rows(after), measured, looked

    numbers = jax.ShapeDtypeStruct((num_runs,), np.uint32)
    settings = {name: jax.ShapeDtypeStruct((num_runs,), jnp.result_type(float)) for name in traced}
    like = jax.eval_shape(states, np.uint32(0), numbers, settings)
    layout = StateRows(like)
    return Programs(begin, advance, look_at, rides, like, division)
